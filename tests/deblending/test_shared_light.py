"""Errors of what a fit assumes of the division of light between neighbours."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.blends import gaussian
from helpers.scenes import blend, fit

from clresample import PSF
from clresample.deblending.posterior import posterior
from clresample.deblending.posterior.errors import Errors
from clresample.deblending.posterior.shared_light import (
    MAX_DOUBT,
    RING_STEP,
    DoubtedShape,
    exchanged_light,
    flux_changes,
)
from clresample.deblending.profiles import SIZE_SCATTER, GalaxyProfile
from clresample.deblending.result import Component


def test_a_doubted_shape_has_less_of_the_datas_precision():
    """C' - C, whose root goes with C^-1: nothing at a factor of 1, the prior's variance at most."""
    half = np.random.default_rng(1).normal(size=(4, 4))
    known = np.linalg.inv(np.eye(4) + half @ half.T)
    for factor in (1.0, 5.0, 1e12):
        wanted = np.linalg.inv(np.eye(4) + half @ half.T / factor)
        shape = DoubtedShape.of(known, factor, np.arange(4))
        root = known @ shape.added_root
        np.testing.assert_allclose(known + root @ root.T, wanted, atol=1e-7)
        assert shape.size_scatter == pytest.approx(SIZE_SCATTER * np.sqrt(wanted[0, 0]))


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_structure_at_another_place_is_counted_there(scale):
    """A bump of the neighbour's profile on a galaxy far wider is all the light that may be it.

    scale: of the wide galaxy's light in the outer rings of its profile, relative to that
    """
    small = gaussian((9, 9), (4, 4), 2 * np.eye(2))
    wide = gaussian((41, 41), (20, 20), 200 * np.eye(2))
    small, wide = small / small.max(), wide / wide.max()
    bumped = np.where(wide < np.exp(-0.999 * RING_STEP), scale, 1) * wide
    bumped[3:12, 5:14] += 0.1 * small
    spectra = np.array([[2.0, 3.0], [50.0, 70.0]])
    parts = ((0, 0), bumped, spectra[1]), ((3, 5), small, spectra[0])
    components = tuple(Component(i, *part) for i, part in enumerate(parts))
    result = SimpleNamespace(components=components, sources=(0, 1), channels="gr")
    origin = np.array([(0, 0), (3, 5)])
    given = {"profile": [wide, small], "origin": origin, "fixed": np.array([False, False])}

    def exchanged(source):
        scene = SimpleNamespace(**given)
        return exchanged_light(result, SimpleNamespace(scene=scene, source=source), {})

    found = exchanged(np.arange(2))
    np.testing.assert_allclose(found[1, 0], 0.1 * small.sum() * spectra[1], rtol=0.02)
    assert not found[0, 1].any() and not found[[0, 1], [0, 1]].any()
    given["fixed"] = np.array([True, False])  # a star has no structure
    assert not exchanged(np.arange(2)).any()
    assert not exchanged(np.zeros(2, int)).any()


def test_structure_holds_what_a_profile_has_off_its_own():
    """A galaxy that has a close neighbour's light: all of it, at most all that the galaxy has."""
    near, own = (gaussian((31, 31), at, 9 * np.eye(2)) for at in ((15, 16), (15, 15)))
    near, own = near / near.max(), own / own.max()
    off = near - own * (near * own).sum() / np.square(own).sum()
    spectra, origin = np.array([[2.0], [50.0]]), np.zeros((2, 2), int)
    for part in (0.1, 5.0):
        morphs = near, own + part * off
        components = tuple(Component(i, (0, 0), m, spectra[i]) for i, m in enumerate(morphs))
        result = SimpleNamespace(components=components, sources=(0, 1), channels="g")
        scene = SimpleNamespace(profile=[near, own], origin=origin, fixed=np.zeros(2, bool))
        found = exchanged_light(result, SimpleNamespace(scene=scene, source=np.arange(2)), {})
        wanted = min(part * near.sum(), morphs[1].sum()) * spectra[1]
        np.testing.assert_allclose(found[0, 1], wanted, rtol=1e-6)


def test_a_doubted_profile_is_compared_with_the_ring_around_it():
    """A galaxy fitted too small has its core, and structure of its neighbour holds the rest."""
    frame = SimpleNamespace(
        grid=SimpleNamespace(pixel_scale_arcsec=0.25), shape=(201, 201), psf=PSF.gaussian(1.0)
    )
    shape, place = GalaxyProfile(frame), np.array([100.0, 100.0])
    thetas = [np.array([size, 0, 0, 4.0]) for size in (0.3, 0.3 + SIZE_SCATTER, 3.5)]
    small, larger, wide = (shape.draw(theta, place)[0] for theta in thetas)
    box = np.s_[92:109, 92:109]
    core = (small * larger)[box].sum() / np.square(small[box]).sum()
    bumped, peak = wide.copy(), small.max()
    bumped[box] += 0.1 * (larger - core * small)[box]
    spectra = np.array([[2.0, 3.0], [50.0, 70.0]])
    parts = ((0, 0), bumped, spectra[1]), ((92, 92), small[box] / peak, spectra[0])
    components = tuple(Component(i, *part) for i, part in enumerate(parts))
    result = SimpleNamespace(components=components, sources=(0, 1), channels="gr")
    scene = SimpleNamespace(
        profile=[wide, small[box] / peak],
        origin=np.array([(0, 0), (92, 92)]),
        fixed=np.zeros(2, bool),
    )
    solution = SimpleNamespace(
        scene=scene,
        source=np.arange(2),
        thetas=thetas[::-2],
        shapes=[shape] * 2,
        positions=[place] * 2,
    )
    doubted = DoubtedShape.of(np.eye(4), 1e6, np.arange(4))
    same, found = (exchanged_light(result, solution, d)[1, 0, 0] for d in ({}, {1: doubted}))
    # the wide profile itself takes a little of the ring
    ring = 1 - core * (small * larger)[box].sum() / np.square(larger[box]).sum()
    np.testing.assert_allclose([same, found], [0, 5 * ring * larger[box].sum()], atol=0.05)


def test_exchanged_light_leaves_the_sum_of_two_fluxes_alone():
    rng = np.random.default_rng(3)
    exchanged, doubts, none = np.zeros((3, 3, 2)), rng.normal(size=(3, 2, 4)), np.zeros((0, 3, 2))
    exchanged[0, 1], exchanged[1, 0] = (3.0, 4.0), (5.0, 0.0)
    flux, colour = np.zeros((2, 3, 3)), np.zeros((3, 2, 2))
    nothing = np.zeros((3, 5, 5)), (), np.zeros((3, 6)), np.zeros((3, 2)), np.zeros((3, 5))
    errors = Errors(flux, colour, *nothing, np.zeros((3, 2)))
    found = flux_changes(doubts[..., :0], exchanged, none).added_to(errors)
    np.testing.assert_allclose(found.flux[0], [[34, -34, 0], [-34, 34, 0], [0, 0, 0]])
    np.testing.assert_allclose(found.colour[0], found.colour[1])
    np.testing.assert_allclose(found.colour[0], [[34, 12], [12, 16]])
    found = flux_changes(doubts, exchanged, none).added_to(errors)
    np.testing.assert_allclose(found.colour[2], doubts[2] @ doubts[2].T)
    np.testing.assert_allclose(found.flux[1, 0, 2], doubts[0, 1] @ doubts[2, 1])
    of_both = np.diagonal(found.colour, axis1=1, axis2=2), np.diagonal(found.flux, axis1=1, axis2=2)
    np.testing.assert_allclose(of_both[0], of_both[1].T)
    own = rng.normal(size=(2, 3, 2))
    more, found = found, flux_changes(doubts, exchanged, own).added_to(errors)
    np.testing.assert_allclose(found.colour[1] - more.colour[1], own[:, 1].T @ own[:, 1])
    wanted = np.diag(np.square(own[:, :, 0]).sum(axis=0))
    np.testing.assert_allclose(found.flux[0] - more.flux[0], wanted, atol=1e-12)
    changes, rng = flux_changes(doubts, exchanged, own), np.random.default_rng(0)
    drawn = np.array([changes.draw(3, rng) for _ in range(4000)])  # (n, S, C)
    scale = np.sqrt(np.diagonal(found.flux, axis1=1, axis2=2))
    products = np.einsum("nsc,ntc->cst", drawn, drawn) / len(drawn)
    correlation = (products - found.flux) / (scale[:, :, None] * scale[:, None])
    np.testing.assert_allclose(correlation, 0, atol=0.06)
    assert flux_changes(0 * doubts, 0 * exchanged, 0 * own) is None


def test_a_faint_galaxy_in_a_bright_ones_light_is_less_certain(device, monkeypatch):
    """By half of its flux at most, for its shape is held; one that is alone stays as it is."""
    objects = (
        ((14, 14), (300, 250, 280), 3.0),
        ((19, 14), (12, 9, 10), 1.2),
        ((14, 44), (12, 9, 10), 1.2),
        ((16, 74), (300, 250, 280), 0),  # a star: its model is nearly exact
        ((19, 74), (12, 9, 10), 1.2),
    )
    seen = []

    def spied(doubts, *others):
        seen.append(doubts)
        return flux_changes(doubts, *others)

    monkeypatch.setattr(posterior, "flux_changes", spied)
    result = fit(blend(objects, shape=(30, 90), seed=5), device)
    flux = np.linalg.norm([c.flux for c in result.components], axis=1)
    doubt = np.linalg.norm(seen[0], axis=(1, 2))
    assert 0.2 * flux[1] < doubt[1] < 1.01 * MAX_DOUBT * flux[1]
    assert doubt[2] < 0.02 * flux[2]  # other ends of the scene move it a little
    assert doubt[4] < 0.02 * flux[4]
    variance = np.diagonal(result.errors.flux, axis1=1, axis2=2)
    assert (variance >= np.square(seen[0]).sum(axis=2).T).all()
