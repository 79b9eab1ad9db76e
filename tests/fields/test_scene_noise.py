"""The scene file's `noise`: estimated from blank sky, or an autocorrelation in a FITS image."""

import numpy as np
import pytest
from astropy.io import fits

from clresample.fields.field_toml.scene_file import read_scene
from clresample.files.fits import write_fits
from clresample.files.scene_keys import SceneError
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

RHO = np.array([[0.1, 0.4, 0.1], [0.4, 1.0, 0.4], [0.1, 0.4, 0.1]])
TEXT = """
[[observation]]
name = "cam"
image = "{image}"
psf = "psf.fits"
noise = "{noise}"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path, rng = tmp_path_factory.mktemp("noise"), np.random.default_rng(0)
    for name, n in (("small.fits", 30), ("large.fits", 90)):
        wcs = Grid.flat((n, n), 0.1).to_wcs(ra_deg=150.0, dec_deg=2.0)
        write_fits(path / name, rng.normal(size=(n, n)), Grid.from_wcs(wcs, (n, n)))
    fits.PrimaryHDU(PSF.gaussian(1.4, n_pixels=21).images[0]).writeto(path / "psf.fits")
    fits.PrimaryHDU(RHO).writeto(path / "rho.fits")
    return path


def read(folder, image, noise):
    (folder / "scene.toml").write_text(TEXT.format(image=image, noise=noise))
    return read_scene(folder / "scene.toml")


def test_a_file_gives_the_autocorrelation(folder):
    found = read(folder, "small.fits", "rho.fits")
    np.testing.assert_allclose(found.observations[0].noise[0].autocorrelation, RHO, atol=1e-12)
    assert found.inputs["noise of cam"] == folder / "rho.fits"


def test_an_estimate_is_made_and_noted(folder):
    found = read(folder, "large.fits", "estimate")
    assert found.observations[0].noise[0].error_factor(2.0) == pytest.approx(1, abs=0.15)
    assert any("estimated from blank sky" in note for note in found.notes)


def test_too_little_sky_and_missing_files_are_reported(folder):
    with pytest.raises(SceneError, match="pairs of blank pixels"):
        read(folder, "small.fits", "estimate")
    with pytest.raises(ValueError, match="absent.fits: no such file"):
        read(folder, "small.fits", "absent.fits")
