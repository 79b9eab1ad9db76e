"""Fits that end at their limit of iterations: fluxes that have settled, and errors of others."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes
from helpers.blends import one_source

from clresample import Flag, Settings, catalogue
from clresample.deblending.assessment import unsettled as module
from clresample.deblending.assessment.unsettled import (
    MAX_CHANGE_SIGMA,
    fluxes_of,
    keeps_fluxes,
    largest_changes,
    unsettled_fluxes,
    unsettled_sources,
)
from clresample.deblending.posterior import posterior
from clresample.deblending.posterior.errors import Errors


def test_fluxes_are_kept_at_half_and_three_quarters_of_the_iterations():
    kept = [n for n in range(5, 101, 5) if keeps_fluxes(n - 5, n, 100)]
    assert kept == [50, 75]
    assert [n for n in range(5, 106, 5) if keeps_fluxes(n - 5, n, 104)] == [55, 80]
    assert not any(
        keeps_fluxes(n - 5, n, 78) for n in range(5, 80, 5)
    )  # strengths would not settle
    assert not keeps_fluxes(55, 80, 80)  # the end itself


def fit_of(kept, status="iteration limit"):
    """A Fit of three sources, the first one outside the frame, the second of two components."""
    state = SimpleNamespace(
        morph=[np.ones((2, 2)), np.ones((1, 2)), np.ones((1, 1))],
        spectra=np.array([[1.0, 2.0], [3.0, 0.0], [5.0, 6.0]]),
    )
    start = SimpleNamespace(source=np.array([0, 0, 1]))
    given = {"sources": (0, 1, 2), "fitted": np.array([1, 2]), "unit": np.array([1.0, 10.0])}
    return SimpleNamespace(state=state, start=start, kept_fluxes=kept, status=status, **given)


def test_a_flux_changes_by_what_it_changed_since_it_was_kept():
    fit = fit_of([np.array([[10.5, 8.0], [5.0, 4.0]]), np.array([[9.0, 8.5], [5.5, 7.0]])])
    np.testing.assert_array_equal(fluxes_of(fit, fit.state), [[10, 8], [5, 6]])
    changes = unsettled_fluxes(fit)
    np.testing.assert_array_equal(changes[..., 0], [[0, 0], [-0.5, 0], [0, 20]])
    np.testing.assert_array_equal(changes[..., 1], [[0, 0], [1, -5], [-0.5, -10]])
    assert np.isinf(unsettled_fluxes(fit_of([]))[1:]).all()
    assert not unsettled_fluxes(fit_of([], "converged")).size
    # of each source those since one time, in the units of the views
    largest = largest_changes(changes, fit.unit)
    np.testing.assert_array_equal(largest[..., 0], [[0, 0], [0, 0], [0, 20]])
    np.testing.assert_array_equal(largest[..., 1], [[0, 0], [1, -5], [0, 0]])
    assert not largest_changes(unsettled_fluxes(fit_of([])), fit.unit).any()


@pytest.mark.parametrize(
    ("status", "change", "unsettled"),
    [
        ("iteration limit", 0.99 * MAX_CHANGE_SIGMA, False),
        ("iteration limit", 1.01 * MAX_CHANGE_SIGMA, True),
        ("iteration limit", None, True),
        ("converged", None, False),
        ("misfit", np.inf, False),
        ("diverged", 0.0, True),
    ],
)
def test_a_source_is_unsettled_where_a_flux_changes_by_part_of_its_error(status, change, unsettled):
    """By default nothing is known of it: files of earlier versions hold none."""
    colour = np.diag([1.0, 9.0])[None]
    maps, beyond, none = (np.zeros((1, 1)),), np.zeros((1, 6)), np.zeros((1, 2))
    moments = np.zeros((1, 5, 5)), maps, beyond, none, np.zeros((1, 5)), none
    errors = Errors(np.ones((2, 1, 1)), colour, *moments)
    if change is not None:
        errors = replace(errors, unsettled=np.array([[0.0, 3 * change]]))
    result = one_source(status=status, errors=errors)
    assert unsettled_sources(result) == [unsettled]
    assert (catalogue(result)["flags"][0] == Flag.NOT_CONVERGED) == unsettled
    assert unsettled_sources(one_source(status="iteration limit")) == [True]  # without errors
    given = {"status": status, "sources": result.sources, "errors": errors}
    wrong = SimpleNamespace(**given, misfit=SimpleNamespace(is_wrong=True))
    assert unsettled_sources(wrong) == [status not in ("converged", "misfit")]


def test_a_fit_whose_fluxes_have_settled_is_not_flagged_at_its_limit(device, monkeypatch):
    """Its errors hold what they changed; of a short fit nothing is known."""
    b, settings = scenes.blend(), Settings(max_iter=14, loss_tol=0)
    short = scenes.fit(b, device, settings=settings)
    monkeypatch.setattr(module, "MIN_ITERATIONS", 5)
    long = scenes.fit(b, device, settings=settings)
    for result in (short, long):
        assert result.status == "iteration limit"
        flags = catalogue(result)["flags"] & Flag.NOT_CONVERGED
        assert flags.all() == flags.any() == (result is short)
    assert np.isinf(short.errors.unsettled).all() and (long.errors.unsettled > 0).all()


def test_changes_of_fluxes_are_in_errors_with_their_signs(device, monkeypatch):
    """Of channels, and of sources that exchange light; in the draws too."""
    b, settings = scenes.blend(), Settings(max_iter=14, loss_tol=0)
    short = scenes.fit(b, device, settings=settings)
    n, rng = len(b.sources), np.random.default_rng(0)
    change = 1e4 * rng.normal(size=(n, len(short.channels)))
    change[1] = -change[0]
    moves = np.stack([0.1 * np.roll(change, 1, axis=0), change], axis=2)
    monkeypatch.setattr(posterior, "unsettled_fluxes", lambda fit: moves)
    found = scenes.fit(b, device, settings=settings)
    added = found.errors.colour - short.errors.colour
    np.testing.assert_allclose(added, change[:, :, None] * change[:, None], rtol=1e-3)
    added = found.errors.flux - short.errors.flux
    np.testing.assert_allclose(added, change.T[:, :, None] * change.T[:, None], rtol=1e-3)
    np.testing.assert_allclose(found.errors.unsettled, np.abs(moves).max(axis=2))
    by = found.draws.flux_changes.by
    for one in change:
        assert np.isclose(by, one).all(axis=1).any()
