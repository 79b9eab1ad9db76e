"""Errors of what a fit assumes of the division of light between neighbours."""

from types import SimpleNamespace

import numpy as np
from helpers.blends import gaussian
from helpers.scenes import blend, fit

from clresample.deblending.posterior import posterior, shared_light
from clresample.deblending.posterior.errors import Errors
from clresample.deblending.posterior.shared_light import (
    MAX_DOUBT,
    exchanged_light,
    flux_changes,
    with_shared_light,
)
from clresample.deblending.result import Component


def test_a_doubted_shape_has_less_of_the_datas_precision():
    """C' - C, whose root goes with C^-1: nothing at a factor of 1, the prior's variance at most."""
    half = np.random.default_rng(1).normal(size=(4, 4))
    known = np.linalg.inv(np.eye(4) + half @ half.T)
    for factor in (1.0, 5.0, 1e12):
        wanted = np.linalg.inv(np.eye(4) + half @ half.T / factor)
        root = known @ shared_light._added_root(known, factor)
        np.testing.assert_allclose(known + root @ root.T, wanted, atol=1e-7)


def test_structure_at_another_place_is_counted_there():
    """A bump of the neighbour's profile on a galaxy far wider is all the light that may be it."""
    small = gaussian((9, 9), (4, 4), 2 * np.eye(2))
    wide = gaussian((41, 41), (20, 20), 200 * np.eye(2))
    small, wide = small / small.max(), wide / wide.max()
    bumped = wide.copy()
    bumped[3:12, 5:14] += 0.1 * small
    spectra = np.array([[2.0, 3.0], [50.0, 70.0]])
    parts = ((0, 0), bumped, spectra[1]), ((3, 5), small, spectra[0])
    components = tuple(Component(i, *part) for i, part in enumerate(parts))
    result = SimpleNamespace(components=components, sources=(0, 1), channels="gr")
    origin = np.array([(0, 0), (3, 5)])
    given = {"profile": [wide, small], "origin": origin, "fixed": np.array([False, False])}
    found = exchanged_light(result, np.arange(2), SimpleNamespace(**given))
    np.testing.assert_allclose(found[1, 0], 0.1 * small.sum() * spectra[1], rtol=0.02)
    assert not found[0, 1].any() and not found[[0, 1], [0, 1]].any()
    given["fixed"] = np.array([True, False])  # a star has no structure
    assert not exchanged_light(result, np.arange(2), SimpleNamespace(**given)).any()
    assert not exchanged_light(result, np.zeros(2, int), SimpleNamespace(**given)).any()


def test_exchanged_light_leaves_the_sum_of_two_fluxes_alone():
    rng = np.random.default_rng(3)
    exchanged, doubts = np.zeros((3, 3, 2)), rng.normal(size=(3, 2, 4))
    exchanged[0, 1], exchanged[1, 0] = (3.0, 4.0), (5.0, 0.0)
    flux, colour = np.zeros((2, 3, 3)), np.zeros((3, 2, 2))
    nothing = np.zeros((3, 5, 5)), (), np.zeros((3, 6)), np.zeros((3, 2)), np.zeros((3, 5))
    errors = Errors(flux, colour, *nothing, np.zeros((3, 2)))
    assert with_shared_light(errors, doubts[..., :0], 0 * exchanged) is errors
    found = with_shared_light(errors, doubts[..., :0], exchanged)
    np.testing.assert_allclose(found.flux[0], [[34, -34, 0], [-34, 34, 0], [0, 0, 0]])
    np.testing.assert_allclose(found.colour[0], found.colour[1])
    np.testing.assert_allclose(found.colour[0], [[34, 12], [12, 16]])
    found = with_shared_light(errors, doubts, exchanged)
    np.testing.assert_allclose(found.colour[2], doubts[2] @ doubts[2].T)
    np.testing.assert_allclose(found.flux[1, 0, 2], doubts[0, 1] @ doubts[2, 1])
    changes, rng = flux_changes(doubts, exchanged), np.random.default_rng(0)
    drawn = np.array([changes.draw(3, rng) for _ in range(4000)])  # (n, S, C)
    scale = np.sqrt(np.diagonal(found.flux, axis1=1, axis2=2))
    products = np.einsum("nsc,ntc->cst", drawn, drawn) / len(drawn)
    correlation = (products - found.flux) / (scale[:, :, None] * scale[:, None])
    np.testing.assert_allclose(correlation, 0, atol=0.06)
    assert flux_changes(0 * doubts, 0 * exchanged) is None
    of_both = np.diagonal(found.colour, axis1=1, axis2=2), np.diagonal(found.flux, axis1=1, axis2=2)
    np.testing.assert_allclose(of_both[0], of_both[1].T)


def test_a_faint_galaxy_in_a_bright_ones_light_is_less_certain(device, monkeypatch):
    """By half of its flux at most, for its shape is held; one that is alone stays as it is."""
    objects = (
        ((14, 14), (300, 250, 280), 3.0),
        ((19, 14), (12, 9, 10), 1.2),
        ((14, 44), (12, 9, 10), 1.2),
    )
    seen = []

    def spied(errors, doubts, exchanged):
        seen.append(doubts)
        return with_shared_light(errors, doubts, exchanged)

    monkeypatch.setattr(posterior, "with_shared_light", spied)
    result = fit(blend(objects, shape=(30, 60), seed=5), device)
    flux = np.linalg.norm([c.flux for c in result.components], axis=1)
    doubt = np.linalg.norm(seen[0], axis=(1, 2))
    assert 0.2 * flux[1] < doubt[1] < 1.01 * MAX_DOUBT * flux[1]
    assert doubt[2] < 1e-3 * flux[2]
    variance = np.diagonal(result.errors.flux, axis1=1, axis2=2)
    assert (variance >= np.square(seen[0]).sum(axis=2).T).all()
