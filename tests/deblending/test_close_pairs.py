"""A further start of pairs of galaxies at nearly one place, and the doubt about their fluxes."""

import numpy as np
import pytest
from helpers.scenes import blend

from clresample import Settings
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.start import close_pairs
from clresample.deblending.start.profile_fit import ProfileFit

SMALL = np.log(1.5), 0, 0, np.log(6.5)
FLUX = np.array((3000.0, 2500, 2100))


@pytest.fixture
def started(device, monkeypatch):
    """Fits a pair from a state where one galaxy is small; (size [ln px], flux, doubt (2, 3))."""

    def fitted(second, scale=1.0):
        first = (26, 24), tuple(scale * FLUX), 6.0
        place, flux, sigma = second
        found = []

        def run(fit):
            fit.theta[0, 1] = SMALL
            fit._take(np.arange(1))
            fit._step(np.arange(1), learn=True)
            before = fit.theta.copy(), fit.chi2.copy()
            close_pairs.run_from_equal_profiles(fit, np.arange(1))
            found.append((*before, fit.theta.copy(), fit.chi2.copy(), fit.own_equations([0])))

        monkeypatch.setattr(ProfileFit, "run", run)
        both = [first, (place, tuple(scale * np.array(flux)), sigma)]
        one = Fit(blend(both, shape=(56, 56), seed=6), Settings(), device, np.float32, pad=1)
        start_fits([one])
        return one, found[0]

    return fitted
