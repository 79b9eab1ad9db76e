"""Settings, constraints and results: what is taken, what is refused, and how it is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.blends import blend, observe, round_component

from clresample.deblending.posterior import posterior as posterior_module
from clresample.deblending.posterior.exposure import Exposure, Transfer, _parallel, _spread
from clresample.deblending.settings import Settings
from clresample.deblending.solver.constraints import (
    L0,
    L1,
    Chain,
    MaxNorm,
    Monotone,
    MonotoneProjection,
    Positivity,
    SumNorm,
    Symmetry,
)
from clresample.deblending.solver.learned.prior import LearnedPrior
from clresample.deblending.solver.prior import Prior
from clresample.deblending.solver.prox_launches import parameter_table
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


def test_defaults_are_those_of_the_docstring():
    """Steps, errors and tolerances as they are documented, and measured."""
    s = Settings()
    assert (s.max_iter, s.enough, s.tol, s.flux_floor) == (500, 1.5, 1e-5, 0.0015)
    assert (s.psf_error, s.psf_tolerance, s.fit_shifts, s.fit_sky) == (0.03, 1e-3, False, False)
    assert s.learns and s.constraints is None and s.prior == LearnedPrior()
    steps = s.step_sizes
    assert (steps.latent, steps.morphology, steps.spectrum) == (0.1, 0.01, 0.1)
    assert (s.prior.scales_px, s.prior.weight) == ((0.8, 2.0, 5.0), 100)
    assert s.prior.strengths == (0.005, 0.1, 0.02)
    assert (Prior().alpha, Prior().correlation_px) == (0.1, 2.0)


@pytest.mark.parametrize(
    "name, wrong, right",
    [
        ("max_iter", [-1, 1.5, "many"], [0, 1]),
        ("enough", [-0.1, np.nan, "a"], [0, 9.0]),
        ("tol", [-1e-9, 1.0, np.nan], [0, 0.99]),
        ("flux_floor", [-1e-9, 1.0, np.inf], [0, 0.99]),
        ("psf_error", [-1e-9, 1.0], [0, 0.99]),
        ("psf_tolerance", [-1e-9, 1.0], [0, 0.99]),
        ("fit_shifts", [1, "no", None], [True, np.False_]),
        ("fit_sky", [1, "no", None], [True, np.False_]),
        ("prior", [3, "none"], [None, Prior(), LearnedPrior()]),
        ("constraints", [Positivity(), [Positivity()]], [None, Chain(Positivity())]),
        ("step_sizes", [None, 0.1], []),
    ],
)
def test_settings_are_named_where_they_cannot_be(name, wrong, right):
    for value in wrong:
        with pytest.raises(ValueError, match=name):
            Settings(**{name: value})
    for value in right:
        assert getattr(Settings(**{name: value}), name) == value


def test_constraints_go_with_priors():
    """Scales are the profiles' where there is a prior; the learning one takes positivity alone."""
    kinds = [type(p) for p in Settings().chain.steps()]
    assert kinds == [Positivity]
    for prior in (None, Prior()):
        kinds = [type(p) for p in Settings(prior=prior).chain.steps()]
        assert kinds == [Positivity, Monotone]
    for scale in (MaxNorm(), SumNorm()):
        given = Chain(Positivity(), scale)
        assert Settings(prior=None, constraints=given).chain is given
        with pytest.raises(ValueError, match=f"constraints hold {type(scale).__name__}.*scale of"):
            Settings(prior=Prior(), constraints=given)
    given = Chain(Positivity(), Monotone())
    assert Settings(prior=Prior(), constraints=given).chain is given
    with pytest.raises(ValueError, match="constraints hold Monotone.*non-negative and nothing"):
        Settings(constraints=given)
    assert Settings(constraints=Chain(Positivity())).learns


@pytest.mark.parametrize(
    "prox, words",
    [
        (L1(-1e-9), "strength is -1e-09, it must lie between 0 and inf"),
        (L0([1.0, -1.0]), "strength"),
        (Symmetry(1.01), "strength is 1.01, it must lie between 0 and 1"),
        (Symmetry(-0.01), "strength is -0.01"),
        (Monotone(gradient=1.01), "gradient is 1.01, it must lie between 0 and 1"),
        (Monotone(weights=4), "weights is 4"),
        (Monotone(weights=-1), "weights is -1"),
        (L1(np.ones(3)), r"strength has shape \(3,\) for 2 sources"),
    ],
)
def test_parameters_of_constraints_that_cannot_be(prox, words):
    with pytest.raises(ValueError, match=words):
        parameter_table(prox, 2)


def test_parameters_of_constraints_by_source():
    assert parameter_table(Positivity(), 2).tolist() == [[1, 1], [0, 0]]
    assert parameter_table(L1([2.0, 0.0]), 2).tolist() == [[2, 0], [0, 0]]
    table = parameter_table(Monotone(weights=[3, 0], gradient=[0.0, 1.0]), 2)
    assert table.tolist() == [[3, 0], [0, 1]] and parameter_table(Symmetry(), 1)[0, 0] == 1
    given = MonotoneProjection(positive=False).parameters
    assert (given["positive"], given["n_iterations"], given["tolerance"]) == (False, 300, 1e-5)
    assert MonotoneProjection().parameters["positive"] is True


def test_draws_below_zero_become_zero(monkeypatch):
    """Morphologies that hold negative light, as stars' rings, keep it."""
    morph = np.array([[1.0, 0.2], [-0.1, 0.0]])
    component = replace(round_component(0, (30, 30), (2.0, 3.0)), morphology=morph)
    change = np.array([[0.5, -0.5], [-0.3, -0.2]])
    asked = []

    def draw(rng):
        asked.append(rng)
        return [change], np.array([[-3.0, 1.0]])

    result = replace(blend([component]), draws=SimpleNamespace(draw=draw))
    first, second = result.sample(2, "numbers")
    assert asked == ["numbers"] * 2 and len(first) == len(second) == 1
    np.testing.assert_allclose(first[0].morphology, [[1.5, 0], [-0.1, 0]])
    assert first[0].spectrum.tolist() == [0, 4]
    with pytest.raises(ValueError, match="no posterior to draw from"):
        blend([component]).sample(1, None)


def test_a_source_is_the_sum_of_its_components():
    seen = (
        observe(Grid.flat((60, 70), 0.1), ("g",), name="one"),
        observe(Grid.flat((60, 70), 0.1), ("r", "i"), name="two"),
    )
    parts = [
        round_component(0, (20, 20), (1.0, 2.0, 3.0)),
        round_component(1, (30, 40), (4.0, 5.0, 6.0)),
        round_component(0, (25, 25), (7.0, 8.0, 9.0)),
    ]
    sky = np.array([0.5, 0.25, 0.125])
    result = blend(parts, observations=seen, sky=sky)
    whole = np.zeros((3, 60, 70))
    for part, (y, x) in ((parts[0], parts[0].origin), (parts[2], parts[2].origin)):
        whole[:, y : y + 21, x : x + 21] += part.spectrum[:, None, None] * part.morphology
    np.testing.assert_allclose(result.source_model(0), whole)
    np.testing.assert_allclose(result.source_model(0, 1), whole[1:])
    both = whole[1:] + result.source_model(1, 1)
    np.testing.assert_allclose(result.model(1), both + sky[1:, None, None])
    assert result.channel_slices() == [slice(0, 1), slice(1, 3)]
    assert result.source_model(7, 1).shape == (2, 60, 70) and not result.source_model(7).any()
    np.testing.assert_allclose(parts[1].flux, parts[1].spectrum * parts[1].morphology.sum())
    with pytest.raises(ValueError, match=r"channel is 'z', must be one of \('g', 'r', 'i'\)"):
        pytest.importorskip("galsim")
        result.as_galsim(0, "z")


def exposure(y, x, reach):
    return Exposure(np.array(y, float), np.array(x, float), None, reach, None, None)


def test_a_window_holds_the_pixels_within_reach():
    """Of a box of 3 x 2 pixels that starts at (4, 5): rows from 2 to 8 at a reach of 2."""
    one = exposure(range(20), np.arange(0, 20, 0.5), 2.0)
    assert one.window((4, 5), (3, 2)).tolist() == [[2, 6], [8, 16]]
    assert exposure(range(20), range(20), 2.25).window((4, 5), (3, 2)).tolist() == [[2, 3], [9, 9]]
    low, high = one.window((30, 5), (3, 2))
    assert low[0] == high[0] == 20  # none


@pytest.mark.parametrize(
    "matrix", [((2, 0), (0, 1)), ((-2, 0), (0, 1)), ((0, 2), (-1, 0)), ((0, -2), (-1, 0))]
)
def test_parallel_pixels_keep_their_weights(matrix):
    """Turned and mirrored: rows and columns of the model, ascending."""
    matrix = np.array(matrix, float)
    root = np.arange(24.0).reshape(2, 3, 4)
    offset, shift = np.array([20.0, 30.0]), np.array([0.25, -0.5])
    mapping = SimpleNamespace(matrix=matrix, offset=offset)
    view = SimpleNamespace(mapping=mapping, root=root, op=SimpleNamespace(shift=shift))
    y, x, found = _parallel(view, None)
    assert (np.diff(y) > 0).all() and (np.diff(x) > 0).all()
    for n in range(3):
        for m in range(4):
            place = matrix @ (n, m) + offset + shift
            i, j = np.argmin(np.abs(y - place[0])), np.argmin(np.abs(x - place[1]))
            np.testing.assert_allclose((y[i], x[j]), place)
            np.testing.assert_array_equal(found[:, i, j], root[:, n, m])


def test_weights_spread_over_the_model_keep_their_density():
    """Of even weights turned by 30 degrees: what two pixels of noise 1 say, one of theirs does."""
    c, s = 0.8 * np.cos(np.pi / 6), 0.8 * np.sin(np.pi / 6)
    matrix = np.array([[c, -s], [s, c]])
    n, shift = 60, np.array([0.3, -0.2])

    class Mapping:
        area, shape_in, shape_out = None, (24, 26), (n, n)

        def __init__(self):
            self.matrix = matrix

        def at(self, a, b):
            away = np.stack([a - n / 2, b - n / 2], axis=-1)
            return away @ matrix.T + [12, 13] - shift

    view = SimpleNamespace(
        mapping=Mapping(),
        covered=np.ones((n, n), bool),
        root=np.full((1, n, n), 3.0),
        op=SimpleNamespace(shift=shift),
    )
    for pixel in (0.8, 1.2):
        y, x, root = _spread(view, pixel)
        np.testing.assert_allclose(np.diff(y), pixel)
        assert y[0] == x[0] == -pixel and y[-1] >= 24 and x[-1] >= 26
        inner = root[0, 4:-4, 4:-4]  # within the frame, all of which is seen
        np.testing.assert_allclose(inner, 3 * pixel / 0.8, rtol=1e-5)
    half = view.root.copy()
    n_y, m = np.indices((n, n))
    half[0][view.mapping.at(n_y, m)[..., 0] + shift[0] < 12] = 0
    y, _, root = _spread(SimpleNamespace(**{**vars(view), "root": half}), 0.8)
    assert root[0, y < 10.5, 5:-5].max() == 0 and root[0, (y > 13.5) & (y < 22), 5:-5].min() > 2.9


def test_periods_hold_a_box_and_what_its_light_reaches():
    """Multiples of 8 px, and one; frequencies of half a plane, counted twice but for row 0."""
    psf = PSF.gaussian(1.2, n_pixels=25)
    transfer = Transfer(2.0 * np.eye(2), psf, psf)
    nu_y, nu_x, d = transfer.at((11, 13), 4.0)
    assert nu_y[1] == pytest.approx(1 / 25) and nu_x[len(nu_x) // 2 + 1] == pytest.approx(1 / 25)
    assert transfer.at((17, 17), 4.0)[0][1] == pytest.approx(1 / 33)
    assert transfer.at((16, 17), 4.0)[0][1] == pytest.approx(1 / 25)
    middle = len(nu_x) // 2
    assert nu_y[0] == 0 and nu_x[middle] == 0 and len(nu_x) % 2
    # at frequency 0 all light of one pixel, 4 of the model's, over the period's square
    assert d[0, 0, middle].real == pytest.approx(4 / 25**2, rel=1e-4)
    assert np.abs(d[1, 0, middle]) > 1.2 * d[0, 0, middle].real
    assert transfer.at((11, 13), 4.0)[2] is d  # kept


def test_errors_at_fixed_morphologies_are_those_of_the_normal_matrix(monkeypatch):
    """And no less than float64's rounding of the spectrum, 1e-9 of it."""
    made = []
    monkeypatch.setattr(posterior_module, "Posterior", lambda s, *_a, **_k: made.append(s))
    monkeypatch.setattr(posterior_module, "_local_chi2", lambda *_: np.ones(2))
    covariance = np.array([[[1e-8, 5.0], [5.0, 4.0]], [[0.0, 0], [0, -1e-20]]])
    spectra = np.array([[3.0, 3.0], [1e6, 0.0]])
    start = SimpleNamespace(source=np.array([0, 1]), shapes=0, thetas=0, positions=np.eye(2))
    fit = SimpleNamespace(
        settings=Settings(), scene=None, findings=1, views=[], start=start, frame=None
    )
    fit.blend = SimpleNamespace(observations=[])
    seen = SimpleNamespace(spectra=spectra, covariance=covariance)
    _, messages = posterior_module.posterior_of(fit, [], np.ones(2), seen)
    assert messages == []
    wanted = [[1e-4, 3e-9], [2.0, 1e-150]]
    np.testing.assert_allclose(made[0].fixed_error, wanted)
    assert posterior_module.posterior_of(
        SimpleNamespace(settings=Settings(prior=None), scene=None, findings=1), [], 0, seen
    ) == (None, [])
