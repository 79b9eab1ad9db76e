"""Neighbours of a bright star with a slightly wrong PSF: the effect of Settings.psf_error.

    python -m bench.stars [--quick] [--scenes N] [--json FILE]

Each scene has a star in its middle and five galaxies 0.7 to 2.4 arcsec from it, of signal to noise
20 to 200 in each channel, seen in 0.1 arcsec pixels (one channel) and in 0.2 (two). PSFs are Moffat
profiles; the fit is given the same ones in every row. Same scenes, same noise:

psf         the true one: right; or wider, elongated (1 + 2 x, in squared axes) or with four spikes
            that hold a part x of the light
snr         the star's, in each channel
psf_error   of the Settings: 0, or their default
n           fluxes of galaxies
sdr         [dB] mean SDR of the galaxies' models against their truth, both of unit sum
coverage    share of |flux - truth| < error: 0.683 where errors are right and normal
typical     median of |flux / truth - 1|; worst: its 90 % quantile
stated      median of error / truth
star        median of |flux / truth - 1| of the star
"""

from __future__ import annotations

import itertools
import warnings

import numpy as np

from clresample import (
    PSF,
    ExtendedSource,
    Frame,
    Grid,
    Observation,
    PointSource,
    Resampler,
    Settings,
    fluxes,
    get_device,
)
from clresample.deblending.blend import Blend
from clresample.deblending.profiles import draw_psf, profile, psf_second_moment
from clresample.simulation.sdr import sdr

from .harness import records, scenes
from .harness.clock import in_chunks, in_processes, on_one_thread
from .harness.options import Parser, n_scenes, run

PSFS = {
    "right": (),
    "wider 1 %": ("wider", 0.01),
    "wider 3 %": ("wider", 0.03),
    "wider 5 %": ("wider", 0.05),
    "elongated 3 %": ("elongated", 0.03),
    "spikes 1 %": ("spikes", 0.01),
}
SNRS = (1e3, 1e4, 1e5)
QUICK = {"psfs": ("right", "wider 3 %"), "snrs": (1e4,)}
N_SCENES, N_QUICK = 12, 3
CHUNK = 3
N_MODEL = 72  # [px] a side
MODEL_PSF = PSF.gaussian(0.8, n_pixels=25)
# Instruments: grid, FWHM [px] of each channel's PSF, its Moffat beta, its image's side, names
INSTRUMENTS = (
    (Grid.flat((N_MODEL, N_MODEL), 0.1), (1.8,), 4.0, 41, ("v",)),
    (Grid.flat((N_MODEL // 2, N_MODEL // 2), 0.2), (3.5, 3.2), 3.0, 31, ("r", "i")),
)
FINE = 5  # points along a pixel's side, over which a PSF is summed
N_GALAXIES = 5
AWAY_PX = (7.0, 24.0)
SNR_RANGE = (20.0, 200.0)
LOG_SIZE = (np.log(2.5), 0.3)  # ln of sigma [px], mean and scatter
ELLIPTICITY = 0.26  # scatter of a component
GIVEN_PX = 0.15  # scatter of the star's position, which is fitted, about the one given
COLUMNS = records.columns(
    "psf:13 snr:7g psf_error:9g n:5d sdr:6.2f coverage:8.3f typical:7.3f worst:7.3f "
    "stated:7.3f star:7.4f"
)


def moffat(fwhm, beta, n, how=None, part=0.0):
    """Image (n, n) of a Moffat PSF, pixel response included; how, part: see PSFS."""
    along = (np.arange(n * FINE) - (n * FINE - 1) / 2) / FINE
    y, x = np.meshgrid(along, along, indexing="ij")
    radius = fwhm / 2 / np.sqrt(2 ** (1 / beta) - 1) * (1 + part * (how == "wider"))
    stretch = 2 * part * (how == "elongated")
    image = (1 + ((1 + stretch) * y**2 + (1 - stretch) * x**2) / radius**2) ** -beta
    image /= image.sum()
    if how == "spikes":  # of an exponential length of 2.5 FWHM
        spikes = sum(np.exp(-np.abs(a) / (2.5 * fwhm) - b**2) for a, b in ((y, x), (x, y)))
        image = (1 - part) * image + part * spikes / spikes.sum()
    return image.reshape(n, FINE, n, FINE).sum(axis=(1, 3))


def psf_of(instrument, *wrong):
    """The PSF of one of INSTRUMENTS."""
    _, widths, beta, n, _ = instrument
    return PSF(np.stack([moffat(width, beta, n, *wrong) for width in widths]))


def make_scene(seed, psf, snr):
    """A Blend, the true fluxes (S, 3), the star's first, and true images (S, Ny, Nx)."""
    rng = np.random.default_rng(seed)
    star = (N_MODEL - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
    positions, images = [star], [draw_psf(MODEL_PSF, star, (N_MODEL,) * 2, slopes=False)[0]]
    for _ in range(N_GALAXIES):
        distance, angle = rng.uniform(*AWAY_PX), rng.uniform(0, 2 * np.pi)
        positions.append(star + distance * np.array([np.sin(angle), np.cos(angle)]))
        theta = rng.normal(*LOG_SIZE), *rng.normal(0, ELLIPTICITY, 2), np.log(5.0)
        images.append(
            profile(np.array(theta), positions[-1], (N_MODEL,) * 2, psf_second_moment(MODEL_PSF))[0]
        )
    snrs = np.array([snr, *np.exp(rng.uniform(*np.log(SNR_RANGE), N_GALAXIES))])
    observations, fluxes_of = [], []
    for i, instrument in enumerate(INSTRUMENTS):
        grid, channels, model = instrument[0], instrument[-1], INSTRUMENTS[0][0]
        true = psf_of(instrument, *PSFS[psf])
        dtype = np.float64 if get_device().has_fp64 else np.float32
        units = Resampler(model, MODEL_PSF, grid, true, dtype=dtype).render(np.array(images))
        flux = snrs[:, None] / np.sqrt((units**2).sum(axis=(2, 3)))
        flux *= rng.uniform(0.6, 1.4, flux.shape)
        data = np.einsum("sc,scyx->cyx", flux, units) + rng.normal(size=units.shape[1:])
        observations.append(
            Observation(data, psf_of(instrument), grid, weights=1.0, channels=channels, name=str(i))
        )
        fluxes_of.append(flux)
    given = tuple(star + rng.normal(0, GIVEN_PX, 2))
    galaxies = (ExtendedSource(position_px=tuple(p)) for p in positions[1:])
    sources = PointSource(position_px=given, free_position=True), *galaxies
    frame = Frame(INSTRUMENTS[0][0], MODEL_PSF)
    return Blend(tuple(observations), sources, frame), np.concatenate(fluxes_of, 1), images


def measure(psf, snr, seeds):
    """Values {psf_error: [(flux (S, 3), error, truth, SDRs), ...]} of scenes of these seeds."""
    warnings.simplefilter("ignore")  # of Moffat PSFs that are cut at their image's edge
    found, values = [make_scene(seed, psf, snr) for seed in seeds], {}
    for psf_error in (0.0, Settings().psf_error):
        blends = [blend for blend, _, _ in found]
        results = scenes.fit(blends, settings=Settings(psf_error=psf_error))
        values[psf_error] = [
            (*_fluxes(result), truth, _sdrs(result, images))
            for result, (_, truth, images) in zip(results, found, strict=True)
            if result.status != "failed"
        ]
    return values


def _fluxes(result):
    flux, covariance = fluxes(result)
    return flux, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)


def _sdrs(result, images):
    models = np.stack([result.source_model(s).sum(axis=0) for s in range(1, len(images))])
    return sdr(np.array(images[1:]), models, unit_sum=True)


def row_of(values):
    """Statistics of the values of one row."""
    flux, error, truth = (np.array([v[i] for v in values]) for i in range(3))
    away = np.abs(flux / truth - 1)
    galaxies = away[:, 1:].ravel()
    return {
        "n": galaxies.size,
        "sdr": float(np.mean([v[3] for v in values])),
        "coverage": float((np.abs(flux - truth) < error)[:, 1:].mean()),
        "typical": float(np.median(galaxies)),
        "worst": float(np.quantile(galaxies, 0.9)),
        "stated": float(np.median((error / truth)[:, 1:])),
        "star": float(np.median(away[:, 0])),
    }


def main(options):
    threads = on_one_thread()
    seeds = range(options.seed, options.seed + n_scenes(options))
    psfs, snrs = (QUICK["psfs"], QUICK["snrs"]) if options.quick else (tuple(PSFS), SNRS)
    record = records.record(threads) | {
        "scenes": f"{len(seeds)} from seed {options.seed}",
        "settings": f"{Settings()}",
    }
    chunks, cases = in_chunks(seeds, CHUNK), list(itertools.product(snrs, psfs))
    tasks = [(psf, snr, chunk) for snr, psf in cases for chunk in chunks]
    found = dict(in_processes(measure, tasks, options.processes, lambda task: len(task[-1])))
    rows = (
        {"psf": psf, "snr": snr, "psf_error": psf_error}
        | row_of([v for chunk in chunks for v in found[psf, snr, chunk][psf_error]])
        for snr, psf in cases
        for psf_error in (0.0, Settings().psf_error)
    )
    records.show(COLUMNS, rows, record, options.json)


def parser():
    parser = Parser(__doc__)
    parser.add_scenes(N_QUICK, N_SCENES, "how many of each")
    # the default psf_error was chosen on the scenes before these
    parser.add_seed(1000)
    parser.add_processes()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
