"""Other profiles beside the present fit: errors of other models, cores of another colour."""

import numpy as np
import pytest

from clresample.deblending.batch import deblend
from clresample.deblending.linear.spectra import MODEL_ERROR
from clresample.deblending.start import profile_fit, wide_light
from clresample.deblending.start.alternatives import Alternatives
from clresample.deblending.start.population import NEIGHBOUR_MODEL_ERROR, STAR_MODEL_ERROR
from clresample.measurement.catalogue import catalogue
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

SIGMA = 1.3  # [px] of the PSF


def light(shape, place, flux, sigma):
    y, x = np.indices(shape)
    s2 = sigma**2 + SIGMA**2
    away = (y - place[0]) ** 2 + (x - place[1]) ** 2
    return flux * np.exp(-away / (2 * s2)) / (2 * np.pi * s2)


def fitted(bands, places, device, kinds=None):
    """The Result of an Observation with noise 1 of {band: [(place, flux, sigma [px]), ...]}."""
    shape = (128, 128)
    data = np.array([sum(light(shape, *one) for one in own) for own in bands.values()])
    data += np.random.default_rng(0).normal(size=data.shape)
    psf = PSF.gaussian(SIGMA, n_bands=len(bands), pixel=False)
    o = Observation(data, psf, Grid.flat(shape, 0.1), weights=1.0, channels=list(bands))
    kinds = kinds or [ExtendedSource] * len(places)
    sources = [kind(position_px=place) for kind, place in zip(kinds, places, strict=True)]
    return deblend([o], sources, frame=model_frame([o]), device=device)


def test_products_with_errors_of_other_models(device, monkeypatch):
    """Of present profiles they are those of the normal matrix; larger ones have more of them."""
    places, found = ((50.0, 50.0), (62.0, 56.0), (48.0, 66.0)), []

    def looked(fit, scenes):
        fit.solve_shapes(scenes)
        normal, spectra = fit.looking.normal[0][:, :3, :3].copy(), fit.looking.spectra.copy()
        thetas = fit.thetas()
        own = {i: [thetas[i], thetas[i] + [step, 0, 0, 0]] for i, step in ((1, 1.5), (0, 0.7))}
        fit.looking.compute_residuals(MODEL_ERROR)
        level = fit.looking.of_level()
        found.append((Alternatives(fit, own), normal, spectra))
        for before, after in zip(level, fit.looking.of_level(), strict=True):
            np.testing.assert_allclose(after, before, rtol=1e-6)  # that of all models

    monkeypatch.setattr(profile_fit, "fit_faint_shapes", looked)
    light_of = [(places[0], 3000.0, 3.0), (places[1], 500.0, 2.0), (places[2], 2000.0, 0.0)]
    kinds = [ExtendedSource, ExtendedSource, PointSource]
    fitted({"g": light_of, "r": light_of}, places, device, kinds)
    alternatives, normal, spectra = found[0]
    np.testing.assert_array_equal(alternatives.component, [1, 1, 0, 0])
    for k, i, j in ((0, 1, 0), (2, 0, 1)):
        wrong = NEIGHBOUR_MODEL_ERROR * normal[:, i, j] * spectra[j]
        wrong += STAR_MODEL_ERROR * normal[:, i, 2] * spectra[2]
        np.testing.assert_allclose(alternatives.wrong[k], wrong, rtol=2e-3)
        np.testing.assert_allclose(alternatives.alone[k], normal[:, i, i], rtol=1e-3)
        explained = normal[:, i, i] * spectra[i]
        np.testing.assert_allclose(alternatives.explained[k], explained, rtol=1e-3)
    error = alternatives.wrong / np.sqrt(alternatives.alone)
    assert (error[1] > 2 * error[0]).all()
    right, alone = alternatives.right, alternatives.alone
    full, certain = alternatives.full_gain(right, alone), alternatives.certain_gain(right, alone)
    assert (certain < full).all() and certain[1] / full[1] < 0.5 * certain[0] / full[0]


GALAXY = (62.3, 64.1)
FAINT = (((62, 90), 300.0), ((40, 50), 400.0), ((85, 75), 250.0), ((30, 80), 300.0))


def components_and_fluxes(device):
    """Numbers of components and pulls of a galaxy with a red core and four faint ones."""
    parts = {"g": (2e3, 8e4), "r": (8e4, 5e3)}
    faint = [(place, flux, 2.0) for place, flux in FAINT]
    bands = {
        band: [(GALAXY, core, 5.0), (GALAXY, disk, 14.0), *faint]
        for band, (core, disk) in parts.items()
    }
    result = fitted(bands, [GALAXY, *(place for place, _ in FAINT)], device)
    table = catalogue(result)
    pulls = []
    for band, own in parts.items():
        want = np.array([sum(own), *(flux for _, flux in FAINT)])
        pulls.append((table[f"flux_{band}"].value - want) / table[f"flux_err_{band}"].value)
    return table["n_components"].tolist(), np.array(pulls)


def test_a_core_of_another_colour_is_a_component_from_the_start(device, monkeypatch):
    n, pulls = components_and_fluxes(device)
    assert n == [2, 1, 1, 1, 1] and np.abs(pulls).max() < 3
    monkeypatch.setattr(wide_light, "_narrower", lambda *_: [])
    n, _ = components_and_fluxes(device)
    assert sum(n) > 6  # a faint one grows into what one component left


@pytest.mark.parametrize("bands", ["gr", "g"])
def test_a_core_of_the_galaxys_colour_is_none(device, bands):
    parts = [(GALAXY, 2e4, 5.0), (GALAXY, 4e4, 14.0)]
    table = catalogue(fitted(dict.fromkeys(bands, parts), [GALAXY], device))
    assert table["n_components"].tolist() == [1]
