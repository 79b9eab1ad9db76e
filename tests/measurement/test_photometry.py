"""Fluxes, their covariances and shares of the data, against closed forms."""

import numpy as np
import pytest
from astropy import units as u
from helpers.blends import (
    MIDDLE,
    SCALE,
    blend,
    observe,
    round_component,
    two_sources,
)

from clresample.deblending.posterior.errors import Errors
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.photometry import channel_covariances, fluxes, redistribute
from clresample.sky.grid import Grid
from clresample.sky.sources import ExtendedSource, PointSource


def test_fluxes_add_up_over_components_with_their_covariances():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    result = two_sources(covariance=covariance)
    flux, found = fluxes(result)
    a, b, c = (component.morphology.sum() for component in result.components)
    np.testing.assert_allclose(flux, [[2 * a + 0.5 * b, a + 3 * b], [c, 4 * c]], rtol=1e-14)
    v = covariance
    np.testing.assert_allclose(
        found[:, 0, 0],
        a**2 * v[:, 0, 0] + b**2 * v[:, 1, 1] + 2 * a * b * v[:, 0, 1],
        rtol=1e-13,
    )
    np.testing.assert_allclose(found[:, 0, 1], a * c * v[:, 0, 2] + b * c * v[:, 1, 2], rtol=1e-12)
    np.testing.assert_allclose(found, found.transpose(0, 2, 1), rtol=1e-12)
    table = catalogue(result)
    np.testing.assert_allclose(table["flux_err_r"].value, np.sqrt([found[1, 0, 0], found[1, 1, 1]]))
    snr = np.sqrt((flux**2 / np.diagonal(found, axis1=1, axis2=2).T).sum(axis=1))
    np.testing.assert_allclose(table["snr"], snr, rtol=1e-13)


def test_a_gaussians_flux_and_error_are_the_closed_ones():
    # variance A of a spectrum of one Gaussian in white noise: 1 / sum w S^2 = 1 / (w pi sigma^2)
    weight, sigma = 4.0, 1.5
    variance = 1 / (weight * np.pi * sigma**2)
    covariance = variance * np.ones((2, 1, 1))
    table = catalogue(blend([round_component(0, MIDDLE, (3.0, 5.0))], covariance=covariance))
    np.testing.assert_allclose(table["flux_r"].value, 5 * 2 * np.pi * sigma**2, rtol=1e-7)
    np.testing.assert_allclose(
        table["flux_err_r"].value, 2 * np.sqrt(np.pi / weight) * sigma, rtol=1e-7
    )
    assert table["flux_r"].unit == u.ct


def test_zero_points_bring_fluxes_into_one_system():
    grid = Grid.flat((60, 70), SCALE)
    observations = (
        observe(grid, ("g", "r"), zero_points=[23.9, 28.9], name="one"),
        observe(grid, ("i",), zero_points=21.4, name="two"),
    )
    result = blend([round_component(0, MIDDLE, (1, 1, 0))], observations=observations)
    table = catalogue(result, magnitudes=True)
    counts = result.components[0].morphology.sum()
    for channel, scale, flux in (("g", 1, 1), ("r", 0.01, 1), ("i", 10, 0)):
        assert table[f"flux_{channel}"].unit == table[f"flux_err_{channel}"].unit == u.uJy
        found = [table[f"flux_{channel}"].value[0], table[f"flux_err_{channel}"].value[0]]
        np.testing.assert_allclose(found, [flux * scale * counts, scale * counts], rtol=1e-13)
    magnitude = table["flux_r"].to(u.ABmag).value
    np.testing.assert_allclose(table["mag_r"].value, magnitude, atol=1e-12)
    np.testing.assert_allclose(table["mag_err_g"].value, 1.0857362, rtol=1e-7)
    assert np.isnan(table["mag_i"]).all()
    assert catalogue(result).colnames == table.colnames
    assert "mag_g" not in catalogue(result, magnitudes=False).colnames
    assert "mag_g" not in catalogue(two_sources()).colnames


def test_fluxes_that_a_channel_does_not_determine_are_unknown():
    covariance = np.tile(np.eye(3) + 0.1, (2, 1, 1))
    covariance[0, 1] = covariance[0, :, 1] = np.nan
    covariance[0, 1, 1] = np.inf
    result = two_sources(covariance=covariance)
    table = catalogue(result)
    assert np.isnan([table["flux_g"][0].value, table["flux_err_g"][0].value]).all()
    assert np.isfinite([table["flux_err_g"][1].value, table["flux_err_r"][0].value]).all()
    assert list(table["flags"]) == [Flag.NO_COVERAGE, 0]
    a, b, c = (component.morphology.sum() for component in result.components)
    error = np.sqrt(1.1 * (a**2 + b**2) + 0.2 * a * b)
    np.testing.assert_allclose(table["snr"][0], (a + 3 * b) / error, rtol=1e-13)
    np.testing.assert_allclose(fluxes(result)[1][0], [[np.nan, 0], [0, 1.1 * c**2]])


@pytest.mark.parametrize(
    "first, kind, n_exposures, known",
    [  # columns from `first` on, 2 to 6 px from the centre, hold 16, 5, 0.1 and 0.01 % of the light
        (37, ExtendedSource, 1, True),
        (38, ExtendedSource, 1, False),
        (38, ExtendedSource, 2, True),  # exposures of one band
        (40, PointSource, 1, True),
        (41, PointSource, 1, False),
    ],
)
def test_pixels_with_hardly_any_of_the_light_determine_no_flux(first, kind, n_exposures, known):
    grid, weights = Grid.flat((60, 70), SCALE), np.full((60, 70), 1e-12)
    weights[:, :first] = 0
    observations = [observe(grid, ("g",), weights=1e-12)]
    observations += [
        observe(grid, (f"r{i}",), weights=weights, bands=("r",)) for i in range(n_exposures)
    ]
    given = {"observations": observations, "sources": [kind(position_px=MIDDLE)]}
    result = blend([round_component(0, MIDDLE, np.ones(1 + n_exposures))], **given)
    table = catalogue(result)
    assert np.isfinite([table["flux_r"][0].value, table["flux_err_r"][0].value]).all() == known
    assert np.isfinite(table["flux_g"][0].value)
    assert bool(table["flags"][0] & Flag.NO_COVERAGE) != known


def test_shares_add_up_to_the_data_in_the_models_proportions():
    rng = np.random.default_rng(5)
    data = rng.normal(5, 1, (2, 60, 70))
    weights = np.ones(data.shape)
    weights[0, 30, 30] = 0
    grid = Grid.flat((60, 70), SCALE)
    sky = np.array([0.5, -0.5])
    observations = [observe(grid, ("g", "r"), data=data, weights=weights)]
    result = two_sources(observations=observations, sky=sky)
    shares = redistribute(result, 0)
    assert np.isnan(shares[:, 0, 30, 30]).all() and np.isnan(shares).sum() == 2
    total = np.array([result.source_model(i, 0) for i in range(2)]).sum(axis=0)
    lit = (total > 1e-5 * total.max(axis=(1, 2), keepdims=True)) & (weights > 0)
    above = data - sky[:, None, None]
    np.testing.assert_allclose(shares.sum(axis=0)[lit], above[lit], rtol=1e-12)
    assert not np.nan_to_num(shares[:, ~lit]).any() and (~lit).sum() > 1000
    np.testing.assert_allclose(
        shares[1, 1, 30, 40] / shares[0, 1, 30, 40],
        result.source_model(1, 0)[1, 30, 40] / result.source_model(0, 0)[1, 30, 40],
        rtol=1e-12,
    )


def test_rounding_below_zero_gets_no_share():
    result = two_sources(observations=[observe(Grid.flat((60, 70), SCALE), ("g", "r"), data=1.0)])
    result.rendered[0].images[2][:, 30, 28] = -1e-7
    shares = redistribute(result, 0)
    assert (shares >= 0).all() and shares[0, 0, 30, 28] == 1


def test_colours_are_better_known_than_fluxes_that_err_together():
    """Errors of colours against draws of the two fluxes; without Errors channels are apart."""
    grid = Grid.flat((60, 70), SCALE)
    zero_points = {"zero_points": [30.0, 31.0]}
    component = round_component(0, MIDDLE, [100.0, 200.0])
    covariance = np.array([[[25.0, 45.0], [45.0, 100.0]]])
    flux = np.array([[[25.0]], [[100.0]]])
    maps, beyond = (component.morphology,), np.zeros((1, 6))
    unbound = np.zeros((1, 2)), np.zeros((1, 5)), np.zeros((1, 2))
    known = Errors(flux, covariance, np.full((1, 5, 5), np.nan), maps, beyond, *unbound)
    # as in `blend`, the data do not hold the model
    observations = [observe(grid, ("g", "r"), weights=1e-12, **zero_points)]
    total = component.flux
    for errors, both in ((known, covariance[0]), (None, np.diag([25.0, 100.0]))):
        apart = np.array([[[25.0]], [[100.0]]]) / component.morphology.sum() ** 2
        result = blend([component], observations=observations, errors=errors, covariance=apart)
        row = catalogue(result, magnitudes=True)[0]
        drawn = np.random.default_rng(0).multivariate_normal(total, both, 20000)
        colours = -2.5 * np.log10(drawn[:, 0] / drawn[:, 1])
        assert abs(row["colour_g_r"].value - (np.median(colours) - 1.0)) < 0.01
        np.testing.assert_allclose(row["colour_err_g_r"].value, colours.std(), rtol=0.03)
        np.testing.assert_allclose(channel_covariances(result)[0], both, rtol=1e-10)


def test_fluxes_hold_what_lies_beyond_the_boxes():
    """Of each component its own light there, the first of its sums; and what the bound adds is
    taken off."""
    parts = [round_component(0, (30, 28), (2.0, 1.0)), round_component(1, (30, 44), (1.0, 4.0))]
    beyond = np.arange(12.0).reshape(2, 6) + 3
    maps = tuple(c.morphology for c in parts)
    variance = np.tile(np.diag([4.0, 9.0]), (2, 1, 1))
    released = np.array([[0.5, -9.0], [0.0, 1.0]])
    moments = np.full((2, 5, 5), np.nan), maps, beyond, released, np.zeros((2, 5)), np.zeros((2, 2))
    errors = Errors(variance, np.ones((2, 2, 2)), *moments)
    flux, found = fluxes(blend(parts, errors=errors))
    flux = flux - released
    a, b = (c.morphology.sum() for c in parts)
    np.testing.assert_allclose(flux, [[2 * (a + 3), a + 3], [b + 9, 4 * (b + 9)]], rtol=1e-13)
    np.testing.assert_array_equal(found, variance)
