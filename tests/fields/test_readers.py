"""Readers of Euclid's MER and of the Legacy Surveys, and what all readers share."""

import gzip

import numpy as np
import pytest
from astropy.io import fits
from helpers.survey_files import SHAPE, noise_image, psf_image, sky_grid, write_brick

from clresample import PSF, read_euclid_mer, read_legacy_survey
from clresample.cli import main
from clresample.fields.field_toml.field_file import read_field
from clresample.fields.psfs.sampled import ScatteredPSF
from clresample.fields.readers.formats import read_survey
from clresample.fields.readers.writers import write_mer_tile
from clresample.files.atomic import FileError
from clresample.files.scene_keys import SceneError
from clresample.sky.box import Box

WHOLE = Box.of(SHAPE)


def write_tile(folder, tile=102018211, bands=("VIS", "NIR-H")):
    """A tile of MER: noise of 2, a flag in a row, two PSFs per band."""
    grid = sky_grid(scale=0.1)
    places = np.array([(10.0, 12.0), (60.0, 50.0)])
    for k, band in enumerate(bands):
        flags = np.zeros(SHAPE, np.int16)
        flags[3], flags[4] = 1, 4
        write_mer_tile(
            folder,
            tile,
            band,
            noise_image(2.0, k),
            grid,
            rms=np.full(SHAPE, 2.0, np.float32),
            flags=flags,
            zero_point=23.9 + k,
            psfs=np.stack([psf_image(s, 13 + 2 * k) for s in (1.0, 1.3)]),
            places=places,
        )
    return grid


def test_a_tile_of_euclid(tmp_path):
    grid, notes, inputs = write_tile(tmp_path), [], {}
    mosaic = read_euclid_mer(tmp_path, noise="white", notes=notes, inputs=inputs)
    vis, nir = sorted(mosaic.channels, key=lambda c: c.name, reverse=True)
    assert (mosaic.name, vis.name, nir.name) == ("Euclid", "VIS", "NIR-H")
    assert (vis.zero_point, nir.zero_point) == (23.9, 24.9)
    assert np.array_equal(vis.read(WHOLE), noise_image(2.0, 0))
    weights = nir.weights(WHOLE)
    assert (weights[[3, 4]] == 0).all() and (np.delete(weights, [3, 4], axis=0) == 0.25).all()
    assert np.abs(mosaic.grid.positions_in(grid, 5.0, 6.0) - [5, 6]).max() < 1e-6
    near = mosaic.psf.psf_at(10, 12).images
    band = [c.name for c in mosaic.channels].index("VIS")
    wanted = PSF(np.pad(psf_image(1.0, 13), 1)).images[0]
    assert np.allclose(near[band], wanted, atol=1e-6)
    assert len(inputs) == 8 and not [n for n in notes if "warning" in n]


def test_bits_bands_and_names_of_a_tile(tmp_path):
    write_tile(tmp_path)
    given = {"bands": ["NIR-H"], "channels": ["H"], "mask_bits": [2], "name": "E"}
    mosaic = read_euclid_mer(tmp_path, noise="white", **given)
    (channel,) = mosaic.channels
    assert (mosaic.name, channel.name) == ("E", "H")
    weights = channel.weights(WHOLE)
    assert weights[3].all() and not weights[4].any()
    one = read_euclid_mer(next(tmp_path.glob("*BGSUB-MOSAIC-VIS*")), noise="white")
    assert [c.name for c in one.channels] == ["VIS"]


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("*VIS-RMS*", "rms of band VIS is missing"),
        ("*CATALOG-PSF-VIS*", "psf of band VIS is missing"),
        ("*BGSUB*", "no EUC_MER_BGSUB-MOSAIC"),
    ],
)
def test_what_a_tile_lacks_is_asked_for_in_one_line(tmp_path, lost, message):
    write_tile(tmp_path, bands=("VIS",))
    next(tmp_path.glob(lost)).unlink()
    with pytest.raises(ValueError, match=message) as caught:
        read_euclid_mer(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_tile_packed_by_gzip(tmp_path):
    write_tile(tmp_path, bands=("VIS",))
    for path in tmp_path.iterdir():
        path.with_name(path.name + ".gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    notes = []
    mosaic = read_euclid_mer(tmp_path, noise="white", notes=notes)
    box = Box(20, 10, 60, 50)
    assert np.array_equal(mosaic.channels[0].read(box), noise_image(2.0)[box.slices])
    assert any("read faster unpacked" in note for note in notes)


def test_missing_zero_points_two_tiles_and_unknown_bands(tmp_path):
    write_tile(tmp_path, bands=("VIS",))
    with pytest.raises(ValueError, match="bands has 'Y', there are VIS"):
        read_euclid_mer(tmp_path, bands=["Y"])
    path = next(tmp_path.glob("*BGSUB*"))
    fits.delval(path, "MAGZERO")
    with pytest.raises(ValueError, match="zero_point of band VIS is missing.*give zero_point"):
        read_euclid_mer(tmp_path)
    assert read_euclid_mer(tmp_path, zero_point=24.0).channels[0].zero_point == 24.0
    write_tile(tmp_path, tile=7, bands=("VIS",))
    with pytest.raises(FileError, match="holds tiles 102018211, 7"):
        read_euclid_mer(tmp_path)
    with pytest.raises(FileError, match="no such file or folder"):
        read_euclid_mer(tmp_path / "none")


def test_a_brick_of_the_legacy_surveys(tmp_path):
    grid, notes = write_brick(tmp_path), []
    mosaic = read_legacy_survey(tmp_path, notes=notes)
    assert [c.name for c in mosaic.channels] == ["g", "r"]
    assert {c.zero_point for c in mosaic.channels} == {22.5}
    g, r = (c.weights(WHOLE) for c in mosaic.channels)
    assert not g[3].any() and g[[4, 5]].all() and not r[4].any() and r[[3, 5]].all()
    assert np.median(r) == 0.25
    assert np.abs(mosaic.grid.positions_in(grid, 5.0, 6.0) - [5, 6]).max() < 1e-6
    for y in (0, 69):  # of the map of widths
        image = mosaic.psf.psf_at(y, 30).images[0]
        fwhm = (1.1 + 0.2 * y / 70) / 0.262
        across = image[image.shape[0] // 2, image.shape[1] // 2 :]  # falls from the peak
        half = np.interp(-0.5, -across / across[0], np.arange(len(across)))
        assert abs(2 * half - fwhm) < 0.15
    assert any("Moffat" in note and "FWHM 1.20 arcsec" in note for note in notes)


def test_a_brick_with_its_own_psf_and_other_bits(tmp_path):
    write_brick(tmp_path, copsf=True)
    notes = []
    mosaic = read_legacy_survey(tmp_path, mask_bits=["GALAXY"], bands=["r"], notes=notes)
    weights = mosaic.channels[0].weights(WHOLE)
    assert weights[[3, 4]].all() and not weights[5].any() and not notes
    turned = read_legacy_survey(tmp_path, bands=["r", "g"])
    assert [c.name for c in turned.channels] == ["r", "g"]
    assert np.allclose(mosaic.psf.psf_at(3, 3).images[0], PSF(psf_image()).images[0])
    with pytest.raises(ValueError, match="mask_bits has 'MOON', the mask's header names NPRIMARY"):
        read_legacy_survey(tmp_path, mask_bits=["MOON"])


@pytest.mark.parametrize(
    ("skip", "message"),
    [("invvar", "weight of band g is missing"), ("psfsize", "psf of band g is missing")],
)
def test_what_a_brick_lacks_is_asked_for(tmp_path, skip, message):
    write_brick(tmp_path, skip=(skip,))
    with pytest.raises(ValueError, match=message):
        read_legacy_survey(tmp_path)


def test_a_map_of_no_widths_is_refused(tmp_path):
    write_brick(tmp_path, bands=("g",))
    fits.writeto(next(tmp_path.glob("*psfsize*")), np.zeros(SHAPE), overwrite=True)
    with pytest.raises(FileError, match="psfsize-g.fits.fz: holds no width above 0"):
        read_legacy_survey(tmp_path)


def test_a_psf_may_be_given_in_every_form(tmp_path):
    write_brick(tmp_path, skip=("psfsize",))
    one = PSF(psf_image())
    for psf in (one, [one, one], lambda grid: ScatteredPSF(psf_image()[None], [(3, 4)])):
        assert read_legacy_survey(tmp_path, psf=psf).psf.psf_at(1, 1).images.shape[1:] == (15, 15)
    with pytest.raises(ValueError, match="psf has 3 values for 2 bands"):
        read_legacy_survey(tmp_path, psf=[one] * 3)


def test_a_mosaic_of_field_toml_takes_two_lines(tmp_path):
    (tmp_path / "brick").mkdir()
    write_brick(tmp_path / "brick")
    path = tmp_path / "field.toml"
    path.write_text('[[mosaic]]\nformat = "legacy"\npath = "brick"\n')
    field = read_field(path)
    (mosaic,) = field.mosaics
    assert mosaic.name == "Legacy Surveys" and len(field.inputs) == 9
    fits.PrimaryHDU(psf_image(2.0)).writeto(tmp_path / "psf.fits")
    more = 'name = "L"\nbands = ["r"]\nchannels = ["red"]\nmask_bits = ["GALAXY"]\n'
    path.write_text(
        f'[[mosaic]]\nformat = "legacy"\npath = "brick"\n{more}psf = "psf.fits"\nnoise = "white"\n'
    )
    field = read_field(path)
    (mosaic,) = field.mosaics
    assert (mosaic.name, mosaic.channels[0].name) == ("L", "red")
    assert np.allclose(mosaic.psf.psf_at(0, 0).images[0], PSF(psf_image(2.0)).images[0])
    assert tmp_path / "psf.fits" in field.inputs.values()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('format = "lagacy"\npath = "brick"', "format is 'lagacy', must be \"euclid-mer\""),
        ('format = "legacy"', "mosaic 1: path is missing"),
        ('format = "legacy"\npath = "none"', "none: no such file or folder"),
        ('format = "legacy"\npath = "brick"\nrms = 2.0', "key rms is unknown"),
        ('format = "legacy"\npath = "brick"', r"mosaic 1 \(legacy\): psf of band g is missing"),
    ],
)
def test_mistakes_in_a_survey_s_table(tmp_path, lines, message):
    (tmp_path / "brick").mkdir()
    write_brick(tmp_path / "brick", skip=("psfsize",))
    (tmp_path / "field.toml").write_text(f"[[mosaic]]\n{lines}\n")
    with pytest.raises(SceneError, match=message) as caught:
        read_field(tmp_path / "field.toml")
    assert "\n" not in str(caught.value)


def test_every_format_has_a_name():
    with pytest.raises(ValueError, match="format is 'fits', must be euclid-mer, rubin-coadd"):
        read_survey("fits", "x")


def test_a_simulated_field_is_the_same_in_the_surveys_formats(tmp_path):
    pytest.importorskip("galsim")
    size = ["--size", "128", "--density", "90", "--bands", "i,r", "--psf-variation", "0"]
    for form in ("plain", "survey"):
        command = ["simulate", "field", "-o", str(tmp_path / form), "--format", form]
        assert main([*command, *size, "--bad-columns", "2"]) == 0
    plain, survey = (read_field(tmp_path / form / "field.toml") for form in ("plain", "survey"))
    for one, other in zip(plain.mosaics, survey.mosaics, strict=True):
        box = Box.of(one.grid.shape)
        assert one.name == other.name
        for mine, theirs in zip(one.channels, other.channels, strict=True):
            unit = 10 ** (0.4 * (theirs.zero_point - mine.zero_point))
            assert mine.name == theirs.name
            assert np.allclose(theirs.read(box), unit * mine.read(box), rtol=1e-5)
            assert np.allclose(theirs.weights(box) * unit**2, mine.weights(box), rtol=1e-5)
            assert (mine.weights(box) == 0).sum() == 2 * box.shape[0]
        middle = (np.array(box.shape) - 1) / 2
        seen = [mosaic.psf.psf_at(*middle).images for mosaic in (one, other)]
        assert np.abs(seen[0] - seen[1]).max() < 1e-4 * seen[0].max()
        assert np.allclose(one.grid.sky(*middle), other.grid.sky(*middle), atol=1e-9)


def test_planes_on_other_pixels_and_too_little_sky_are_refused(tmp_path):
    write_tile(tmp_path, bands=("VIS",))
    path = next(tmp_path.glob("*RMS*"))
    pixels = fits.getdata(path)
    fits.writeto(path, pixels[:30], overwrite=True)
    with pytest.raises(FileError, match=r"has \(30, 60\) pixels, its image \(70, 60\)"):
        read_euclid_mer(tmp_path)
    fits.writeto(path, pixels, overwrite=True)
    path = next(tmp_path.glob("*FLAG*"))
    fits.writeto(path, np.ones(SHAPE, np.int16) - (np.indices(SHAPE)[0] < 9), overwrite=True)
    with pytest.raises(ValueError, match='noise: channel VIS.*give noise = "white"'):
        read_euclid_mer(tmp_path)
    notes = []
    read_euclid_mer(tmp_path, noise="white", notes=notes)
    assert any("87% of the pixels" in note and "mask_bits" in note for note in notes)
