"""Further starts of pairs of galaxies at nearly one place, and the doubt about their fluxes."""

import numpy as np
import pytest
from helpers.scenes import blend

from clresample import Settings
from clresample.deblending.batch import deblend_many
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.start.close_pairs import _larger_neighbours, run_from_equal_profiles
from clresample.deblending.start.profile_fit import ProfileFit

FLUX = np.array((3000.0, 2500, 2100))
SMALL, LARGE = (np.log(1.5), 0, 0, np.log(6.5)), (np.log(7.5), 0.2, -0.1, np.log(5.0))
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
    np.testing.assert_allclose(sizes, np.log([6.0, size]), atol=0.02)
    flux = (one.start.spectra / one.start.peaks[:, None])[..., None]
    assert (np.abs(one.start.flux_doubt) < 0.02 * flux).all()  # others are excluded
    assert spoilt[0].moves.all()


def test_errors_hold_divisions_of_light_that_are_not_excluded(device, spoilt, monkeypatch):
    """One of two faint galaxies may have gained light of the other, by the doubt of the start."""
    (known,) = deblend_many([pair(0.01)], device=device)
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
    (other,) = deblend_many([pair(0.01)], device=device)
    unit = Fit(pair(0.01), Settings(), device, np.float32, pad=1).unit
    changes = np.moveaxis(doubt, 1, 0) * unit[:, None, None]
    added = known.errors.flux - other.errors.flux
    np.testing.assert_allclose(added, changes @ changes.swapaxes(1, 2), rtol=1e-3)


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
