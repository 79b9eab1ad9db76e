"""Readers of Rubin's cell coadds, on a file that lsst-images wrote, and of exposures."""

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from helpers.survey_files import SHAPE, noise_image, psf_image, sky_grid, write_exposure

from clresample import PSF, NoiseCorrelation, read_rubin_coadd, read_rubin_exposure
from clresample.fields.readers.writers import write_cell_coadd
from clresample.files.atomic import FileError
from clresample.sky.box import Box

# 2 x 3 cells of 40 px from (160, 120) of the tract on, one missing, with 33 mask planes and two
# realisations of white noise; made by lsst-images 30.2026.4300
COADD = Path(__file__).parent / "data" / "cell_coadd.fits.gz"
WHOLE = Box.of((80, 120))


@pytest.fixture
def coadd(tmp_path):
    """The coadd, unpacked."""
    path = tmp_path / "cell_coadd.fits"
    with gzip.open(COADD) as packed, open(path, "wb") as plain:
        shutil.copyfileobj(packed, plain)
    return path


def test_a_coadd_of_lsst_images(coadd):
    inputs = {}
    mosaic = read_rubin_coadd(coadd, inputs=inputs)
    (channel,) = mosaic.channels
    assert (channel.name, channel.zero_point, mosaic.grid.shape) == ("r", 31.4, (80, 120))
    rng = np.random.default_rng(0)
    wanted = np.round(rng.normal(0, 20, (80, 120)))
    assert np.abs(channel.read(WHOLE) - wanted).max() < 1.0  # compressed with loss
    weights = channel.weights(WHOLE)
    assert not weights[[5, 7]].any() and weights[6].all()  # of two HDUs of masks
    assert np.allclose(weights[weights > 0], 1 / 400, rtol=1e-3)
    assert np.allclose(mosaic.grid.sky(49.0, 29.0), [10.0, -30.0], atol=1e-9)
    y, x = np.mgrid[-7:8, -7:8]
    for row, column, sigma in ((39.4, 10, 1.5), (39.6, 39.4, 1.7), (39, 79.6, 1.7)):
        image = np.exp(-(y**2 + x**2) / 2 / sigma**2)
        assert np.allclose(
            mosaic.psf.psf_at(row, column).images[0], PSF(image).images[0], atol=1e-5
        )
    near = mosaic.psf.psf_at(60, 45).images  # of a missing cell: that of the nearest
    assert np.array_equal(near, mosaic.psf.psf_at(60, 30).images)
    assert isinstance(mosaic.noise[0], NoiseCorrelation)
    assert abs(mosaic.noise[0].autocorrelation[8, 9]) < 0.04
    assert list(inputs.values()) == [coadd]


def test_mask_bits_of_a_coadd(coadd):
    weights = read_rubin_coadd(coadd, mask_bits=["DETECTED"]).channels[0].weights(WHOLE)
    assert weights[[5, 7]].all() and not weights[6].any()
    with pytest.raises(ValueError, match="mask_bits has 'SAT', the mask's header names NO_DATA"):
        read_rubin_coadd(coadd, mask_bits=["SAT"])
    with pytest.raises(ValueError, match="has 2 masks: give names"):
        read_rubin_coadd(coadd, mask_bits=[0])


def test_the_package_that_writes_them_reads_the_same(coadd):
    images = pytest.importorskip("lsst.images.serialization")
    theirs, mosaic = images.read_archive(str(coadd)), read_rubin_coadd(coadd)
    assert np.array_equal(theirs.image.array, mosaic.channels[0].read(WHOLE))
    sky = theirs.sky_projection.pixel_to_sky(x=120 + 7.0, y=160 + 11.0)
    assert np.allclose(mosaic.grid.sky(11.0, 7.0), [sky.ra.deg, sky.dec.deg], atol=1e-9)
    kernel = theirs.psf.compute_kernel_image(x=125, y=230).array
    assert np.allclose(mosaic.psf.psf_at(70, 5).images[0], PSF(kernel).images[0])


def written(path, band="r", cell_px=30):
    """A coadd of our own writer with counts of zero point 27."""
    saturated = np.zeros(SHAPE, bool)
    saturated[4] = True
    return write_cell_coadd(
        path,
        band,
        noise_image(2.0),
        sky_grid(),
        variance=np.full(SHAPE, 4.0),
        mask={"NO_DATA": np.zeros(SHAPE, bool), "SATURATED": saturated},
        zero_point=27.0,
        psf_at=lambda y, x: psf_image(1.5 + 0.01 * y),
        cell_px=cell_px,
    )


def test_what_we_write_is_read(tmp_path):
    paths = [written(tmp_path / f"{band}.fits", band) for band in "ri"]
    mosaic = read_rubin_coadd(paths)
    assert [c.name for c in mosaic.channels] == ["r", "i"] and mosaic.noise is None
    unit = 10 ** (0.4 * 4.4)
    assert np.allclose(mosaic.channels[1].read(Box.of(SHAPE)), unit * noise_image(2.0), rtol=1e-5)
    weights = mosaic.channels[0].weights(Box.of(SHAPE))
    assert not weights[4].any() and np.allclose(weights[5], 0.25 / unit**2)
    assert np.allclose(
        mosaic.psf.psf_at(35, 3).images[0], PSF(psf_image(1.5 + 0.01 * 44.5)).images[0], atol=1e-5
    )


def test_what_is_no_coadd_is_refused(tmp_path, coadd):
    write_exposure(tmp_path / "exposure.fits")
    with pytest.raises(FileError, match="no cell coadd.*HDUs: PRIMARY, IMAGE, MASK, VARIANCE"):
        read_rubin_coadd(tmp_path / "exposure.fits")
    path = written(tmp_path / "later.fits")
    with fits.open(path) as hdus:
        text = bytes(hdus["JSON"].data["JSON"][0]).replace(b'read_version": 1', b'read_version": 2')
        row = np.empty(1, object)
        row[0] = np.frombuffer(text, np.uint8)
        hdus["JSON"] = fits.BinTableHDU.from_columns(
            [fits.Column("JSON", "PB()", array=row)], name="JSON"
        )
        hdus.writeto(path, overwrite=True)
    with pytest.raises(FileError, match="needs a reader of version 2, this is 1"):
        read_rubin_coadd(path)
    with fits.open(path) as hdus:
        del hdus["JSON"]
        hdus.writeto(path, overwrite=True)
    with pytest.raises(FileError, match="no cell coadd"):
        read_rubin_coadd(path)


@pytest.mark.parametrize(
    ("given", "point"),
    [
        ({"unit": "nJy"}, 31.4),
        ({"photocalib": 57.54399}, 27.0),
        ({"photocalib": 57.54399, "fluxmag0": 1e12}, 27.0),
        ({"fluxmag0": 63095734448.0194}, 27.0),
        ({"fluxmag0": 63095734448.0194, "names": False}, 27.0),
    ],
)
def test_exposures_with_their_calibrations(tmp_path, given, point):
    grid = write_exposure(tmp_path / "e.fits", **given)
    mosaic = read_rubin_exposure(tmp_path / "e.fits", psf=PSF(psf_image()))
    (channel,) = mosaic.channels
    assert abs(channel.zero_point - point) < 1e-5 and channel.name == "r"
    weights = channel.weights(Box.of(SHAPE))
    if given.get("names", True):
        assert not weights[[5, 7]].any()
    assert np.allclose(weights[6], 1 / 9)
    assert np.array_equal(mosaic.grid.sky(3, 4), grid.sky(3, 4))


def test_what_an_exposure_lacks_is_asked_for(tmp_path):
    write_exposure(tmp_path / "e.fits")
    with pytest.raises(ValueError, match="zero_point of band r is missing, there is neither"):
        read_rubin_exposure(tmp_path / "e.fits", psf=PSF(psf_image()))
    with pytest.raises(
        ValueError, match=r"psf of band r is missing, it can be read by .* give psf"
    ):
        read_rubin_exposure(tmp_path / "e.fits", zero_point=27.0)
    notes = []
    write_exposure(tmp_path / "v.fits", photocalib=2.0)
    read_rubin_exposure(tmp_path / "v.fits", psf=PSF(psf_image()), notes=notes)
    assert any("calibration varies" in note for note in notes)


def test_a_masked_image_of_lsst_images_is_an_exposure(coadd):
    mosaic = read_rubin_exposure(coadd, psf=PSF(psf_image()))
    (channel,), (other,) = mosaic.channels, read_rubin_coadd(coadd).channels
    assert channel.zero_point == 31.4
    assert np.array_equal(channel.weights(WHOLE), other.weights(WHOLE))


def test_the_package_reads_the_exposures_that_are_tested(tmp_path):
    images = pytest.importorskip("lsst.images")
    write_exposure(tmp_path / "e.fits", unit="nJy")
    theirs = images.MaskedImage.read_legacy(str(tmp_path / "e.fits"))
    mosaic = read_rubin_exposure(tmp_path / "e.fits", psf=PSF(psf_image()))
    whole = Box.of(SHAPE)
    assert np.array_equal(theirs.image.array, mosaic.channels[0].read(whole))
    assert np.array_equal(theirs.variance.array, mosaic.channels[0].weight.read(whole))
    unusable = theirs.mask.get("SATURATED") | theirs.mask.get("NO_DATA")
    assert np.array_equal(unusable, mosaic.channels[0].masked(whole))
