"""Steps of what sources exchange, by dense equations; what is unknown in them, what stays."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_posterior_normal import CHANNELS, SHAPE, whole
from test_posterior_rules import solution

from clresample.deblending.posterior import joint_step
from clresample.deblending.posterior.joint_step import JointNewtonStep, make_joint_step
from clresample.deblending.posterior.smooth_modes import SmoothModes
from clresample.deblending.solver.multiscale.vectors import SceneGradient

# (y0, x0, ny, nx): a galaxy far from all, a star that is fixed, two galaxies in each other's light
BOXES = (12, 0, 3, 3), (3, 5, 5, 4), (1, 1, 9, 11), (4, 6, 8, 9)
STAR = 1


class Shown:
    """An exposure that shows the frame itself, under weights root^2."""

    def __init__(self, root):
        self.sqrt_weights = root

    def threads_for(self, images):
        return 1

    def window(self, origin, shape):
        """A box."""
        return np.array([origin, np.add(origin, shape)])

    def observe(self, images, _i, origin, low, high):
        """Images (k, ny, nx) of a box as seen (C, k, ry, rx)."""
        seen = whole(images, origin) * self.sqrt_weights[:, None]
        return seen[:, :, low[0] : high[0], low[1] : high[1]].astype(np.float32)


def posed(bright=10.0):
    """A Solution of BOXES whose structure the data know to 1 / bright."""
    rng, profiles = np.random.default_rng(0), []
    for _, _, ny, nx in BOXES:
        y, x = np.arange(ny) - 0.45 * ny, np.arange(nx) - 0.55 * nx
        profiles.append(np.exp(-0.5 * (y[:, None] ** 2 + x**2) / 2.5**2))
    spectra = bright * rng.uniform(0.5, 1, (len(BOXES), 3))
    one = solution(
        [box[:2] for box in BOXES],
        profiles,
        spectra=spectra,
        fixed=(STAR,),
        strengths=np.tile([0.02, 0.1, 0.06], (len(BOXES), 1)),
    )
    one.scene.channels = lambda: CHANNELS
    return replace(one, fixed_error=np.full((len(BOXES), 3), 0.5))


def joint_step_at(one, scale=(1.0, 1.0, 1.0), *, fit_sky=True):
    """The JointNewtonStep of a Solution under weights of a sharp noise, channels times scale^2."""
    rng = np.random.default_rng(1)
    root = 30 * rng.uniform(0.5, 2, (3, *SHAPE)) * np.array(scale)[:, None, None]
    shared = [one.overlap_mask(i) for i in range(len(BOXES))]
    return JointNewtonStep(one, shared, [Shown(root[part]) for part in CHANNELS], fit_sky=fit_sky)


def slopes_of(one, seed=2, bound=()):
    """Slopes of random numbers; bound: pairs of component and channel."""
    rng, n = np.random.default_rng(seed), len(BOXES)
    sizes = [
        [-(-(n_px - 1) // step) + 1 for n_px in box[2:]]
        for box in BOXES
        for step in one.prior.steps
    ]
    parts = [rng.normal(size=size) for size in sizes]
    structure = [parts[3 * i : 3 * i + 3] for i in range(n)]
    held = np.zeros((n, 3), bool)
    held[tuple(np.array(bound, int).reshape(-1, 2).T)] = True
    return SceneGradient(structure, rng.normal(size=(n, 3)), rng.normal(size=3), held)


def solved(found, slopes, fit_sky):
    """The same step by the dense matrix, without the rows and columns of what is bound."""
    matrix, right, free = found._matrix.dense(), [], []
    for i, moves in enumerate(found.moves):
        own = [] if moves is None else moves.slopes(slopes.structure[i])
        right += [*own, *slopes.spectra[i]]
        free += [True] * len(own) + list(~slopes.at_bound[i])
    if fit_sky:
        right, free = [*right, *slopes.sky], free + [True] * 3
    x, on = np.zeros(len(right)), np.flatnonzero(free)
    x[on] = -np.linalg.solve(matrix[np.ix_(on, on)], np.array(right)[on])
    gain, structure, spectra, at = -0.5 * x @ right, [], [], 0
    for moves in found.moves:
        k = 0 if moves is None else len(moves.weights)
        structure.append(None if moves is None else moves.structure(x[at : at + k]))
        spectra.append(x[at + k : at + k + 3])
        at += k + 3
    return structure, np.array(spectra), x[at:] if fit_sky else np.zeros(3), gain


@pytest.mark.parametrize("fit_sky", [False, True])
def test_a_step_leads_to_the_minimum_of_all_that_is_free(fit_sky, monkeypatch):
    """By the dense matrix; with spectra at their bound, other ones, none.

    One set of bounds is factored once.
    """
    factored, factor = [], joint_step.BlockCholesky
    monkeypatch.setattr(joint_step, "BlockCholesky", lambda m: factored.append(m) or factor(m))
    one = posed()
    found = joint_step_at(one, fit_sky=fit_sky)
    assert [moves is None for moves in found.moves] == [True, True, False, False]
    for n, bound in ((1, [(0, 1), (2, 0)]), (1, [(0, 1), (2, 0)]), (2, [(1, 2)]), (3, [])):
        slopes = slopes_of(one, seed=len(bound), bound=bound)
        structure, spectra, sky, gain = found.step(slopes)
        wanted = solved(found, slopes, fit_sky)
        assert len(factored) == n
        for part, expected in zip(structure, wanted[0], strict=True):
            assert (part is None) == (expected is None)
            for a, b in zip(part or [], expected or [], strict=True):
                np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(b).max())
        for a, b in zip((spectra, sky), wanted[1:3], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(b).max(initial=1e-30))
        assert gain == pytest.approx(wanted[3], rel=1e-5)


@pytest.mark.parametrize("part, stays", [(1.0, False), (1e-4, False), (2e-5, True), (0.0, True)])
def test_a_channel_that_hardly_weighs_stays(part, stays):
    """Spectra and level of one with less than 1e-9 of the best one's information.

    The level follows by no more than the light that is moved.
    """
    one = posed()
    found = joint_step_at(one, (1.0, part, 1.0))
    _, spectra, sky, _ = found.step(slopes_of(one))
    assert (spectra[:, 1] == 0).all() == stays
    assert (abs(sky[1]) < 1e-4) == (stays or part == 1)
    assert spectra[:, [0, 2]].all() and sky[[0, 2]].all()


def test_where_nothing_weighs_nothing_moves():
    one = posed()
    _, spectra, sky, _ = joint_step_at(one, (0, 0, 0)).step(slopes_of(one))
    assert not spectra.any() and not sky.any()


@pytest.mark.parametrize("bright", [0.5, 0.6, 0.8, 1.0])
def test_changes_of_more_than_a_third_of_an_error_are_unknowns(bright):
    """0.3 errors of flux and second moment at fixed morphologies, of all channels together."""
    one = posed(bright)
    found, n_small = joint_step_at(one), 0
    for i in (2, 3):
        moves = found.moves[i]
        profile = one.scene.profile[i]
        given = one.scene.origin[i], profile, one.findings.strengths[i], one.prior.kernels()
        images = SmoothModes(*given, one.overlap_mask(i), all_over=False).images().astype(float)
        y, x = np.indices(profile.shape)
        middle = [(v * profile).sum() / profile.sum() for v in (y, x)]
        r2 = (y - middle[0]) ** 2 + (x - middle[1]) ** 2
        size = (r2 * profile).sum() / profile.sum()
        change = np.abs((images * (1 + r2 / size)).sum((1, 2))) / profile.sum()
        errors = change * np.sqrt(((one.spectra[i] / 0.5) ** 2).sum())
        n_small += np.count_nonzero((errors > 0.3) & (errors < 1))
        wanted = np.count_nonzero(errors > 0.3)
        assert (0 if moves is None else len(moves.weights)) == wanted
    assert n_small


def test_changes_of_large_shared_parts_are_further_apart(monkeypatch):
    one = posed()
    counts = [len(moves.weights) for moves in joint_step_at(one).moves[2:]]
    monkeypatch.setattr(joint_step, "MAX_CHANGES", 4)
    fewer = [len(moves.weights) for moves in joint_step_at(one).moves[2:]]
    assert min(counts) > 4 and 0 < min(fewer) and max(fewer) <= 4


def test_errors_at_fixed_morphologies_are_those_of_the_power(monkeypatch):
    """1 / sqrt(sum w (R S)^2); where nothing is seen a number that makes all changes negligible."""
    monkeypatch.setattr(joint_step, "JointNewtonStep", lambda solution, *given, fit_sky: solution)
    monkeypatch.setattr(joint_step, "align_observations", lambda fit: None)
    one = posed()
    one.scene.spectrum_curvature = np.full((len(BOXES), 3), 4.0)
    one.scene.spectrum_curvature[1] = 0, 0.25, 1e-20
    start = SimpleNamespace(
        shapes=[None] * 4, thetas=[None] * 4, positions=np.arange(10).reshape(5, 2),
        source=np.array([2, 0, 3, 1]),
    )  # fmt: skip
    fit = SimpleNamespace(start=start, settings=SimpleNamespace(prior=one.prior, fit_sky=False))
    state = SimpleNamespace(morph=one.morphs, spectra=one.spectra)
    found = make_joint_step(fit, one.scene, state, one.findings)
    np.testing.assert_allclose(found.fixed_error[0], 0.5)
    np.testing.assert_allclose(found.fixed_error[1], [1e15, 2, 1e10])
    assert found.peaks.tolist() == found.chi2.tolist() == [1] * 4
    assert found.positions.tolist() == start.positions[start.source].tolist()
