"""Fits in correlated noise: errors that are right where it is stated, too small where it is not."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from clresample import (
    PSF,
    Blend,
    Frame,
    Grid,
    Observation,
    PointSource,
    Settings,
    deblend_many,
    fluxes,
)
from clresample.files.results import read_result, write_result
from clresample.measurement.quality import summary
from clresample.sky.correlation import NoiseCorrelation

N, FLUX = 40, 200.0
DRIZZLE = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
RHO = fftconvolve(DRIZZLE, DRIZZLE[::-1, ::-1])


def observation(rng, noise):
    """A star of 200 counts in the middle of 40 x 40 pixels of drizzled noise, sigma 1 a pixel."""
    white = rng.normal(size=(N + 2, N + 2))
    image = fftconvolve(white, DRIZZLE, mode="valid") / np.sqrt((DRIZZLE**2).sum())
    psf = PSF.gaussian(1.6, n_pixels=(41, 41))
    image = image + FLUX * psf.images[0][:N, :N]  # the star at pixel (20, 20)
    return Observation(image, psf, Grid.flat((N, N), 0.2), weights=1.0, channels=["g"], noise=noise)


def fitted(noise, n=80):
    rng = np.random.default_rng(7)
    frame = Frame(Grid.flat((N, N), 0.2), PSF.gaussian(0.8))
    star = PointSource(position_px=(20.0, 20.0), free_position=False)
    blends = [Blend((observation(rng, noise),), (star,), frame) for _ in range(n)]
    return deblend_many(blends, settings=Settings(max_iter=5))


def pulls(results):
    found = [fluxes(result) for result in results]
    flux = np.array([flux[0, 0] for flux, _ in found])
    return (flux - FLUX) / np.sqrt([covariance[0, 0, 0] for _, covariance in found])


def test_errors_hold_the_noise_that_is_stated():
    right, wrong = (pulls(fitted(noise)) for noise in (RHO, None))
    assert right.std() == pytest.approx(1, abs=0.25)  # 3 sigma of 80 draws
    assert abs(right.mean()) < 0.35
    assert wrong.std() > 1.6


def test_chi2_is_one_and_pictures_are_of_the_data(tmp_path):
    (result,) = fitted(RHO, 1)
    chi2 = summary(result)["chi2"]["g"]
    assert chi2 == pytest.approx(1, abs=0.2)
    model = result.model(0)
    expected = fluxes(result)[0][0, 0] * result.observations[0].psf.images[0][:N, :N]
    assert np.abs(model[0] - expected).max() < 1e-3 * expected.max()
    write_result(tmp_path / "r.fits", result)
    again = read_result(tmp_path / "r.fits")
    assert isinstance(again.observations[0].noise[0], NoiseCorrelation)
    assert summary(again)["chi2"]["g"] == chi2
