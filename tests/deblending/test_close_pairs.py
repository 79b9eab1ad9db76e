"""Further starts of pairs of galaxies at nearly one place, and the doubt about their fluxes."""

import numpy as np
import pytest
from helpers.scenes import blend

from clresample import Settings
from clresample.deblending.batch import deblend_many
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.linear.spectra import MODEL_ERROR
from clresample.deblending.start import close_pairs
from clresample.deblending.start.close_pairs import _larger_neighbours, run_from_equal_profiles
from clresample.deblending.start.profile_fit import ProfileFit
from clresample.fields.execution.fitting import ROUGH_TOL

FLUX = np.array((3000.0, 2500, 2100))
SMALL, LARGE = (np.log(1.5), 0, 0, np.log(25.0)), (np.log(7.5), 0.2, -0.1, np.log(20.0))
SCENES = np.arange(1)


def pair(scale, *, size=6.0, place=(26.6, 24.8)):
    """Two galaxies of equal flux, the first one of 6 px."""
    return blend(
        [((26, 24), tuple(scale * FLUX), 6.0), (place, tuple(scale * FLUX), size)],
        shape=(56, 56),
        seed=6,
    )


@pytest.fixture
def spoilt(monkeypatch):
    """Starts galaxies with the light of both in the first one; the list of ProfileFits."""
    fits = []

    def run(fit):
        fit.theta[0] = LARGE, SMALL
        fit._take(SCENES)
        fit._step(SCENES)
        fits.append(fit)
        run_from_equal_profiles(fit, SCENES)

    monkeypatch.setattr(ProfileFit, "run", run)
    return fits


@pytest.mark.parametrize("size", [6.0, 2.0])
def test_each_of_two_galaxies_has_its_own_light(device, spoilt, size):
    """Equals, of which one was too small; and a small one in a large one, which stays."""
    one = Fit(pair(1.0, size=size), Settings(), device, np.float32, pad=1)
    start_fits([one])
    sizes = [theta[0] for theta in one.start.thetas]
    np.testing.assert_allclose(sizes, np.log([6.0, size]), atol=0.04)
    flux = (one.start.spectra / one.start.peaks[:, None])[..., None]
    assert (np.abs(one.start.flux_doubt) < 0.04 * flux).all()  # others are excluded
    assert spoilt[0].moves.all()


@pytest.mark.parametrize("n_ends", [4, 3])
def test_a_compact_galaxy_in_a_wide_one_gives_its_light_back(device, monkeypatch, n_ends):
    """It had grown to the wide one's size, with a cusp of its own light, and stays so without the
    exchange of both profiles."""

    def run(fit):
        fit.theta[0] = SMALL, (np.log(9.0), 0, 0, np.log(0.5))
        fit._take(SCENES)
        run_from_equal_profiles(fit, SCENES)

    monkeypatch.setattr(ProfileFit, "run", run)
    monkeypatch.setattr(close_pairs, "N_ENDS", n_ends)
    wide, compact = tuple(0.02 * FLUX), tuple(0.008 * FLUX)
    b = blend([((39, 40), wide, 12.0), ((41.5, 41), compact, 1.5)], shape=(80, 82), seed=1)
    one = Fit(b, Settings(), device, np.float32, pad=1)
    start_fits([one])
    sizes = np.array([theta[0] for theta in one.start.thetas])
    is_right = np.abs(sizes - np.log([12.0, 1.5])).max() < 0.1
    assert is_right == (n_ends == close_pairs.N_ENDS == 4)


def test_errors_hold_divisions_of_light_that_are_not_excluded(device, spoilt, monkeypatch):
    """One of two faint galaxies may have gained light of the other, by the doubt of the start."""
    (known,) = deblend_many([pair(0.005)], device=device)
    doubt = spoilt[0].flux_doubt.copy()
    assert (np.abs(doubt[..., 0]).sum(axis=1) > 0.3 * spoilt[0].looking.spectra.sum(axis=1)).all()
    held = np.abs(doubt[:, 0, 2])  # by the end with one shape held
    assert (held > 0.02 * spoilt[0].looking.spectra[:, 0]).all()
    np.testing.assert_allclose(doubt[1], -doubt[0], atol=0.1 * np.abs(doubt).max())
    bare = ProfileFit.run

    def without(fit):
        bare(fit)
        fit.flux_doubt[:] = 0

    monkeypatch.setattr(ProfileFit, "run", without)
    (other,) = deblend_many([pair(0.005)], device=device)
    unit = Fit(pair(0.005), Settings(), device, np.float32, pad=1).unit
    changes = np.moveaxis(doubt, 1, 0) * unit[:, None, None]
    added = known.errors.flux - other.errors.flux
    np.testing.assert_allclose(added, changes @ changes.swapaxes(1, 2), rtol=1e-3)


def test_pairs_have_ends_of_their_own(device, monkeypatch):
    """One does not change with another one of the scene, and errors are of each alone."""
    doubts, sizes = [], []

    def run(fit):
        fit.theta[0, :2] = SMALL, LARGE
        fit.theta[0, 2:, 0] = np.log([4.0, 1.5])
        fit._take(SCENES)
        fit._step(SCENES)
        before = fit._copy()
        for pairs in ([(3, 2)], [(0, 1), (3, 2)]):
            fit._restore(before, SCENES)
            monkeypatch.setattr(close_pairs, "_larger_neighbours", lambda *_, own=pairs: own)
            fit.flux_doubt = fit.flux_doubt[..., :0]
            run_from_equal_profiles(fit, SCENES)
            doubts.append(fit.flux_doubt)
            sizes.append(fit.theta[0, :, 0].copy())

    monkeypatch.setattr(ProfileFit, "run", run)
    flux = tuple(0.1 * FLUX)
    rows = [((22, 22), flux, 6.0), ((22.6, 22.8), flux, 6.0)]
    rows += [((66, 66), flux, 4.0), ((68, 66.5), flux, 1.5)]
    start_fits([Fit(blend(rows, shape=(88, 88), seed=6), Settings(), device, np.float32, pad=1)])
    (alone, both), ((size, _), (other, _)) = doubts, np.array(sizes)[:, :2]
    assert abs(size - np.log(6)) > 0.2 > abs(other - np.log(6))  # only where it is a pair
    n = close_pairs.N_ENDS
    np.testing.assert_allclose(both[2:, :, n:], alone[2:], atol=1e-3 * np.abs(alone).max())
    assert both[:2, :, :n].any() and alone[2:].any()
    assert not both[:2, :, n:].any() and not both[2:, :, :n].any() and not alone[:2].any()


def test_a_window_of_a_scene_with_held_light(device, spoilt):
    """Has the pixels of the whole scene there, with one galaxy's light and without the other's."""
    start_fits([Fit(pair(1.0), Settings(), device, np.float32, pad=1)])
    (fit,), one = spoilt, np.zeros(1, int)
    fit._look(SCENES, fit.theta, slopes=False)
    fit.looking.solve(MODEL_ERROR)
    chi2, sights = fit.looking.compute_residuals(MODEL_ERROR), fit.looking.sights
    found = [(device.get(s.residual), device.get(s.weight)) for s in sights]
    low = [np.array([[s.my // 3, s.mx // 5]]) for s in sights]
    size = [np.array([s.my // 2, s.mx // 3]) for s in sights]
    rest = fit.looking.without_light(fit.looking.spectra * [[0], [1]])
    cut = rest.cut(one, one, one, list(zip(low, size, strict=True)))
    cut.spectra[:] = fit.looking.spectra[:1]
    cut.render(SCENES, [fit.theta[0, 0]], fit.brightness[:1], slopes=False)
    own, wanted = cut.compute_residuals(MODEL_ERROR), 0.0
    for sight, (residual, weight), a, n in zip(cut.sights, found, low, size, strict=True):
        inside = (0, slice(None), *(slice(k, k + m) for k, m in zip(a[0], n, strict=True)))
        np.testing.assert_allclose(device.get(sight.residual)[0], residual[inside], atol=2e-3)
        wanted += (weight[inside] * residual[inside] ** 2).sum()
    np.testing.assert_allclose(own, wanted, rtol=1e-4)
    assert 5 < own < 0.5 * chi2


def test_rough_fits_have_no_further_starts(device, spoilt):
    settings = Settings(loss_tol=ROUGH_TOL)
    start_fits([Fit(pair(1.0), settings, device, np.float32, pad=1)])
    assert spoilt[0].flux_doubt.shape[2] == 0


@pytest.mark.parametrize("doubt, found", [((9.0, 200.0), [(1, 0)]), ((1.0, 2.0), [])])
def test_a_galaxy_without_its_light_is_told_by_that_of_others_about_it(
    device, monkeypatch, doubt, found
):
    """Not by sizes alone: wings take light too."""
    seen = []

    def run(fit):
        fit.theta[0] = SMALL, SMALL
        fit._take(SCENES)
        fit._step(SCENES)
        fit.population.contamination[0, :2] = doubt
        seen.extend(_larger_neighbours(fit, 0))

    monkeypatch.setattr(ProfileFit, "run", run)
    start_fits([Fit(pair(1.0), Settings(), device, np.float32, pad=1)])
    assert seen == found


def test_galaxies_apart_are_not_started_again(device, spoilt, monkeypatch):
    steps, real = [], ProfileFit._step
    monkeypatch.setattr(ProfileFit, "_step", lambda *a, **k: steps.append(1) or real(*a, **k))
    start_fits([Fit(pair(1.0, place=(40, 40)), Settings(), device, np.float32, pad=1)])
    assert len(steps) == 1
    assert not any(fit.flux_doubt.any() for fit in spoilt)
