"""Profiles of large galaxies before the least squares of all shapes: from a grid, one by one."""

import numpy as np
import pytest
from helpers.scenes import blend

from bench.harness.ladder_cases import Limits, scene_of
from clresample import Blend, Settings
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.start import first_profiles as first_profiles_module, profile_fit
from clresample.deblending.start.first_profiles import GROWTH, first_profiles
from clresample.deblending.start.step_control import StepControl

GIANT = ((48.2, 47.6), (3e5, 2e5, 2.5e5), 14.0)
SMALL = [
    ((48 + 22 * np.sin(a), 48 + 22 * np.cos(a)), (200, 260, 150), 1.5)
    for a in (0.3, 1.6, 2.8, 4.1, 5.4)
]


STAR = ((20.0, 24.0), (900, 800, 700), 0)


@pytest.fixture
def sized(device, monkeypatch):
    """Sizes [ln px] that are expected of objects, those of the grid, and those of the start.

    Those of the grid are None if no scene is started again; `instead` takes the grid's place.
    """

    def sizes_of(objects, instead=first_profiles):
        kept = []

        def noted(fit, scenes, error):
            kept.append(np.array([theta[0] for theta in fit.thetas()]))
            large = instead(fit, scenes, error)
            kept.append(np.array([theta[0] for theta in fit.thetas()]))
            return large

        monkeypatch.setattr(first_profiles_module, "first_profiles", noted)
        one = Fit(blend(objects, shape=(96, 96), seed=5), Settings(), device, np.float32, pad=1)
        start_fits([one])
        return *(kept or (None, None)), np.array([theta[0] for theta in one.start.thetas])

    return sizes_of


@pytest.mark.parametrize("at", [0, 3, 5])
def test_a_giant_among_satellites_is_the_one_that_is_large(sized, at):
    """In whatever place it is listed; its satellites are left to the least squares."""
    before, first, found = sized([*SMALL[:at], GIANT, *SMALL[at:]])
    assert first[at] == pytest.approx(np.log(GIANT[2]), abs=0.1)
    assert found[at] == pytest.approx(np.log(GIANT[2]), abs=0.05)
    np.testing.assert_array_equal(np.delete(first, at), np.delete(before, at))
    assert (np.delete(found, at) < np.log(1.5 * GROWTH)).all()


def test_of_two_giants_each_has_its_size(sized):
    """The second is found in what the first one's model leaves."""
    other = ((24.0, 70.0), (4e4, 3e4, 3e4), 9.0)
    _, first, found = sized([GIANT, SMALL[0], other])
    sizes = np.log([GIANT[2], other[2]])
    assert abs(first[0] - sizes[0]) < 0.3
    np.testing.assert_allclose(found[[0, 2]], sizes, atol=0.1)


def test_a_first_profile_takes_no_neighbours_light_into_its_wings(device, monkeypatch):
    """The first of two equals is fitted without the other, whose light wide wings would explain."""
    wings = []

    def noted(fit, scenes, error):
        large = first_profiles(fit, scenes, error)
        wings.extend(theta[3] for theta in fit.thetas())
        return large

    monkeypatch.setattr(first_profiles_module, "first_profiles", noted)
    scene = scene_of("pair", "one", 41901, 14, Limits(largest_re_px=20))
    pair = Blend(scene.observations, scene.sources)
    start_fits([Fit(pair, Settings(), device, np.float32, pad=1)])
    assert min(wings) >= np.log(0.1)  # n = 4


def test_small_galaxies_are_started_once(sized):
    """Noise and neighbours are no reason for another start."""
    _, first, found = sized(SMALL)
    assert first is None
    assert (found < np.log(1.5 * GROWTH)).all()


def spoilt(fit, scenes, _error):
    """Sets sizes from which least squares do not return in place of those of the grid."""
    fit.theta[scenes, :, 0] = np.log(1e6 * GIANT[2])
    return np.ones(fit.source.shape, bool)


def test_of_two_starts_the_better_fit_stays(sized):
    """A grid that gives every galaxy the size of the giant changes nothing."""
    *_, found = sized([*SMALL[:2], GIANT], spoilt)
    assert found[2] == pytest.approx(np.log(GIANT[2]), abs=0.1)
    assert (found[:2] < np.log(1.5 * GROWTH)).all()


def test_a_first_start_ends_when_a_galaxy_has_grown(sized, monkeypatch):
    """It goes on where the grid has no large galaxy."""
    steps, objects = [], [GIANT, ((20.0, 24.0), (900, 800, 700), 2.0)]

    def none(fit, scenes, _error):
        steps.append(len(tried))
        fit.theta[scenes, 0, 0] = np.log(1e6 * GIANT[2])
        return np.zeros(fit.source.shape, bool)

    tried, real = [], profile_fit.ProfileFit._try
    monkeypatch.setattr(profile_fit.ProfileFit, "_try", lambda *a: tried.append(a) or real(*a))
    *_, found = sized(objects, none)
    assert found[0] == pytest.approx(np.log(GIANT[2]), abs=0.05)
    assert 0 < 2 * steps[0] < len(tried)


def test_two_fits_are_compared_under_the_same_doubt(sized, monkeypatch):
    """The first start comes back with its doubt: chi2 is then that of the state solved anew."""
    measured = []

    def noted(fit, _scenes, scenes):
        kept = fit.chi2[scenes].copy()
        fit._take(scenes)
        measured.append((kept, fit.chi2[scenes]))

    monkeypatch.setattr(profile_fit, "run_without_doubt", noted)
    sized([GIANT, ((60.0, 52.0), GIANT[1], 11.0), ((44.0, 40.0), (9e3, 8e3, 7e3), 1.5)], spoilt)
    ((kept, again),) = measured
    assert len(kept)
    np.testing.assert_allclose(kept, again, rtol=1e-5)


def test_a_first_start_that_wins_goes_on(sized, monkeypatch):
    """To where no step gains anything."""
    further = []

    def noted(fit, scenes):
        given = *fit._equations(scenes), fit.population.galaxies[scenes]
        further.extend(StepControl(len(fit.theta)).next(scenes, *given)[1])

    monkeypatch.setattr(profile_fit, "fit_faint_shapes", noted)
    light = np.array([1e4, 9e3, 7e3])
    sized([((48.2, 47.6), light, 4.0), ((48.2, 53.6), light, 5.6)], spoilt)
    assert len(further) == 1 and further[0] < profile_fit.CHI2_TOL


def test_profiles_do_not_depend_on_the_other_scenes(device, monkeypatch):
    """With a fitted sky: a giant alone, and beside a scene with a star, which is modelled first."""
    gains, products = [], first_profiles_module.products_beside

    def noted(*args):
        around, right, *rest = products(*args)
        gains.append(right[around.scene == around.n_scenes - 1])
        return around, right, *rest

    monkeypatch.setattr(first_profiles_module, "products_beside", noted)

    def fit_of(objects):
        one = blend(objects, shape=(96, 96), seed=5)
        return Fit(one, Settings(fit_sky=True), device, np.float32, pad=1)

    start_fits([fit_of([GIANT])])
    alone = gains.pop(0)
    gains.clear()
    start_fits([fit_of([STAR, GIANT]), fit_of([GIANT])])
    np.testing.assert_allclose(gains[0], alone, rtol=1e-4)
