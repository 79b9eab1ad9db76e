"""Settings, constraints and results: what is taken, what is refused, and how it is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.blends import blend, observe, round_component

from clresample.deblending.settings import Settings
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.constraints import (
    L0,
    L1,
    MaxNorm,
    Monotone,
    Positivity,
    ProxChain,
    SumNorm,
    Symmetry,
)
from clresample.paper.solver.prior import SingleScalePrior
from clresample.paper.solver.prox_launches import parameter_table
from clresample.sky.grid import Grid


def test_defaults_are_those_of_the_docstring():
    """Steps, errors and tolerances as they are documented, and measured."""
    s = Settings()
    assert (s.max_iter, s.loss_tol, s.flux_error_floor) == (500, 0.25, 0.0005)
    assert (s.psf_error, s.psf_tolerance, s.fit_shifts, s.fit_sky) == (0.03, 1e-3, "auto", "auto")
    assert s.errors and s.prior == MultiscalePrior()
    paper = PaperSettings()
    assert (paper.max_iter, paper.rel_tol) == (500, 1e-5)
    assert paper.prior is paper.constraints is None
    steps = paper.step_sizes
    assert (steps.latent, steps.morphology, steps.spectrum) == (0.1, 0.01, 0.1)
    assert (s.prior.scales_px, s.prior.hyperprior_weight) == ((0.8, 2.0, 5.0), 100)
    assert s.prior.strengths == (0.005, 0.1, 0.02)
    assert (SingleScalePrior().strength, SingleScalePrior().correlation_px) == (0.1, 2.0)


BOTH = (Settings, PaperSettings)


@pytest.mark.parametrize(
    "kinds, name, wrong, right",
    [
        (BOTH, "max_iter", [-1, 1.5, "many"], [0, 1]),
        ((Settings,), "loss_tol", [-0.1, np.nan, "a"], [0, 9.0]),
        ((PaperSettings,), "rel_tol", [-1e-9, 1.0, np.nan, "a"], [0, 0.99]),
        ((Settings,), "flux_error_floor", [-1e-9, 1.0, np.inf], [0, 0.99]),
        (BOTH, "psf_error", [-1e-9, 1.0], [0, 0.99]),
        (BOTH, "psf_tolerance", [-1e-9, 1.0], [0, 0.99]),
        (BOTH, "fit_shifts", [1, "no", None], [True, np.False_, "auto"]),
        (BOTH, "fit_sky", [1, "no", None], [True, np.False_, "auto", "small"]),
        ((Settings,), "errors", [1, "no", None], [True, np.False_]),
        ((Settings,), "prior", [3, "none", None, SingleScalePrior()], [MultiscalePrior()]),
        ((PaperSettings,), "prior", [3, MultiscalePrior()], [None, SingleScalePrior()]),
        (
            (PaperSettings,),
            "constraints",
            [Positivity(), [Positivity()]],
            [None, ProxChain(Positivity())],
        ),
        ((PaperSettings,), "step_sizes", [None, 0.1], []),
    ],
)
def test_settings_are_named_where_they_cannot_be(kinds, name, wrong, right):
    for kind in kinds:
        for value in wrong:
            with pytest.raises(ValueError, match=name):
                kind(**{name: value})
        for value in right:
            assert getattr(kind(**{name: value}), name) == value


def test_constraints_go_with_priors():
    """Scales are the profiles' where there is a prior."""
    for prior in (None, SingleScalePrior()):
        kinds = [type(p) for p in PaperSettings(prior=prior).constraint_chain.steps()]
        assert kinds == [Positivity, Monotone]
    for scale in (MaxNorm(), SumNorm()):
        given = ProxChain(Positivity(), scale)
        assert PaperSettings(prior=None, constraints=given).constraint_chain is given
        with pytest.raises(ValueError, match=f"constraints hold {type(scale).__name__}.*scale of"):
            PaperSettings(prior=SingleScalePrior(), constraints=given)
    given = ProxChain(Positivity(), Monotone())
    assert PaperSettings(prior=SingleScalePrior(), constraints=given).constraint_chain is given


@pytest.mark.parametrize(
    "prox, words",
    [
        (L1(-1e-9), "strength is -1e-09, must be between 0 and inf"),
        (L0([1.0, -1.0]), "strength"),
        (Symmetry(1.01), "strength is 1.01, must be between 0 and 1"),
        (Symmetry(-0.01), "strength is -0.01"),
        (Monotone(gradient=1.01), "gradient is 1.01, must be between 0 and 1"),
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
    numbers = np.random.default_rng(1)
    first, second = result.sample(2, numbers)
    assert asked == [numbers] * 2 and len(first) == len(second) == 1
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
