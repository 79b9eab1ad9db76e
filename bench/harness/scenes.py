"""Simulated Euclid + Rubin scenes as blends to fit, and how well they were fitted."""

from __future__ import annotations

import functools
import time
import warnings
from dataclasses import replace

import numpy as np
from astropy.table import Table

from clresample import PSF, deblend_many
from clresample.deblending.blend import Blend
from clresample.measurement.quality import summary
from clresample.simulation.scenes import simulate_scene
from clresample.simulation.sdr import sdr
from clresample.simulation.surveys import NOTEBOOK_SURVEYS
from clresample.sky.frame import model_frame
from clresample.sky.sources import ExtendedSource, SourceWarning

from .cases import Case, Galaxies
from .options import data_folder

# Each mode's instruments; the model always lives on Euclid's pixels, those of the truth.
MODES = {"rubin": ("rubin",), "euclid": ("euclid",), "joint": ("euclid", "rubin")}
COLOURS_FILE = "catsim_ugrizy.fits"
# Relative change of a PSF that makes its operators new ones, and changes no result.
NUDGE = 1e-9


class Scenes:
    """Scenes by their seed, of COSMOS galaxies with CatSim colours where the data folder has them.

    folder: of the COSMOS galaxies; None looks for it as `cases.Galaxies` does
    name: galaxies and colours, for the record
    """

    def __init__(self, folder=None):
        galaxies = Galaxies(folder)
        path = data_folder() / COLOURS_FILE
        self.catalogue = galaxies.catalogue
        self.colours = Table.read(path) if path.is_file() else None
        self.name = f"{galaxies.name}, {'power-law' if self.colours is None else 'CatSim'} colours"

    def take(self, seed, **geometry):
        """`SimulatedScene` of a seed; geometry: angle_deg, flip, center_deg of `simulate_scene`."""
        return simulate_scene(seed, catalogue=self.catalogue, colours=self.colours, **geometry)


@functools.cache
def opened(folder):
    """The Scenes of a catalogue folder, opened once in each process."""
    return Scenes(folder)


def blend(scene, mode, *, profiles=None):
    """The Blend of a scene in one of MODES: images, true positions, Euclid's pixels.

    profiles (S, Ny, Nx): where the morphologies start; None leaves that to the fit
    """
    observations = tuple(getattr(scene, name).observation() for name in MODES[mode])
    if profiles is None:
        profiles = [None] * len(scene.profiles)
    sources = tuple(
        ExtendedSource(position_px=tuple(position), profile=profile)
        for position, profile in zip(scene.euclid.positions_px, profiles, strict=True)
    )
    return Blend(observations, sources, model_frame(observations, grid=scene.euclid.grid))


def fit(blends, **options):
    """`deblend_many`; simulated sources under the noise are expected, and not warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SourceWarning)
        return deblend_many(blends, **options)


def as_new(scene, rng):
    """The same scene with PSFs changed by 1e-9: no operator was made for them yet."""

    def nudged(image):
        noise = rng.standard_normal(image.psf.images.shape)
        return replace(image, psf=PSF(image.psf.images * (1 + NUDGE * noise)))

    return replace(scene, euclid=nudged(scene.euclid), rubin=nudged(scene.rubin))


def with_noise(scene, rng):
    """The same scene with other noise."""
    return replace(scene, euclid=scene.euclid.with_noise(rng), rubin=scene.rubin.with_noise(rng))


def scores(result, scene):
    """SDR [dB] of each source's morphology, against its truth on Euclid's pixels, both of sum 1.

    Of several components each counts by its counts in all channels; the truth has one colour.
    """
    models = np.zeros_like(scene.euclid.truth)
    for component in result.components:
        (y, x), (n_y, n_x) = component.origin, component.morphology.shape
        counts = max(component.spectrum.sum(), 1e-30)  # one without light keeps its morphology
        models[component.source, y : y + n_y, x : x + n_x] += counts * component.morphology
    return sdr(scene.euclid.truth, models, unit_sum=True).tolist()


def chi2(result):
    """Chi2 per pixel {instrument: over all its channels}."""
    found = summary(result)
    total = {}
    for o in result.observations:
        n = np.array([found["n_pixels"][name] for name in o.channels])
        total[o.name] = float(n @ [found["chi2"][name] for name in o.channels] / n.sum())
    return total


def chi2_of_all(result):
    """Chi2 per pixel over all channels of all instruments."""
    found = summary(result)
    n = np.array(list(found["n_pixels"].values()))
    return float(n @ list(found["chi2"].values()) / n.sum())


def iterations(result):
    """Number of iterations of a fit."""
    return summary(result)["n_iterations"]


class GalSimClock:
    """Times GalSim quintic renders of one stamp, EUCLID -> RUBIN at N = 118.

    Fits are compared with it: what slows the machine down for a while slows both.

    timer: seconds as `time.perf_counter` has them, or `time.process_time`
    """

    N_MODEL = 118

    def __init__(self, galaxies=None, *, timer=time.perf_counter):
        case = Case(NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"], self.N_MODEL)
        self._render = case.galsim()
        self._stamp, _ = case.draw((galaxies or Galaxies()).take(0, case))
        self._render(self._stamp)
        self.timer, self.times_s = timer, []

    def tick(self):
        """Time one render."""
        start = self.timer()
        self._render(self._stamp)
        self.times_s.append(self.timer() - start)

    def ticks(self, n):
        """Time `n` renders."""
        for _ in range(n):
            self.tick()

    def take_ms(self):
        """Median [ms] of the renders since the last call."""
        times, self.times_s = self.times_s, []
        return float(np.median(times)) * 1e3
