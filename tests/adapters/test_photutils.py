"""photutils' PSF models as ours."""

import numpy as np
import pytest

from clresample.adapters.photutils import psf_of

psf = pytest.importorskip("photutils.psf", reason="photutils is not installed")
NDData = pytest.importorskip("astropy.nddata").NDData


def test_an_analytic_model_is_what_it_is_at_every_pixel():
    model = psf.CircularGaussianPRF(fwhm=3.0)
    ours = psf_of(model, n_pixels=21, oversampling=1)
    y, x = np.indices((21, 21)) - 10.0
    expected = psf.CircularGaussianPRF(flux=1, x_0=0, y_0=0, fwhm=3.0)(x, y)
    np.testing.assert_allclose(ours.images[0], expected / expected.sum(), atol=1e-12)


def test_oversampled_images_keep_their_width():
    fine = psf.CircularGaussianPRF(flux=1, x_0=0, y_0=0, fwhm=3.0)
    offsets = (np.arange(85) - 42) / 4
    model = psf.ImagePSF(fine(*np.meshgrid(offsets, offsets)), oversampling=4)
    ours, plain = psf_of(model, n_pixels=19), psf_of(fine, n_pixels=19, oversampling=1)
    assert ours.spacing == 0.25
    nu = np.linspace(-0.4, 0.4, 9)
    np.testing.assert_allclose(ours.otf(nu, nu), plain.otf(nu, nu), atol=1e-3)


def test_a_gridded_model_is_taken_at_its_place():
    offsets = np.arange(31) - 15.0
    stamps = [
        psf.CircularGaussianPRF(flux=1, x_0=0, y_0=0, fwhm=f)(*np.meshgrid(offsets, offsets))
        for f in (3.0, 3.0, 5.0, 5.0)
    ]
    places = [(0, 0), (100, 0), (0, 100), (100, 100)]  # photutils' order: (x, y)
    meta = {"grid_xypos": places, "oversampling": 1}
    model = psf.GriddedPSFModel(NDData(np.array(stamps), meta=meta))
    narrow = psf_of(model, position_px=(0, 50), n_pixels=31)
    wide = psf_of(model, position_px=(100, 50), n_pixels=31)
    np.testing.assert_allclose(narrow.images[0], stamps[0], atol=1e-4)
    np.testing.assert_allclose(wide.images[0], stamps[2], atol=1e-4)


def test_other_models_are_refused():
    from astropy.modeling.models import Gaussian2D

    with pytest.raises(ValueError, match="Gaussian2D"):
        psf_of(Gaussian2D())
