"""Keys of an image that scenes and fields share: PSFEx, a cutout's place, SATURATE."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table

from clresample import PSF, Grid
from clresample.fields.field_toml.field_file import read_field
from clresample.fields.field_toml.scene_file import read_scene
from clresample.fields.mosaic import Mosaic
from clresample.fields.psfs.psfex import PSFExPSF
from clresample.fields.run import run_field
from clresample.files.atomic import FileError
from clresample.files.scene_keys import SceneError

SHAPE = (40, 44)
TOML = """
[[{table}]]
name = "cam"
image = "image.fits"
weight = 0.25
psf = "psf.fits"
{more}
"""
CARDS = {"POLNAXIS": 2, "POLGRP1": 1, "POLNAME1": "X_IMAGE", "POLZERO1": 1000.0, "POLSCAL1": 2000.0}
CARDS |= {"POLGRP2": 1, "POLNAME2": "Y_IMAGE", "POLZERO2": 2000.0, "POLSCAL2": 4000.0}
CARDS |= {"POLNGRP": 1, "POLDEG1": 1, "PSF_SAMP": 1.0, "PSFNAXIS": 3}
CARDS |= {"PSFAXIS1": 21, "PSFAXIS2": 21, "PSFAXIS3": 3}
OPTIONAL = ("POLNAXIS", "POLNGRP", "POLGRP1", "POLGRP2", "PSFNAXIS", "PSFAXIS1", "PSFAXIS3")


def basis():
    """A PSF that widens along x and narrows along y."""
    base, wide, narrow = (PSF.gaussian(s, n_pixels=21).images[0] for s in (2.0, 2.4, 1.7))
    return np.array([base, wide - base, narrow - base], np.float32)


def write_psf(path, *, rows=None, left_out=(), **changed):
    """A PSFEx file, or a table with a row for each of the detectors `rows`."""
    cards = {key: value for key, value in (CARDS | changed).items() if key not in left_out}
    mask = basis()
    if rows is None:
        column = fits.Column("PSF_MASK", f"{mask.size}E", dim="(21,21,3)", array=mask[None])
        hdu = fits.BinTableHDU.from_columns([column])
        hdu.header.update(cards)
    else:
        table = {key.lower(): [value] * len(rows) for key, value in cards.items()}
        table["polzero1"] = [cards["POLZERO1"] + 500 * k for k in range(len(rows))]
        table |= {"psf_mask": np.array([mask] * len(rows)), "ccdname": rows}
        hdu = fits.table_to_hdu(Table(table))
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)


@pytest.fixture
def folder(tmp_path):
    header = Grid.flat(SHAPE, 0.2).to_wcs(ra_deg=10, dec_deg=-30).to_header()
    header["SATURATE"] = 4000.0
    image = np.random.default_rng(0).normal(100, 2, SHAPE).astype(np.float32)
    fits.HDUList(
        [fits.PrimaryHDU(header=fits.Header({"MAGZERO": 27.5})), fits.ImageHDU(image, header)]
    ).writeto(tmp_path / "image.fits")
    write_psf(tmp_path / "psf.fits")
    return tmp_path


def opened(folder, more, table="observation"):
    """The PSF field (or PSF), saturation and notes of an image, read as a scene or a field."""
    path = folder / "file.toml"
    path.write_text(TOML.format(table=table, more=more))
    found = read_scene(path) if table == "observation" else read_field(path)
    if table == "observation":
        (o,) = found.observations
    else:
        o = found.mosaics[0].observation()
    return o.psf_field or o.psf, o, found.notes


@pytest.mark.parametrize("detector", [None, 0, "N1"])
def test_rows_of_a_table_are_those_of_the_header(tmp_path, detector):
    write_psf(tmp_path / "header.psf")
    write_psf(tmp_path / "row.psf", rows=["N1"] if detector is None else ["N1", "S2"])
    one, other = PSFExPSF(tmp_path / "header.psf"), PSFExPSF(tmp_path / "row.psf", detector)
    np.testing.assert_array_equal(one.psf_at(300, 1700).images, other.psf_at(300, 1700).images)
    second = None if detector is None else PSFExPSF(tmp_path / "row.psf", "S2")
    assert second is None or second.zero[0] == 1500


@pytest.mark.parametrize("left_out", [*((key,) for key in OPTIONAL), OPTIONAL])
def test_cards_that_older_files_lack_follow_from_the_others(tmp_path, left_out):
    write_psf(tmp_path / "old.psf", left_out=left_out)
    psf = PSFExPSF(tmp_path / "old.psf").psf_at(1999, 1499)
    wanted = PSF((basis() * np.array([1, 0.25, 0])[:, None, None]).sum(axis=0))
    np.testing.assert_allclose(psf.images, wanted.images, atol=1e-7)


def test_galsim_evaluates_it_alike(tmp_path):
    des = pytest.importorskip("galsim.des")
    from galsim import PositionD

    write_psf(tmp_path / "x.psf")
    image = des.DES_PSFEx(str(tmp_path / "x.psf")).getPSFArray(PositionD(1201, 701))
    psf = PSFExPSF(tmp_path / "x.psf").psf_at(700, 1200)
    np.testing.assert_allclose(psf.images, PSF(image).images, atol=1e-8)


@pytest.mark.parametrize(
    "changed, rows, detector, message",
    [
        ({"POLNGRP": 2}, None, None, "one group"),
        ({"POLNAME2": "MAG"}, None, None, "POLNAME2 is MAG, must be Y_IMAGE"),
        ({"POLDEG1": 2}, None, None, "holds 3 images: must be 6"),
        ({"PSFAXIS1": 25}, None, None, "PSFAXIS1 is 25, PSF_MASK has 21"),
        ({"POLSCAL1": 0.0}, None, None, "scales other than 0"),
        ({"left_out": ("POLDEG1",)}, None, None, "POLDEG1"),
        ({}, ["N1", "S2"], None, "psf_detector is None, the table has 2 rows, ccdname N1, S2"),
        ({}, ["N1", "S2"], "S3", "psf_detector is 'S3'"),
        ({}, ["N1"], "S3", "psf_detector is 'S3'"),
    ],
)
def test_other_tables_are_one_line_that_says_why(tmp_path, changed, rows, detector, message):
    write_psf(tmp_path / "x.psf", rows=rows, **changed)
    with pytest.raises(FileError, match=message) as error:
        PSFExPSF(tmp_path / "x.psf", detector)
    assert "\n" not in str(error.value) and "damaged" not in str(error.value)


@pytest.mark.parametrize("table", ["observation", "mosaic"])
@pytest.mark.parametrize(
    "key", ["psf_cutout_px = [3000, 1500]", "psf_crpix = [{x}, {y}]", "LTV", "LTV and key"]
)
def test_a_cutout_has_the_psf_of_its_place(folder, table, key):
    """By its first pixel, by the detector's CRPIX, by LTV1 and LTV2; keys go before headers."""
    more = key.format(x=SHAPE[1] / 2 + 0.5 + 1500, y=SHAPE[0] / 2 + 0.5 + 3000)
    if key.startswith("LTV"):
        values = (-1500.0, -3000.0) if key == "LTV" else (-9.0, -8.0)
        fits.setval(folder / "image.fits", "LTV1", value=values[0], ext=1)
        fits.setval(folder / "image.fits", "LTV2", value=values[1], ext=1)
        more = "" if key == "LTV" else "psf_cutout_px = [3000, 1500]"
    psf, _, notes = opened(folder, more + '\npsf_format = "psfex"', table)
    wanted = PSFExPSF(folder / "psf.fits").psf_at(3007, 1511)
    np.testing.assert_allclose(psf.psf_at(7, 11).images, wanted.images, atol=1e-7)
    assert any("by LTV1 and LTV2" in note for note in notes) == (key == "LTV")


def test_offsets_away_from_the_files_stars_are_not_a_cutouts_place(folder):
    """Of an image that was itself read out in part: PSFEx counts the image's own pixels."""
    write_psf(folder / "psf.fits", POLZERO1=20.0, POLSCAL1=44.0, POLZERO2=20.0, POLSCAL2=44.0)
    fits.setval(folder / "image.fits", "LTV1", value=-1500.0, ext=1)
    psf, _, notes = opened(folder, 'psf_format = "psfex"')
    wanted = PSFExPSF(folder / "psf.fits").psf_at(7, 11)
    np.testing.assert_allclose(psf.psf_at(7, 11).images, wanted.images, atol=1e-7)
    assert not any("LTV" in note for note in notes)


def test_an_image_away_from_the_files_stars_is_noted(folder):
    write_psf(folder / "psf.fits", POLZERO1=1000.0, POLSCAL1=1000.0)
    assert any("outside the stars" in n for n in opened(folder, 'psf_format = "psfex"')[2])
    more = 'psf_format = "psfex"\npsf_cutout_px = [1900, 900]'
    assert not any("outside the stars" in n for n in opened(folder, more)[2])


@pytest.mark.parametrize(
    "more, message",
    [
        ("psf_cutout_px = [1, 2]\npsf_crpix = [1, 2]", "are both given"),
        ("psf_cutout_px = 3", "psf_cutout_px is 3, must be two numbers"),
        ("saturation = -1", "saturation is -1, must be a number above 0"),
        ("saturation = [1.0, 2.0]", "saturation has 2 numbers, must have one"),
        ("mask_bits = [1]", "mask_bits is given, but mask names no file"),
    ],
)
@pytest.mark.parametrize("table", ["observation", "mosaic"])
def test_mistakes_are_named_by_key(folder, table, more, message):
    with pytest.raises(SceneError, match=message):
        opened(folder, more + '\npsf_format = "psfex"', table)


@pytest.mark.parametrize("table", ["observation", "mosaic"])
def test_saturation_is_the_headers_or_given_and_follows_the_sky(folder, table):
    psfex = 'psf_format = "psfex"\n'
    assert list(opened(folder, psfex, table)[1].saturation) == [4000]
    assert list(opened(folder, psfex + "saturation = 50", table)[1].saturation) == [50]
    less = opened(folder, psfex + 'background = "subtract"', table)[1]
    assert abs(less.saturation[0] - 3900) < 1 and abs(np.median(less.data)) < 0.5
    fits.delval(folder / "image.fits", "SATURATE", ext=1)
    assert opened(folder, psfex, table)[1].saturation is None


def test_a_scenes_zero_points_are_those_of_headers_if_all_have_one(folder):
    psfex = 'psf_format = "psfex"\n'
    assert list(opened(folder, psfex)[1].zero_points) == [27.5]
    fits.delval(folder / "image.fits", "MAGZERO")
    assert opened(folder, psfex)[1].zero_points is None


def test_every_psfex_file_of_decam_is_read_and_its_image_lies_among_its_stars(data, tmp_path):
    files = sorted(data.glob("decam_galaxy/*psfex.fits")) + sorted(data.glob("decam_star/*psfex*"))
    assert len(files) == 9
    for path in files:
        (image,) = path.parent.glob(f"{path.name.split('-')[0]}.*.fits")
        toml = f'[[observation]]\nname = "a"\nimage = "{image}"\nhdu = 1\npsf = "{path}"\n'
        (tmp_path / "s.toml").write_text(toml + 'psf_format = "psfex"\nbackground = "subtract"')
        found = read_scene(tmp_path / "s.toml")
        (o,) = found.observations
        assert o.psf_field.psf_at(50, 50).images.shape == (1, 63, 63)
        assert 3 < o.psf.fwhm_px[0] < 7 and 2e4 < o.saturation[0] < 5e4
        assert not any("outside the stars" in note for note in found.notes)


@pytest.mark.parametrize("table", ["observation", "mosaic"])
def test_the_band_of_an_exposure_is_read(folder, table):
    more = 'psf_format = "psfex"\nchannels = "g1"\nband = "g"'
    _, o, _ = opened(folder, more, table)
    assert (o.channels, o.bands) == (("g1",), ("g",))
    assert opened(folder, 'psf_format = "psfex"', table)[1].bands == ("cam",)
    with pytest.raises(SceneError, match="band has 2 names, must have one"):
        opened(folder, 'psf_format = "psfex"\nband = ["g", "r"]', table)


def test_exposures_of_a_field_give_one_flux_a_band(tmp_path):
    """Two exposures of one band, of which one shows half of the field, and another band."""
    pytest.importorskip("sep")
    rng, (y, x) = np.random.default_rng(2), np.indices((96, 96))
    flat = Grid.flat((96, 96), 0.2)
    grid = Grid.from_wcs(flat.to_wcs(ra_deg=10, dec_deg=-30), flat.shape)
    sources = [(30.0, 25.0, 3000.0), (60.0, 70.0, 4000.0)]
    light = sum(f * np.exp(-((y - a) ** 2 + (x - b) ** 2) / 8) / (8 * np.pi) for a, b, f in sources)
    psf = PSF.gaussian(1.6)

    def mosaic(name, band, factor, point, columns=96):
        weights = np.where(x < columns, 1.0, 0.0)
        made = Mosaic.of_arrays(
            name,
            factor * light + rng.normal(size=light.shape),
            psf,
            grid,
            weights=weights,
            channels=[name],
            zero_points=[point],
        )
        return replace(made, channels=(replace(made.channels[0], band=band),))

    mosaics = [
        mosaic("g1", "g", 1.0, 25.0),
        mosaic("g2", "g", 2.0, 25.0 + 2.5 * np.log10(2), columns=50),
        mosaic("r", None, 1.0, 25.0),
    ]
    run_field(mosaics, tmp_path / "out")
    table = QTable.read(tmp_path / "out" / "catalogue.ecsv")
    assert {"flux_g", "flux_r", "chi2_g1", "chi2_g2", "max_residual_g2"} <= {*table.colnames}
    assert not {"flux_g1", "flux_g2"} & {*table.colnames}
    assert len(table) == 2
    ratio = (table["flux_g"] / table["flux_err_g"]).value
    assert (ratio > 20).all()
    for row in table:
        f = min(sources, key=lambda s: np.hypot(s[0] - row["y"].value, s[1] - row["x"].value))[2]
        wanted = f * 10 ** (-0.4 * (25 - 23.9))
        assert abs(row["flux_g"].value - wanted) < 4 * row["flux_err_g"].value + 0.02 * wanted
