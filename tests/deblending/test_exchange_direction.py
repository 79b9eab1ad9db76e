"""Directions by which a source's structure takes over a neighbour's light, against the model."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from clresample.deblending.solver.multiscale.evidence import LocalPowerSpectra, SourceEvidence
from clresample.deblending.solver.multiscale.exchange_direction import find_exchange_directions
from clresample.deblending.solver.multiscale.prior import MultiscalePrior, kernel_rows
from clresample.deblending.solver.scene_model import compose

FRAME, STRENGTHS = (44, 48), np.array([0.1, 0.3, 0.3])
SPECTRA = np.array([[30.0, 20.0], [5.0, 9.0]])
PRIOR = MultiscalePrior()


def answers(widths=(1.0, 2.5)):
    """R^T w R of one pixel in each channel: smooth, of the widths [px], and the pixel."""
    lag = np.arange(-20, 21)
    found = [np.outer(*2 * [np.exp(-0.25 * (lag / w) ** 2)]) * 50 for w in widths]
    return np.array(found), np.full((len(widths), 2), 20)


def gaussian(shape, center, sigma):
    y, x = (np.arange(n) - c for n, c in zip(shape, center, strict=True))
    return np.exp(-0.5 * (y[:, None] ** 2 + x**2) / sigma**2).astype(np.float32)


def made(*, spectra=SPECTRA, origin=(10, 14), fixed=(False, True), edge=0.0):
    """A galaxy over the whole frame and a smaller one: scene, state, evidence.

    edge: the galaxy has no light in the columns beyond this part of its box
    """
    profile = [gaussian(FRAME, (20, 22), 9.0), gaussian((19, 21), (9, 10), 3.0)]
    morph = [profile[0].copy(), profile[1]]
    if edge:
        morph[0][:, int(edge * FRAME[1]) :] = 0
    found, places = answers()
    response = LocalPowerSpectra(PRIOR).from_impulse_responses(found, places)
    evidence = [SourceEvidence(LocalPowerSpectra(PRIOR), PRIOR, p, response) for p in profile]
    curvature = [[(fftconvolve(p, lags, "same") * p).sum() for lags in found] for p in profile]
    scene = SimpleNamespace(
        origin=np.array([(0, 0), origin]),
        profile=profile,
        fixed=np.array(fixed),
        spectrum_curvature=np.array(curvature),
    )
    state = SimpleNamespace(morph=morph, spectra=np.array(spectra))
    return scene, state, evidence


def found_of(scene, state, evidence):
    return find_exchange_directions(scene, state, evidence, np.tile(STRENGTHS, (2, 1)))


def change_of(direction, scene, state):
    """Changes of the model (C, Ny, Nx) along a direction, and of |z|^2 / alpha^2."""
    p, i = scene.profile[direction.source], direction.source
    sides = [[kernel_rows(PRIOR, j, n) for n in p.shape] for j in range(3)]
    sizes = [(len(y), len(x)) for y, x in sides]
    ends = np.cumsum([a * b for a, b in sizes])
    flat = np.zeros(ends[-1])
    flat[direction.places] = direction.values
    z = [a.reshape(n) for a, n in zip(np.split(flat, ends[:-1]), sizes, strict=True)]
    u = np.sqrt(p) * sum(y.T @ a @ x for a, (y, x) in zip(z, sides, strict=True))
    gain = np.where(state.morph[i] > 0, u - p * (p * u).sum() / (p * p).sum(), 0)
    model = compose(FRAME, scene.origin[[i]], [gain], state.spectra[[i]])
    model += compose(FRAME, scene.origin, state.morph, direction.spectra)
    return model, sum((a**2).sum() / s**2 for a, s in zip(z, STRENGTHS, strict=True))


def data_curvature(model):
    pairs = zip(model, answers()[0], strict=True)
    return sum((fftconvolve(image, lags, "same") * image).sum() for image, lags in pairs)


def test_the_model_hardly_changes_along_a_direction_of_curvature_one():
    """By its structure alone the model would change a thousand times as much."""
    scene, state, evidence = made()
    (direction,) = found_of(scene, state, evidence)
    assert direction.source == 0 and direction.spectra[1].max() < 0
    model, by_prior = change_of(direction, scene, state)
    assert data_curvature(model) + by_prior == pytest.approx(1, rel=0.03)
    still = replace(direction, spectra=np.zeros((2, 2)))
    alone, _ = change_of(still, scene, state)
    assert data_curvature(alone) > 1000 * data_curvature(model)


def test_a_spectrum_that_is_zero_stays_and_its_channel_counts():
    scene, state, evidence = made(spectra=[[30.0, 0.5], [5.0, 0.0]])
    (direction,) = found_of(scene, state, evidence)
    assert direction.spectra[1, 0] < 0 == direction.spectra[1, 1]
    model, by_prior = change_of(direction, scene, state)
    assert data_curvature(model) + by_prior == pytest.approx(1, rel=0.03)
    assert not found_of(*made(spectra=[[30.0, 60.0], [5.0, 0.0]]))  # 60 is held in place


@pytest.mark.parametrize(
    "given",
    [
        {"origin": (36, 30)},  # most of it outside
        {"edge": 0.5},  # in the part where the galaxy has no light
        {"fixed": (True, True)},
        {"spectra": [[3e-3, 2e-3], [5.0, 9.0]]},  # more light than the prior allows it
        {"spectra": [[30.0, 0.0], [0.0, 9.0]]},  # no channel has both
    ],
)
def test_no_direction_where_the_galaxy_cannot_take_over_the_light(given):
    assert not found_of(*made(**given))
