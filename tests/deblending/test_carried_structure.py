"""Fits that go on from the structure of an earlier fit of the same sources."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.learned import Source
from helpers.scenes import blend

from clresample import Settings, fluxes
from clresample.deblending.batch import deblend_many
from clresample.deblending.blend import Failure
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.iterate import iterate
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.structure import coarse_count
from clresample.deblending.solver.scene import ComponentStructure, State
from clresample.deblending.start.carried_structure import (
    _of_components,
    _with_structure,
    morphology,
    moved_structure,
)

PRIOR = MultiscalePrior()
GALAXY = (22.0, 24.0), (1800, 1600, 1400), 3.5
CLUMPS = [((22.0 + dy, 24.0 + dx), (90, 80, 70), 1.0) for dy, dx in ((6, 2), (-3, 5), (1, -6))]


def test_the_morphology_of_coefficients_is_the_solvers():
    rng, profile = np.random.default_rng(0), np.exp(-0.1 * np.hypot(*np.ogrid[-8:9, -6:8]) ** 2)
    shapes = [coarse_count(profile.shape, step) for step in PRIOR.steps]
    z = [rng.normal(0, 0.1, shape) for shape in shapes]
    found = morphology(profile, z, PRIOR)
    np.testing.assert_allclose(found, Source(profile, PRIOR).morph(z), atol=1e-6)
    assert abs(found - profile).max() > 0.05


@pytest.mark.parametrize("move, atol", [((0, 0), 1e-5), ((-4, 8), 1e-5), ((-3, 2), 0.02)])
def test_structure_moves_with_its_pixels(move, atol):
    """By steps of the lattices exactly, else nearly; beyond the former box it is 0."""
    shape, larger = (40, 48), (60, 70)

    def image(box, origin, z):
        whole = np.zeros((120, 120))
        flat = Source(np.ones(box), PRIOR).structure(z)
        whole[origin[0] :, origin[1] :][: box[0], : box[1]] = flat
        return whole

    z = []
    for step in PRIOR.steps:
        y, x = (step * np.arange(coarse_count(n, step)) - n / 2 for n in shape)
        z.append(np.exp(-0.02 * (y[:, None] ** 2 + (x - 3) ** 2)))
    known = ComponentStructure((30, 30), tuple(z), np.ones(3), False)
    origin = 30 + move[0], 30 + move[1]
    moved = moved_structure(known, origin, larger, PRIOR)
    assert [m.shape for m in moved] == [tuple(coarse_count(larger, s)) for s in PRIOR.steps]
    found, wanted = image(larger, origin, moved), image(shape, known.origin, z)
    inside = np.zeros((120, 120), bool)
    inside[origin[0] : 70, origin[1] : 78] = True
    inside[:36, :] = inside[:, :42] = False
    assert abs(found - wanted)[inside].max() < atol * wanted.max()


def test_structure_is_for_the_component_that_had_it():
    """Of a source's two components by their size; a star's has none, others start from nothing."""
    z = tuple(np.full((8 // step, 8 // step), 0.01) for step in PRIOR.steps)
    names = [
        ComponentStructure((0, 0), z, np.full(3, strength), clear)
        for strength, clear in ((2.0, True), (3.0, False))
    ]
    profile, small, large = np.ones((8, 8)), np.array([0.5, 0, 0, 1]), np.array([2.0, 0, 0, 0])
    fit = SimpleNamespace(
        start=SimpleNamespace(source=np.array([0, 1, 1, 2])),
        fitted=np.array([0, 2, 3]),
        settings=SimpleNamespace(prior=PRIOR),
        blend=SimpleNamespace(
            structures=((names[0],), (), tuple(names), ()),
            thetas=((small,), (), (large, small), (small,)),
        ),
        scene=SimpleNamespace(
            fixed=np.array([True, False, False, False]),
            profile=[profile] * 4,
            origin=np.zeros((4, 2)),
        ),
        state=State([profile] * 4, None, None),
    )
    known = _of_components(fit)
    assert list(known.items()) == [(1, names[1]), (2, names[0])]
    learned = _with_structure(fit, known).learned
    assert learned.clear.tolist() == [False, False, True, False]
    assert learned.strengths[:, 0].tolist() == [PRIOR.strengths[0], 3, 2, PRIOR.strengths[0]]


@pytest.fixture(scope="module")
def ended(device):
    """A blend of a galaxy with clumps and a neighbour, and its fit."""
    scene = blend([GALAXY, ((34.0, 10.0), (300, 500, 400), 2.0), *CLUMPS], shape=(48, 48), seed=3)
    sources = tuple(replace(source, n_components=1) for source in scene.sources[:2])
    scene = replace(scene, sources=sources)
    return scene, deblend_many([scene], device=device)[0]


def test_a_fit_goes_on_where_another_ended(ended, device):
    """In a few iterations, with its strengths."""
    scene, first = ended
    assert first.converged and (first.structures[0][0].strengths != PRIOR.strengths).any()
    given = {"thetas": first.thetas, "structures": first.structures}
    again = deblend_many([replace(scene, **given)], device=device)[0]
    assert again.converged and 2 * len(again.losses) < len(first.losses)
    assert again.losses[0] < first.losses[-1] + 1 < 0.1 * first.losses[0]
    # losses of other strengths do not compare; fluxes stay within their errors
    (before, covariance), (after, _) = fluxes(first), fluxes(again)
    errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    assert again.losses[-1] < first.losses[-1] + 2 and (np.abs(after - before) < 0.5 * errors).all()


def test_a_fit_that_starts_again_does_so_from_the_structure(ended, device):
    scene, first = ended
    scene = replace(scene, thetas=first.thetas, structures=first.structures)
    (fit,) = fits = [Fit(scene, Settings(max_iter=3), device, np.float32, pad=1)]
    start_fits(fits)
    losses = []
    for _ in range(2):
        fit.restart()
        iterate(fits, fit.settings, device, np.float32)
        losses.append(fit.losses[0])
    assert losses[0] == losses[1] == pytest.approx(first.losses[-1], rel=0.01)


def test_structure_of_another_galaxy_is_not_taken(ended, device):
    """The fit begins with profiles alone if they describe the data better."""
    scene, first = ended
    ((own,), other) = first.structures
    strange = replace(own, coefficients=tuple(-9 * z for z in own.coefficients))
    given = {"thetas": first.thetas, "structures": ((strange,), other)}
    short = Settings(max_iter=1, errors=False)
    begun = deblend_many([replace(scene, **given)], settings=short, device=device)[0]
    assert begun.losses[0] == pytest.approx(first.losses[0], rel=2e-3)


def test_structure_of_another_prior_is_refused(ended, device):
    scene, first = ended
    given = {"thetas": first.thetas, "structures": first.structures}
    prior = MultiscalePrior(scales_px=(0.8,), strengths=(0.1,))
    settings = Settings(prior=prior, max_iter=1, errors=False)
    star = blend([((22.0, 24.0), (90000, 80000, 70000), 0.0)], shape=(48, 48), seed=3)
    run = {"settings": settings, "device": device}
    failed, beside = deblend_many([replace(scene, **given), star], **run)
    assert isinstance(failed, Failure) and "3 scales, the prior has 1" in failed.reason
    (alone,) = deblend_many([star], **run)  # its weights hold the PSF's error once, not twice
    assert beside.losses[0] == pytest.approx(alone.losses[0], rel=1e-5)
    assert beside.messages == alone.messages


@pytest.mark.parametrize(
    "given, message",
    [
        (lambda own: {"structures": own}, "structures are given without thetas"),
        (lambda own: {"structures": own[:1]}, "structures has 1 entries, must have one for each"),
        (
            lambda own: {"thetas": ((), ()), "structures": ((3,), ())},
            r"structures\[0\] has 3, must",
        ),
        (
            lambda own: {
                "thetas": ((), ()),
                "structures": ((replace(own[0][0], strengths=np.ones(1)),), ()),
            },
            r"structures\[0\] has .* as many coefficients",
        ),
    ],
)
def test_structures_that_no_fit_can_go_on_from_are_refused(ended, given, message):
    scene, first = ended
    with pytest.raises(ValueError, match=message):
        replace(scene, **given(first.structures)).check()
