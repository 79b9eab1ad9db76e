"""The command on scenes with pixels or channels without weight, and on sources that are one."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from helpers.tiny_scene import OF_FIT, change, deblend


def finite(folder):
    """Asserts that the outputs are all there and hold finite numbers in every image."""
    assert {p.name for p in folder.iterdir()} == OF_FIT
    with fits.open(folder / "result.fits") as hdus:
        for hdu in hdus:
            assert not hdu.is_image or hdu.data is None or np.isfinite(hdu.data).all(), hdu.name


def test_a_scene_is_fitted_and_holds_finite_numbers_only(scene):
    assert deblend(scene) == 0
    finite(scene / "out")


def masked_channel(scene):
    """The second of the two channels of B is masked whole."""
    with fits.open(scene / "b.fits", mode="update") as hdus:
        hdus[0].data = np.stack([hdus[0].data] * 2)
    change(scene, 'weight = "wb.fits"', 'channels = ["r", "i"]\nvariance = 0.01\nmask = "mb.fits"')
    mask = np.zeros((2, 14, 14), "u1")
    mask[1] = 1
    fits.PrimaryHDU(mask).writeto(scene / "mb.fits")


def masked_observation(scene):
    """All of B is masked."""
    change(scene, 'weight = "wb.fits"', 'variance = 0.01\nmask = "mb.fits"')
    fits.PrimaryHDU(np.ones((14, 14), "u1")).writeto(scene / "mb.fits")


def masked_half(scene):
    """Half of A is masked, and holds NaN."""
    change(scene, "variance = 0.01", 'variance = 0.01\nmask = "ma.fits"')
    mask = np.zeros((20, 20), "u1")
    mask[:, 10:] = 1
    fits.PrimaryHDU(mask).writeto(scene / "ma.fits")
    with fits.open(scene / "a.fits", mode="update") as hdus:
        hdus[0].data[mask > 0] = np.nan


def weights_of_zero(scene):
    """Weights of B: 0 in every third row, where the image holds infinity."""
    weights = np.full((14, 14), 100.0, "f4")
    weights[::3] = 0
    fits.PrimaryHDU(weights).writeto(scene / "wb.fits", overwrite=True)
    with fits.open(scene / "b.fits", mode="update") as hdus:
        hdus[0].data[::3] = np.inf


def no_weight(scene):
    """Weights of B are all 0."""
    fits.PrimaryHDU(np.zeros((14, 14), "f4")).writeto(scene / "wb.fits", overwrite=True)


def two_in_one(scene):
    """Both sources are points, at one position."""
    table = Table.read(scene / "sources.ecsv")
    table["type"], table["ra"], table["dec"] = "point", table["ra"][0], table["dec"][0]
    table.write(scene / "sources.ecsv", format="ascii.ecsv", overwrite=True)


FAULTS = masked_channel, masked_observation, masked_half, weights_of_zero, no_weight, two_in_one


@pytest.mark.parametrize("also", ["", "shifts and sky"])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_pixels_without_weight_and_equal_sources(scene, capsys, fault, also):
    """COVARIANCE, RESIDUAL and LOSSES have held NaN, and matrices been singular."""
    fault(scene)
    if also:
        change(scene, "max_iter = 2", "max_iter = 2\nfit_shifts = true\nfit_sky = true")
    assert deblend(scene) == 0
    finite(scene / "out")
    assert "nan" not in capsys.readouterr().out
