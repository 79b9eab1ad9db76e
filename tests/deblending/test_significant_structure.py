"""When a scene looks for clear structure, what follows for it, and for scenes beside it."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.progress import falls

from clresample.deblending.solver.multiscale.engine import MultiscaleEngine
from clresample.deblending.solver.multiscale.lbfgs_control import CONVERGENCE_WINDOW, LbfgsControl

N_PIXELS = 1000  # so many that chi2 per pixel is below 1


def begun(*losses):
    """Scenes that have taken their first trial."""
    progress = LbfgsControl(len(losses), 0.5, [N_PIXELS] * len(losses))
    progress.accept_trials(np.array(losses, float), np.zeros(len(losses)))
    return progress


@pytest.mark.parametrize("clear", [True, False])
def test_a_scene_with_clear_structure_learns_again(clear):
    """The first scene is calm, the second one's loss still falls."""
    one, learned, asked = object.__new__(MultiscaleEngine), [], []
    sums, nothing = np.zeros((2, 3, 4)), lambda *_: None
    one.progress = begun(100, 100)
    one.progress.settled[:] = True
    falls(one.progress, 0.1, 1e9)
    one._energies = lambda _: ("energies", "spectra")
    one.vectors = SimpleNamespace(x_new=None)
    one._evaluate = lambda: (sums, np.array([-0.1, -1.0]), np.array([99.9, 90.0]))
    one.strengths = SimpleNamespace(
        find_significant=lambda which, *given: (
            asked.append((which.tolist(), given)) or np.array([clear, False])
        ),
        take_blocks=nothing,
    )
    one.pairs = SimpleNamespace(
        take=nothing, forget=nothing, coefficients=lambda *_: (None, None, None)
    )
    one.steps = SimpleNamespace(follow=nothing, advance=nothing)
    one._learn = lambda which: learned.append(which.tolist()) or sums
    one.round()
    assert asked == [([True, False], ("energies", "spectra"))]
    assert learned == ([[True, False]] if clear else [])
    assert one.progress.tested.tolist() == [not clear, False]
    assert one.progress.settled.tolist() == [not clear, True]
    assert not one.progress.significance_due(np.ones(2, bool))[0]  # it has looked, or learns


def test_settled_scenes_of_one_source_count_their_parameters():
    """Those of several sources, or with a sky level, may exchange light, and count none."""
    one, asked, nothing = object.__new__(MultiscaleEngine), [], lambda *_: None
    one.progress = begun(100, 100, 100, 100)
    one.scenes = [SimpleNamespace(profile=[0] * n, fit_sky=False) for n in (1, 1, 2, 1)]
    one.scenes[3].fit_sky = True
    one._energies, one._rest_others = (lambda _: (0, 0)), nothing
    found = SimpleNamespace(n_effective=np.array([[3.0, 20.0, 7.0]]))
    one.strengths = SimpleNamespace(
        learn=lambda *_: (np.array([0.05, 0.2, 0.05, 0.05]), None, np.zeros(4)),
        request_blocks=nothing,
        findings=lambda which, *_: (
            asked.append(which.tolist()) or [found if on else None for on in which]
        ),
    )
    one.vectors = SimpleNamespace(x_new=None)
    one.steps = SimpleNamespace(reweigh=nothing, queue_products=nothing, products=lambda: (None,))
    one.strengths.light = None
    one._learn(np.ones(4, bool))
    assert asked == [[True, False, False, False]]
    assert one.progress.n_determined.tolist() == [30, 0, 0, 0]


def test_scenes_look_when_they_are_calm_and_settled():
    progress = begun(100, 100, 100, 100, 3 * N_PIXELS)
    progress.settled[[0, 1, 2, 4]] = True
    progress.tested[1] = True
    falls(progress, *[0.8] * 5)  # 2.4 over three iterations
    accepted = np.ones(5, bool)
    assert progress.significance_due(accepted).tolist() == [True, False, True, False, True]
    assert not progress.significance_due(~accepted).any()
    falls(progress, 0.9, 0.8, 0.8, 0.8, 0.9)  # much, but for a scene of chi2 6
    assert progress.significance_due(accepted).tolist() == [False, False, True, False, True]


def test_scenes_that_still_fall_far_look_after_eighty_rounds():
    progress = begun(100, 100, 100, 100)
    progress.settled[:] = True
    falls(progress, 20, 20, 10, np.nan)  # the last one is unknown
    progress.n_rounds[:] = [79, 80, 80, 80]
    assert progress.significance_due(np.ones(4, bool)).tolist() == [False, True, False, False]


def test_scenes_that_are_not_described_look_as_soon_as_they_have_settled():
    """Whatever they gain: weak strengths, which count no misfit, would keep it."""
    progress = begun(1.51 * N_PIXELS, 1.49 * N_PIXELS, 1.51 * N_PIXELS)
    progress.settled[:2] = True
    falls(progress, 10.0, 10.0, 10.0)
    assert progress.significance_due(np.ones(3, bool)).tolist() == [True, False, False]


def test_no_fit_converges_before_it_has_looked():
    """Of a larger `loss_tol` than what looking needs."""
    progress = begun(100, 100)
    progress.loss_tol = float(CONVERGENCE_WINDOW)
    progress.settled[:] = True
    falls(progress, 0.9, 1.1)
    progress._losses[:, CONVERGENCE_WINDOW + 1 :] += 100  # far larger falls before
    accepted = np.ones(2, bool)
    assert progress.significance_due(accepted).tolist() == [True, True]
    progress.next_actions(accepted)
    assert progress.converged.tolist() == [True, False]
