"""Blends that are fitted again with the sources found in their residuals."""

from dataclasses import dataclass

import pytest

from clresample import PaperSettings, Settings, SingleScalePrior
from clresample.deblending.blend import Failure
from clresample.deblending.ended import Ended
from clresample.measurement.late_sources import (
    LOOK_PRIOR,
    fit_with_late_sources,
    look_settings,
)


@dataclass(frozen=True)
class Fitted:
    """Result of a fit of a blend, here a word."""

    blend: str
    by: str
    status: Ended = Ended.CONVERGED


def fitting(by, calls, fails=()):
    def fit(blends):
        calls.append((by, *blends))
        ends = {"stopped": Ended.INTERRUPTED}
        return [
            Failure(b, Ended.FAILED, "no light")
            if b in fails
            else Fitted(b, by, ends.get(b, Ended.CONVERGED))
            for b in blends
        ]

    return fit


def find(blend, result):
    assert result.blend == blend
    return None if blend == "empty" else blend + "+"


@pytest.mark.parametrize("with_look", [False, True])
def test_blends_in_which_sources_are_found_are_fitted_again(with_look):
    calls = []
    fit = fitting("fit", calls, fails=("bad", "b+"))
    look = fitting("look", calls, fails=("bad",)) if with_look else None
    blends = ["a", "empty", "bad", "b", "stopped"]
    first, *found = fit_with_late_sources(blends, fit, find, look=look)
    by = "look" if with_look else "fit"
    assert calls == [(by, *blends), ("fit", "a+", "b+")]
    assert first == ("a+", Fitted("a+", "fit"))
    assert found[0] == ("empty", Fitted("empty", by))
    assert found[1][1].status == Ended.FAILED
    assert found[2] == ("b", Fitted("b", by))  # the first fit stands where the second one fails
    assert found[3] == ("stopped", Fitted("stopped", by, Ended.INTERRUPTED))


def test_nothing_is_fitted_again_where_nothing_is_found():
    calls = []
    fit_with_late_sources(["empty"], fitting("fit", calls), find)
    assert calls == [("fit", "empty")]


def test_a_first_look_has_few_iterations_and_fine_structure_alone():
    look = look_settings(Settings(fit_sky=True))
    assert (look.max_iter, look.prior, look.errors, look.fit_sky) == (30, LOOK_PRIOR, False, True)
    assert look_settings(Settings(max_iter=7)).max_iter == 7
    assert look_settings(Settings(), sources=False) == Settings(max_iter=30)
    paper = PaperSettings(prior=SingleScalePrior(), rel_tol=0.1)
    assert look_settings(paper).prior == paper.prior and look_settings(paper).rel_tol == 0.1
