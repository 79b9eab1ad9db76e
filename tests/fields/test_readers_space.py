"""Readers of HST's drizzled images and of JWST's stage 3 images."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from astropy.wcs.wcsapi import SlicedLowLevelWCS
from helpers.fields import mosaics_of
from helpers.survey_files import (
    SHAPE,
    header_of,
    noise_image,
    psf_image,
    sky_grid,
    write_drizzled,
    write_i2d,
)

from clresample import PSF, FieldOptions, Grid, read_hst, read_jwst, run_field, simulate_field
from clresample.sky.box import Box
from clresample.sky.wcs_interface import Ape14Wcs

WHOLE = Box.of(SHAPE)
PSF_OF = PSF(psf_image())


def test_a_drizzled_image(tmp_path):
    grid, notes = write_drizzled(tmp_path / "j_drc.fits"), []
    mosaic = read_hst(tmp_path / "j_drc.fits", psf=PSF_OF, noise="white", notes=notes)
    (channel,) = mosaic.channels
    assert (mosaic.name, channel.name) == ("HST", "F814W")
    assert abs(channel.zero_point - 25.947) < 2e-3
    weights = channel.weights(WHOLE)
    assert not weights[:, :5].any()  # no exposure
    assert abs(weights[5, 9] ** -0.5 / 0.01 - 1) < 0.05  # the scatter of the image
    assert any("taken as inverse variance" in note for note in notes)
    assert np.array_equal(mosaic.grid.sky(3, 4), grid.sky(3, 4))


def test_total_counts_are_told_from_counts_a_second(tmp_path):
    write_drizzled(tmp_path / "a.fits", unit="ELECTRONS")
    (channel,) = read_hst(tmp_path / "a.fits", psf=PSF_OF, noise="white").channels
    assert abs(channel.zero_point - 25.947 - 7.5) < 2e-3


def test_weights_in_a_file_beside(tmp_path):
    header = header_of(sky_grid(scale=0.03), MAGZERO=25.0, FILTER="F606W")
    fits.PrimaryHDU(noise_image(0.1), header).writeto(tmp_path / "x_f606w_sci.fits")
    with pytest.raises(ValueError, match="weight of band F606W is missing"):
        read_hst(tmp_path / "x_f606w_sci.fits", psf=PSF_OF)
    fits.PrimaryHDU(np.full(SHAPE, 7.0)).writeto(tmp_path / "x_f606w_wht.fits")
    (channel,) = read_hst(tmp_path / "x_f606w_sci.fits", psf=PSF_OF, noise="white").channels
    assert channel.zero_point == 25.0
    assert abs(channel.weights(WHOLE)[0, 0] ** -0.5 / 0.1 - 1) < 0.05


def test_errors_and_data_quality_of_one_exposure(tmp_path):
    quality = np.zeros(SHAPE, np.int16)
    quality[2], quality[3] = 16, 4096
    science = header_of(sky_grid(), BUNIT="ELECTRONS/S", PHOTFLAM=1e-19, PHOTPLAM=8000.0)
    hdus = [
        fits.PrimaryHDU(header=fits.Header({"FILTER": "F110W"})),
        fits.ImageHDU(noise_image(), science, name="SCI"),
        fits.ImageHDU(np.full(SHAPE, 2.0), name="ERR"),
        fits.ImageHDU(quality, name="DQ"),
    ]
    fits.HDUList(hdus).writeto(tmp_path / "i_flt.fits")
    weights = read_hst(tmp_path / "i_flt.fits", psf=PSF_OF).channels[0].weights(WHOLE)
    assert not weights[2:4].any() and np.allclose(weights[4], 0.25)
    given = {"psf": PSF_OF, "mask_bits": [12]}
    weights = read_hst(tmp_path / "i_flt.fits", **given).channels[0].weights(WHOLE)
    assert weights[2].all() and not weights[3].any()


def test_the_correlation_of_drizzled_noise_is_estimated(tmp_path):
    write_drizzled(tmp_path / "a.fits")
    rough = noise_image(0.01)
    smooth = (rough + np.roll(rough, 1, axis=1)) / np.sqrt(2)
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        hdus["SCI"].data[:] = smooth
    mosaic = read_hst(tmp_path / "a.fits", psf=PSF_OF)
    rho = mosaic.noise[0].autocorrelation
    assert abs(rho[rho.shape[0] // 2, rho.shape[1] // 2 + 1] - 0.5) < 0.1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "psf of band F814W is missing, files of HST hold none: give psf"),
        ({"psf": PSF_OF, "cards": {"PHOTFLAM": 0.0}}, "has no PHOTFLAM and PHOTPLAM .*: give zero"),
    ],
)
def test_what_hst_lacks_is_asked_for(tmp_path, given, message):
    write_drizzled(tmp_path / "a.fits", **given.pop("cards", {}))
    with pytest.raises(ValueError, match=message):
        read_hst(tmp_path / "a.fits", noise="white", **given)


def test_a_stage_3_image_of_jwst(tmp_path):
    grid, notes = write_i2d(tmp_path / "jw_i2d.fits"), []
    mosaic = read_jwst(tmp_path / "jw_i2d.fits", psf=PSF_OF, noise="white", notes=notes)
    (channel,) = mosaic.channels
    assert (mosaic.name, channel.name) == ("JWST", "F444W")
    area = (0.06 / 206264.806) ** 2
    assert abs(channel.zero_point - (8.9 - 2.5 * np.log10(1e6 * area))) < 1e-6
    weights = channel.weights(WHOLE)
    assert not weights[:, :3].any() and not weights[8:10].any()  # ERR, then CON and WHT
    assert np.allclose(weights[10:, 3:], 4.0)
    assert np.array_equal(mosaic.grid.sky(3, 4), grid.sky(3, 4))
    assert any("no gwcs in the file: placed by the header's WCS" in note for note in notes)


def test_filters_of_the_pupil_wheel_and_what_jwst_lacks(tmp_path):
    write_i2d(tmp_path / "a.fits", FILTER="F150W2", PUPIL="F162M")
    given = {"psf": PSF_OF, "noise": "white"}
    assert read_jwst(tmp_path / "a.fits", **given).channels[0].name == "F162M"
    with pytest.raises(ValueError, match="psf of band F162M is missing, files of JWST hold none"):
        read_jwst(tmp_path / "a.fits")
    write_i2d(tmp_path / "b.fits", skip=("ERR",))
    with pytest.raises(ValueError, match="rms of band F444W is missing: b.fits has no HDU ERR"):
        read_jwst(tmp_path / "b.fits", **given)


def test_the_gwcs_places_the_pixels(tmp_path):
    gwcs = pytest.importorskip("gwcs")
    from astropy import coordinates, units as u
    from astropy.modeling import models

    to_sky = (
        (models.Shift(-20.0) & models.Shift(-30.0))
        | (models.Scale(-0.06 / 3600) & models.Scale(0.06 / 3600))
        | models.Pix2Sky_TAN()
        | models.RotateNative2Celestial(10.0, -29.99, 180.0)
    )
    frames = gwcs.coordinate_frames
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(u.pix, u.pix))
    sky = frames.CelestialFrame(reference_frame=coordinates.ICRS(), name="world")
    wcs = gwcs.WCS([(detector, to_sky), (sky, None)])
    write_i2d(tmp_path / "a.fits", wcs=wcs)
    notes = []
    mosaic = read_jwst(tmp_path / "a.fits", psf=PSF_OF, noise="white", notes=notes)
    assert isinstance(mosaic.grid.wcs, Ape14Wcs) and not any("WCS" in note for note in notes)
    assert np.allclose(mosaic.grid.sky(30.0, 20.0), [10.0, -29.99], atol=1e-9)
    seen = mosaic.observation(Box(20, 10, 50, 40))
    assert np.allclose(seen.grid.sky(10.0, 10.0), [10.0, -29.99], atol=1e-9)
    fitted = Grid.from_wcs(WCS(seen.grid.to_wcs().to_header(relax=True)), (30, 30))
    assert np.abs(fitted.positions_in(seen.grid, 3.0, 29.0) - [3, 29]).max() < 1e-5
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:  # a tree that cannot be read
        hdus["ASDF"].data["ASDF_METADATA"][:, :30] = 0
    read_jwst(tmp_path / "a.fits", psf=PSF_OF, noise="white", notes=notes)
    assert any("its gwcs cannot be read" in note for note in notes)


def test_a_field_behind_the_interface_is_that_on_the_wcs(tmp_path):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    given = {"rubin_bands": ("i",), "psf_variation": 0.1, "bad_columns": 1}
    sky = simulate_field(11, n_pixels=128, density=160, clustering=0.5, **given)
    mosaics = mosaics_of(sky)[:1]
    place = SlicedLowLevelWCS(mosaics[0].grid.wcs, Ellipsis)
    behind = (replace(mosaics[0], grid=Grid.from_wcs(place, mosaics[0].grid.shape)),)
    rows = []
    for name, given, workers in (("own", mosaics, 0), ("behind", behind, 1)):
        run_field(given, tmp_path / name, options=FieldOptions(passes=1, workers=workers))
        rows.append(QTable.read(tmp_path / name / "catalogue.ecsv"))
    own, other = rows
    assert own["id"].tolist() == other["id"].tolist() and len(own) > 4
    step = (own["flux_VIS"] - other["flux_VIS"]) / own["flux_err_VIS"]
    assert np.abs(step).max() < 1e-2
    for key in ("ra", "dec", "ra_centroid", "dec_centroid"):
        assert np.abs((own[key] - other[key]).to_value("arcsec")).max() < 1e-3
    model = fits.getheader(tmp_path / "behind" / "model_Euclid.fits")
    there = Grid.from_wcs(WCS(model), mosaics[0].grid.shape)
    assert np.abs(there.positions_in(mosaics[0].grid, 9.0, 110.0) - [9, 110]).max() < 1e-3
