"""Wings that data hardly show: two minima of the start's chi2, the better one, and the error."""

import numpy as np
import pytest
from helpers.scenes import MODEL_PSF, frame

from clresample import ExtendedSource, Grid, Observation, deblend
from clresample.deblending.profiles import profile, psf_second_moment
from clresample.deblending.start import profile_fit
from clresample.deblending.start.profile_fit import ProfileFit

SHAPE, PLACE = (64, 64), (31.3, 32.1)


@pytest.fixture
def fitted(device, monkeypatch):
    """Fits a galaxy of these wings and signal to noise: beta at the end, wings' error, Result."""
    kept, measure, run = {}, profile_fit.wings_error, ProfileFit.run

    def noted(fit):
        run(fit)
        kept["beta"], kept["wings"] = np.exp(fit.theta[0, 0, 3]), fit.wings[0].copy()

    monkeypatch.setattr(ProfileFit, "run", noted)

    def fit_of(beta, snr, *, measured=True):
        theta = np.array([np.log(2.5), 0.1, 0.0, np.log(beta)])
        image = profile(theta, PLACE, SHAPE, psf_second_moment(MODEL_PSF), slopes=False)
        image *= snr / np.linalg.norm(image)
        data = image + np.random.default_rng(3).normal(size=image.shape)
        seen = Observation(data, MODEL_PSF, Grid.flat(SHAPE, 0.1), weights=1.0, channels=["r"])
        measuring = measure if measured else lambda fit, *_: fit.wings
        monkeypatch.setattr(profile_fit, "wings_error", measuring)
        sources = [ExtendedSource(position_px=PLACE)]
        found = deblend([seen], sources, frame=frame(SHAPE), device=device)
        return kept["beta"], kept["wings"], found

    return fit_of


@pytest.mark.parametrize("beta, wide", [(0.5, True), (6.5, False)])
def test_wings_are_found_where_the_data_have_them(fitted, beta, wide):
    """At signal to noise 14, where steps from no wings end at none."""
    found, _, _ = fitted(beta, 14)
    assert (found < 1) == wide


def test_the_error_of_a_flux_holds_wings_that_data_do_not_tell(fitted):
    """The fit without wings stays, the other one is nearly as good and a quarter brighter."""
    found, wings, result = fitted(0.8, 12)
    _, none, without = fitted(0.8, 12, measured=False)
    assert found > 3 and wings[0] > 0.2 * result.components[0].flux[0] and not none.any()
    added = result.errors.flux[0, 0, 0] - without.errors.flux[0, 0, 0]
    assert added == pytest.approx(wings[0] ** 2, rel=1e-3)
    assert result.errors.colour[0, 0, 0] == pytest.approx(result.errors.flux[0, 0, 0])
