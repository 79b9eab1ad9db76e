"""scarlet2 with its own renderer and with ours: accuracy of both, seconds of an iteration.

    python -m bench.scarlet2 [--quick] [--json FILE]

Needs scarlet2 (`make test-adapters` makes an environment that has it). Two scenes with a truth:

tutorial      HST and HSC, as in scarlet2's tutorial on several resolutions: the cutouts of the data
              folder give grids, PSFs and noise, and our fit to them the galaxies, which are taken
              for true and observed anew; left out where there are no data
turned        Euclid and Rubin, turned by 12 degrees, of galaxies drawn by GalSim

Both renderers get the same observations and the same start, round Gaussians of the true fluxes, and
as many iterations of scarlet2's own `Scene.fit`. A row is a renderer on a scene:

render_db     [dB] SDR of the rendered truth against our operator in float64, in the channel of
              either instrument that is worst
sdr           [dB] median over sources: fitted models against the truth, all channels
truth_chi2    per pixel of the rendered truth: 1 for a renderer that is right to within the noise
chi2          per pixel after the last iteration
seconds       of one iteration, compilation left out; median
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from clresample import (
    PSF,
    Grid,
    Observation,
    Resampler,
    deblend,
    detect,
    model_frame,
    simulate_scene,
)
from clresample.adapters.optional import require
from clresample.adapters.scarlet2 import renderer_of

from .harness import records
from .harness.clock import on_all_cores
from .harness.options import Parser, data_folder, run
from .harness.scarlet2_scene import free_parameters

CENTER_DEG, ANGLE_DEG, SEED, N_SOURCES = (150.1, 2.2), 12.0, 100, 5
START_PX, BOX_PX = 3.0, 61  # [model px] sigma of the start's Gaussians, side of their boxes
# Steps of scarlet2's tutorial: 5 % of a spectrum, 0.01 of a morphology whose maximum is 1.
SPECTRUM_STEP, MORPHOLOGY_STEP = 0.05, 0.01
COLUMNS = records.columns(
    "scene:9 renderer:10 n_sources:9d iterations:10d render_db:9.1f truth_chi2:10.3f sdr:6.2f "
    "chi2:6.3f seconds:8.3f"
)


class Truth(NamedTuple):
    """A scene whose galaxies are known.

    observations: ours, finest first; frame: ours; positions (S, 2) [model px]
    models (S, C, Ny, Nx): galaxies in the frame, in the counts of each channel's observation
    """

    observations: list
    frame: object
    positions: np.ndarray
    models: np.ndarray


def decibel(truth, found):
    """SDR [dB]: 10 log10 of the truth's power over that of the difference."""
    return 10 * np.log10((truth**2).sum() / ((found - truth) ** 2).sum())


def turned():
    """Euclid and Rubin, the truth drawn by GalSim under the frame's PSF."""
    scene = simulate_scene(SEED, n_sources=N_SOURCES, angle_deg=ANGLE_DEG, center_deg=CENTER_DEG)
    observations = [scene.euclid.observation(), scene.rubin.observation()]
    counts = np.concatenate([scene.euclid.counts, scene.rubin.counts], axis=1)
    units = scene.euclid.truth[:, None]
    return Truth(
        observations,
        model_frame(observations, grid=scene.euclid.grid),
        scene.euclid.positions_px,
        counts[:, :, None, None] * units / units.sum(axis=(2, 3), keepdims=True),
    )


def tutorial(folder):
    """HST and HSC: what we fit to the cutouts, rendered in float64 and observed with new noise."""
    found = []
    for name, image, psf, channels in (
        ("HST", "hst_f814w", "psf_hst_f814w", ["F814W"]),
        ("HSC", "hsc_grizy", "psf_hsc_grizy", list("grizy")),
    ):
        pixels, header = fits.getdata(folder / f"{image}.fits", header=True)
        # scarlet2's PSFs are centred on a whole pixel: the truth's are the same
        stars = PSF(_middled(PSF(fits.getdata(folder / f"{psf}.fits"), center="core")))
        grid = Grid.from_wcs(WCS(header).celestial, pixels.shape)
        found.append(Observation(pixels, stars, grid, channels=channels, name=name))
    sources = detect(found)
    result = deblend(found, sources.sources, frame=sources.frame)
    models = np.array([result.source_model(s) for s in range(len(result.sources))])
    rng = np.random.default_rng(SEED)
    anew = []
    for o, part in zip(found, result.channel_slices()):
        seen = exact(result.frame, o)(models[:, part].sum(axis=0))
        noise = rng.standard_normal(o.shape) / np.sqrt(o.weights)
        same = {"weights": o.weights, "channels": o.channels, "name": o.name}
        anew.append(Observation(seen + noise, o.psf, o.grid, **same))
    return Truth(anew, result.frame, result.frame.positions_of(result.sources), models)


def exact(frame, observation):
    """Our operator in float64 from the frame to an observation."""
    bands = frame.psf.select([0] * observation.psf.n_bands)
    return Resampler(frame.grid, bands, observation.grid, observation.psf, dtype=np.float64)


class Scarlet2:
    """The truth's observations, start and fit in scarlet2's own terms."""

    def __init__(self, truth):
        self.package = require("scarlet2", "scarlet2")
        require("scarlet2.validation_utils", "scarlet2").set_validation(False)  # it prints
        self.truth = truth
        channels = [name for o in truth.observations for name in o.channels]
        shape = (len(channels), *truth.frame.shape)
        self.frame = self.package.Frame(
            self.package.bbox.Box(shape),
            psf=truth.frame.psf.images[:1],
            wcs=truth.frame.grid.to_wcs(),
            channels=channels,
        )
        self.observations = [
            self.package.Observation(
                np.asarray(o.data, np.float32),
                np.asarray(o.weights, np.float32),
                psf=_middled(o.psf),
                wcs=o.grid.to_wcs(),
                channels=list(o.channels),
            )
            for o in truth.observations
        ]

    def match(self, ours):
        """Chooses the renderer of all observations."""
        for o in self.observations:
            o.match(self.frame, renderer_of(self.frame, o.frame) if ours else None)

    def render_db(self):
        """Worst SDR [dB] of a channel of the rendered truth."""
        total = self.truth.models.sum(axis=0).astype(np.float32)
        worst, first = np.inf, 0
        for theirs, o in zip(self.observations, self.truth.observations):
            part = slice(first, first := first + len(o.channels))
            expected = exact(self.truth.frame, o)(total[part].astype(np.float64))
            seen = np.asarray(theirs.render(total), np.float64)
            worst = min(worst, *(decibel(e, s) for e, s in zip(expected, seen)))
        return worst

    def fit(self, n_iterations):
        """Models (S, C, Ny, Nx), chi2 per pixel, and seconds of an iteration."""
        scene = self._start()
        ends = []
        fitted = scene.fit(
            self.observations,
            max_iter=n_iterations,
            e_rel=0,
            progress_bar=False,
            callback=lambda *_: ends.append(time.perf_counter()),
        )
        models = np.array([fitted.evaluate_source(s) for s in fitted.sources])
        return models, self.chi2(fitted()), float(np.median(np.diff(ends)))

    def chi2(self, model):
        """Per pixel, of a model (C, Ny, Nx) in the frame, in all observations."""
        total = sum(float(o._chisquare(model)) for o in self.observations)
        return total / sum(float(o.N) for o in self.observations)

    def _start(self):
        """A scene of round Gaussians of the true fluxes, its parameters free."""
        s2 = self.package
        axis = np.arange(BOX_PX) - BOX_PX // 2
        blob = np.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / START_PX**2).astype(np.float32)
        with s2.Scene(self.frame) as scene:
            for place, model in zip(self.truth.positions, self.truth.models):
                flux = np.maximum(model.sum(axis=(1, 2)), 1e-3).astype(np.float32)
                s2.Source(np.asarray(place, np.float32), flux / blob.sum(), np.clip(blob, 1e-6, 1))
        free_parameters(s2, scene, spectrum=SPECTRUM_STEP, morphology=MORPHOLOGY_STEP)
        return scene


def _middled(psf):
    """PSF images of odd sides whose middle pixel is the centre, as scarlet2 takes them."""
    whole = np.rint(psf.center[0]).astype(int)
    half = min(*whole, *(np.array(psf.images.shape[1:]) - 1 - whole))
    y, x = (slice(c - half, c + half + 1) for c in whole)
    return np.ascontiguousarray(psf.images[:, y, x], np.float32)


def rows_of(name, truth, n_iterations):
    """Both renderers on one scene."""
    scene = Scarlet2(truth)
    for renderer in ("scarlet2", "clresample"):
        scene.match(renderer == "clresample")
        render_db = scene.render_db()
        models, chi2, seconds = scene.fit(n_iterations)
        yield {
            "scene": name,
            "renderer": renderer,
            "n_sources": len(truth.models),
            "iterations": n_iterations,
            "render_db": render_db,
            "truth_chi2": scene.chi2(truth.models.sum(axis=0).astype(np.float32)),
            "sdr": float(np.median([decibel(t, m) for t, m in zip(truth.models, models)])),
            "chi2": chi2,
            "seconds": seconds,
        }


def main(options):
    threads = on_all_cores()
    scenes = {"turned": turned()}
    data = data_folder() / "hst_hsc"
    if data.is_dir() and not options.quick:
        scenes["tutorial"] = tutorial(data)
    rows = (row for scene in scenes.items() for row in rows_of(*scene, options.iterations))
    records.show(COLUMNS, rows, records.record(threads), options.json)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "the turned scene only")
    parser.add_number("iterations", "of each fit", 300)
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
