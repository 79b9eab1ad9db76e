"""Stamps of one galaxy as all methods render it, and how far each is from the truth."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from clresample.paper.operator.resampler import PaperResampler
from clresample.simulation.galaxies import draw
from clresample.simulation.sdr import sdr

from ..harness.cases import Case, Galaxies

N_OBS = 60  # [pixels] side of the observed stamp, the paper's
METHODS = ("ours", "ours64", "paper", "quintic", "sinc")


@dataclass(frozen=True)
class Stamp(Case):
    """A survey case whose observed stamp has a fixed size.

    field_arcsec [arcsec]: stamps are cut from drawings of this much sky, if they are smaller.
        GalSim draws by FFT, in a box that may be too small for a galaxy: its light folds back in.
    """

    n_obs: int = N_OBS
    field_arcsec: float = 0.0


def stamp(surveys, pair, *, padding=1.0, field_arcsec=0.0):
    """The case of a survey pair, its model stamp `padding` times the observed stamp's sky."""
    survey_in, survey_out = (surveys[name] for name in pair)
    n_model = survey_in.n_same_sky(N_OBS, survey_out)
    border = round((padding - 1) * n_model / 2)
    return Stamp(survey_in, survey_out, n_model + 2 * border, field_arcsec=field_arcsec)


@functools.cache
def renderers(case):
    """Method -> function from model stamps (B, N, N) to observed ones, made once in a process."""

    def operator(dtype, **options):
        op = case.operator(dtype=dtype, **options)
        return lambda models: op(models[:, None].astype(dtype))[:, 0]

    def galsim(interpolant):
        render = case.galsim(interpolant)
        return lambda models: np.stack([render(model) for model in models])

    return {
        "ours": operator(np.float32),
        "ours64": operator(np.float64),
        "paper": operator(np.float32, scheme=PaperResampler),
        "quintic": galsim("quintic"),
        "sinc": galsim("sinc"),
    }


def drawn(case, galaxy):
    """Model stamp and truth, as GalSim draws them; one and the same where the surveys are."""
    model = draw_stamp(galaxy, case.survey_in, case.n_model, case.field_arcsec)
    if (case.survey_in, case.n_model) == (case.survey_out, case.n_obs):
        return model, model
    return model, draw_stamp(galaxy, case.survey_out, case.n_obs, case.field_arcsec)


def draw_stamp(galaxy, survey, n_pixels, field_arcsec):
    border = max(0, math.ceil((field_arcsec / survey.pixel_scale_arcsec - n_pixels) / 2))
    grid = survey.grid(n_pixels + 2 * border)
    drawing = draw(galaxy, grid, psf_sigma_arcsec=survey.psf_sigma_arcsec[0])
    return drawing[border : border + n_pixels, border : border + n_pixels]


def edge_light(image):
    """Norm of the outermost pixels over that of all: how bright the light is that the edge cuts."""
    edge = image.copy()
    edge[1:-1, 1:-1] = 0
    return np.linalg.norm(edge) / np.linalg.norm(image)


@functools.cache
def open_galaxies(folder):
    return Galaxies(folder)


def measure(case, folder, start, stop):
    """Relative errors |X~ - X| / |X| of `METHODS`, then edge light, for each galaxy."""
    galaxies = open_galaxies(folder)
    pairs = [drawn(case, galaxies.take(i, case)) for i in range(start, stop)]
    models, truths = map(np.stack, zip(*pairs))
    columns = [
        10 ** (-sdr(truths, render(models), unit_sum=True) / 10)
        for render in renderers(case).values()
    ]
    columns.append([edge_light(model) for model in models])
    return [[float(f"{value:.4g}") for value in row] for row in zip(*columns)]
