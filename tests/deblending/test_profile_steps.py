"""Steps of the start's least squares on a valley of one parameter: gained, damped, ended."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.linear.linearised_scenes import LinearisedScenes
from clresample.deblending.settings import Settings
from clresample.deblending.start import profile_fit
from clresample.deblending.start.profile_fit import ProfileFit
from clresample.paper.settings import PaperSettings


class Valley:
    """Stands in for LinearisedScenes with one parameter a scene: chi2 = (theta - goal)^2 * steep +
    rest."""

    def __init__(self, goals, steep, rest, mean=0.0, scatter=1e6):
        self.goals, self.steep, self.rest = np.array(goals), steep, rest
        n = len(goals)
        shape = SimpleNamespace(mean=np.full(4, mean), scatter=np.full(4, scatter))
        self.components = [SimpleNamespace(shape=shape, source=0) for _ in goals]
        self.scene, self.index = np.arange(n), np.zeros(n, int)
        self.n_scenes, self.n_most = n, 1
        self.spectra, self.sky = np.ones((n, 1)), np.zeros((n, 1))
        self.normal = np.zeros((n, 1, 2, 2))
        self.n_looks = np.zeros(n, int)

    def render(self, scenes, thetas, _brightness, *, slopes):
        assert slopes.all()  # a trial that gains is the next one's beginning
        self.scenes, self.now = np.asarray(scenes), np.array([t[0] for t in thetas])
        self.n_looks[self.scenes] += 1

    def solve(self, _error):
        self.spectra[self.scenes, 0] = self.now[self.scenes]

    kept_solution, restore = LinearisedScenes.kept_solution, LinearisedScenes.restore

    def n_pixels(self):
        return np.full(self.n_scenes, np.inf)

    def rows_of(self, scenes):
        return np.searchsorted(self.scenes, scenes)

    def solution(self):
        return np.zeros((len(self.scenes), 1, 2))

    def away(self):
        return self.now[self.scenes] - self.goals[self.scenes]

    def compute_residuals(self, _error):
        return self.steep * self.away() ** 2 + self.rest


@pytest.fixture
def valley(monkeypatch):
    """Makes a ProfileFit of a Valley, whose equations promise `promise` times the way.

    If it is negative, they point away from the goal.
    """

    def made(goals, steep=1e4, rest=100.0, promise=1.0, **expected):
        looking = Valley(goals, steep, rest, **expected)

        def equations(_looking):
            k = len(looking.scenes)
            normal, right = np.tile(np.eye(4), (k, 1, 1)), np.zeros((k, 4))
            normal[:, 0, 0] = steep / abs(promise)
            right[:, 0] = -np.sign(promise) * steep * looking.away()
            return normal, right

        monkeypatch.setattr(profile_fit, "normal_equations", equations)
        monkeypatch.setattr(profile_fit, "peaks_of", lambda c, thetas: np.ones(len(c)))
        monkeypatch.setattr(profile_fit, "run_without_doubt", lambda *_: None)
        fit = ProfileFit(looking, np.ones((len(goals), 1)))
        fit.begin()
        return fit, looking

    return made


def test_steps_end_where_the_next_one_gains_less_than_asked(valley):
    fit, looking = valley([0.5, 0.05])
    before = looking.n_looks.copy()
    fit._step(np.arange(2), tol=30.0)
    assert (looking.n_looks - before).tolist() == [1, 0]  # chi2 of 21 and of 25 is left
    assert 101 < fit.chi2[0] < 130 and fit.chi2[1] == pytest.approx(125)


def test_a_start_ends_by_its_own_tolerance(valley):
    fit, looking = valley([0.5, 0.05])
    fit.tol, before = 30.0, looking.n_looks.copy()
    fit.run()
    assert (looking.n_looks - before)[0] < 3 and fit.chi2[1] == pytest.approx(125)


@pytest.mark.parametrize(("loss_tol", "tol"), [(0.25, 1.0), (0.025, 1.0), (6.25, 25.0)])
def test_rougher_fits_have_rougher_starts(loss_tol, tol):
    assert Settings(loss_tol=loss_tol).start_tol == tol
    assert PaperSettings().start_tol == 1.0


def test_profiles_step_to_the_bottom_and_stop_there(valley):
    """Each at its own pace, 1 at most at a time, until a step gains chi2 of 1."""
    fit, looking = valley([0.5, 2.4, 0.0])
    np.testing.assert_allclose(fit.chi2, 100 + 1e4 * looking.goals**2)
    before = looking.n_looks.copy()
    fit.run()
    np.testing.assert_allclose(fit.theta[:, 0, 0], looking.goals, atol=0.01)  # chi2 of 1
    np.testing.assert_allclose(fit.chi2, 100, atol=1)
    np.testing.assert_allclose(looking.spectra[:, 0], fit.theta[:, 0, 0])
    # 1, 1, 0.4 and what the damping left
    assert 0 == (looking.n_looks - before)[2] < (looking.n_looks - before)[0]
    assert (looking.n_looks - before)[0] < (looking.n_looks - before)[1] <= 6


@pytest.mark.parametrize(("n_pixels", "again"), [(np.inf, [1, 2, 4]), (10, [1, 2, 4, 5])])
def test_scenes_with_known_parameters_go_on_from_there(valley, monkeypatch, n_pixels, again):
    """In fewer trials.

    Second starts are of scenes whose galaxies grow beyond their earlier and their expected size,
    and of unexplained ones without an earlier fit.
    """
    fit, looking = valley([1.9, 1.9, 3.4, 0.5, 1.9, 0.5])
    begun: list[int] = []

    def second_start(fit, scenes):
        begun.extend(scenes)
        fit._step(scenes)

    monkeypatch.setattr(looking, "n_pixels", lambda: np.full(6, n_pixels))
    monkeypatch.setattr(fit.expected, "galaxies", np.ones((6, 1), bool))
    monkeypatch.setattr(profile_fit, "_run_from_large_galaxies", second_start)
    before = looking.n_looks.copy()
    profile_fit.start_from(fit, {0: [1.8, 0, 0, 0], 2: [1.8, 0, 0, 0], 3: [-1.5, 0, 0, 0]})
    fit.run()
    np.testing.assert_allclose(fit.theta[:, 0, 0], looking.goals, atol=0.01)
    n_trials = looking.n_looks - before
    assert n_trials[0] < n_trials[1] and begun == again
    assert fit.is_known.tolist() == [True, False, True, True, False, False]


def test_learning_ends_where_it_takes_back_what_a_step_gained(valley, monkeypatch):
    """Of that scene alone, whose doubt is made anew at the end."""
    fit, looking = valley([4.0, 4.0])
    learnt, doubted = [], []

    def learn(scenes):
        learnt.append(scenes.tolist())
        return np.where(scenes == 0, 1e6, -1.0)

    monkeypatch.setattr(fit, "_learn", learn)
    monkeypatch.setattr(fit, "set_contamination", lambda scenes, _: doubted.append(scenes.tolist()))
    fit.run()
    assert learnt[0] == [0, 1] and len(learnt) > 2
    assert all(scenes == [1] for scenes in learnt[1:])
    assert doubted == [[0]]
    np.testing.assert_allclose(fit.theta[:, 0, 0], looking.goals, atol=0.01)


def test_a_step_that_gains_nothing_is_taken_back_and_damped(valley):
    """Equations that promise three times the way: the next trial is a shorter one."""
    fit, looking = valley([0.1], promise=3.0)
    gains, real = [], fit._try

    def tried(scenes, trial):
        gain = real(scenes, trial)
        gains.append((bool(gain[0] > 0), float(fit.theta[0, 0, 0]), float(trial[0, 0, 0])))
        assert looking.spectra[0, 0] == fit.theta[0, 0, 0]
        return gain

    fit._try = tried
    fit.run()
    gained, at, tried_at = zip(*gains, strict=True)
    assert gained[:2] == (False, True) and at[0] == 0
    assert at[1] == tried_at[1] <= tried_at[0] / 4 and len(gains) <= 12
    assert fit.chi2[0] == pytest.approx(100, abs=1)


def test_a_scene_ends_when_a_step_gains_chi2_of_one(valley):
    """Or is expected to: 0.9 of 10,000 is not tried, 1.44 is."""
    fit, looking = valley([0.0095, 0.012], rest=1e4)
    before = looking.n_looks.copy()
    fit.run()
    assert (looking.n_looks - before).tolist() == [0, 1]


def test_a_step_far_too_long_that_gains_little_is_not_the_end(valley):
    """It leads from one side of the bottom to the other one: 0.4 of a promised 218."""
    fit, looking = valley([0.1], promise=2.1978)
    before = looking.n_looks.copy()
    fit.run()
    assert fit.chi2[0] == pytest.approx(100, abs=1) and (looking.n_looks - before)[0] > 1


def test_a_scene_that_no_step_helps_is_left_when_damping_is_too_large(valley):
    """Its parameters stay; a scene takes forty steps at most, one without parameters none."""
    fit, looking = valley([10.0], promise=-1.0)
    before = looking.n_looks.copy()
    fit.run()
    assert (looking.n_looks - before).tolist() == [5] and not fit.theta.any()
    assert fit.chi2.tolist() == [1e6 + 100] and looking.spectra[0, 0] == 0
    many, far = valley([90.0])
    before = far.n_looks.copy()
    many.run()  # each of 1
    assert many.theta[0, 0, 0] == pytest.approx(40.0) and (far.n_looks - before).tolist() == [40]
    still, seen = valley([0.0])
    still.counts[:] = 0  # a scene without parameters
    before = seen.n_looks.copy()
    still.run()
    assert (seen.n_looks == before).all()


def test_profiles_end_between_the_data_and_what_is_expected(valley):
    """At the mean of both, each in units of its scatter; that of the data is 0.01 here."""
    for scatter, share in ((0.01, 0.5), (0.02, 0.8), (0.005, 0.2)):
        fit, _ = valley([0.5, -0.1], rest=1.0, mean=0.1, scatter=scatter)
        fit.run()
        away = np.array([0.4, -0.2])
        np.testing.assert_allclose(fit.theta[:, 0, 0], 0.1 + share * away, atol=0.005)
        np.testing.assert_allclose(fit.theta[:, 0, 1:], 0.1)
        np.testing.assert_allclose(fit.chi2, 1 + 1e4 * (1 - share) * away**2, rtol=0.01)


def test_brightness_is_that_of_the_channel_that_sees_a_peak_best(monkeypatch):
    fit = object.__new__(ProfileFit)
    fit.looking = SimpleNamespace(
        spectra=np.array([[4.0, 9.0], [8.0, 1.0]]), scene=np.array([0, 1]), components=[0, 1]
    )
    fit.noise, fit.thetas = np.array([[1.0, 3.0], [2.0, 0.5]]), lambda theta: theta
    monkeypatch.setattr(profile_fit, "peaks_of", lambda *_: np.array([0.5, 10.0]))
    fit._measure_brightness(None)
    assert fit.brightness.tolist() == [2, 40]
