"""Single steps of Levenberg-Marquardt: their bounds, promises and damping."""

import numpy as np
import pytest

from clresample.deblending.start.step_control import MAX_STEP, StepControl


def first_step(right, theta=(0, 0, 0, 1.5), *, normal=None, galaxy=True, free=None, damping=0.0):
    """Trial (4,), gains of the whole step and of the one taken; for one galaxy or star.

    normal (4, 4): with a prior of 0.25
    """
    steps = StepControl(1)
    steps.damping[:] = damping
    normal = np.eye(4) if normal is None else normal
    equations = [normal - 0.25 * np.eye(4)], np.full((1, 4), 0.25), np.array([right], float)
    given = np.array([[theta]], float), np.array([[galaxy]])
    trial, *gains = steps.next(np.zeros(1, int), *equations, *given, free)
    return trial[0, 0], *(float(g[0]) for g in gains)


def test_a_step_is_newton_s_and_promises_its_gain():
    trial, whole, taken = first_step([0.3, -0.2, 0.1, 0], normal=2 * np.eye(4))
    np.testing.assert_allclose(trial, [0.15, -0.1, 0.05, 1.5])
    assert whole == taken == pytest.approx((0.3**2 + 0.2**2 + 0.1**2) / 2)


def test_long_steps_are_cut_and_promise_less():
    trial, whole, taken = first_step([3.0, 0, 0, 0])
    assert trial[0] == MAX_STEP and whole == pytest.approx(9)
    assert taken == pytest.approx(2 * 3 - 1)


def test_long_steps_of_coupled_parameters_keep_their_direction():
    """Clipped one by one they would gain less than nothing, (1, -1) here."""
    normal = np.eye(4)
    normal[0, 1] = normal[1, 0] = 0.999
    right = normal @ [8.0, -4.0, 0, 0]
    trial, whole, taken = first_step(right, normal=normal)
    np.testing.assert_allclose(trial[:2], [MAX_STEP, -MAX_STEP / 2])
    assert 0 < taken < whole
    step = trial - [0, 0, 0, 1.5]
    assert taken == pytest.approx(2 * step @ right - step @ normal @ step)


def test_held_components_do_not_move():
    trial, whole, _ = first_step([0.5, 0.5, 0, 0.5], free=np.array([[False]]))
    np.testing.assert_allclose(trial, [0, 0, 0, 1.5], rtol=1e-12)
    assert whole == 0


@pytest.mark.parametrize("ln_beta", [-1.5, 1.5, 6.0])
def test_wings_step_where_profiles_are_linear(ln_beta):
    """In ln(1 + 1 / beta), whose slope there is that of ln beta, towards 0 by nine tenths."""
    small = 1e-4
    trial, *_ = first_step([0, 0, 0, small], (0, 0, 0, ln_beta))
    assert trial[3] - ln_beta == pytest.approx(small, rel=1e-3)
    scale = np.log1p(np.exp(-ln_beta))
    trial, whole, _ = first_step([0, 0, 0, 0.5], (0, 0, 0, ln_beta))
    expected = scale - 0.5 / (1 + np.exp(ln_beta))
    assert np.log1p(np.exp(-trial[3])) == pytest.approx(expected)
    # a profile near a Gaussian has little left to gain, whatever its curvature
    flat = np.diag([1, 1, 1, 1e-6])
    trial, whole, _ = first_step([0, 0, 0, 1e-3], (0, 0, 0, ln_beta), normal=flat)
    assert np.log1p(np.exp(-trial[3])) >= 0.1 * scale * (1 - 1e-6)
    assert whole <= 2e-3 * 0.9 * scale * (1 + np.exp(ln_beta))


def test_what_wings_cannot_give_is_asked_of_the_other_parameters():
    """At the bound of one of two coupled parameters the other one's step is the best."""
    normal = np.eye(4)
    normal[0, 3] = normal[3, 0] = 0.9
    _, whole, _ = first_step([0, 0, 0, 1.0], (0, 0, 0, 6.0), normal=normal)
    held = 0.9 * np.log1p(np.exp(-6.0)) * (1 + np.exp(6.0))
    best = max(2 * held - held**2 - 1.8 * held * x - x**2 for x in np.linspace(-2, 2, 4001))
    assert whole == pytest.approx(best, rel=1e-5)


def test_stars_have_no_wings():
    trial, *_ = first_step([0, 0, 0, 0.5], (0, 0, 0, 0), galaxy=False)
    assert trial[3] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("gain", "factor", "longest"),
    [(0.9, 1 / 3, MAX_STEP), (0.2, 3, MAX_STEP), (-0.1, 10, 0.1), (np.nan, 10, 0.1)],
)
def test_damping_follows_the_gain(gain, factor, longest):
    """Less after a step as promised, more after another, ten times after a rejected one."""
    steps = StepControl(2)
    scenes, before = np.array([1]), steps.damping.copy()
    zero = np.zeros((1, 1, 4))
    right = np.array([[0.4 * (1 + before[1]), 0, 0, 0]])
    steps.next(scenes, np.eye(4)[None], zero[0], right, zero, np.array([[False]]))
    assert steps.take(scenes, np.array([gain]), np.array([1.0])).all()
    np.testing.assert_allclose(steps.damping, before * [1, factor])
    np.testing.assert_allclose(steps.longest, [MAX_STEP, longest])
    steps.damping[1] = 500
    assert steps.take(scenes, np.array([gain]), np.array([1.0])).all() == (gain > 0.5)
