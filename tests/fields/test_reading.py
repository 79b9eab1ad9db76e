"""FIELD.toml and headers: what is read, and one line for each mistake."""

import re
import sys

import numpy as np
import pytest
from astropy.io import fits

from clresample import PSF, Grid
from clresample.cli import main
from clresample.fields.background import find_background
from clresample.fields.execution.folder import open_folder
from clresample.fields.field_toml.estimates import estimate_weights
from clresample.fields.field_toml.field_file import read_field
from clresample.fields.field_toml.headers import mask_value, zero_point
from clresample.fields.field_toml.keys import parse_field
from clresample.fields.mosaic import ArrayPlane, Channel, Mosaic
from clresample.fields.options import FieldOptions, RunProgress
from clresample.fields.sky_level import (
    find_sky,
    measured_sky,
    messages_in_run,
    sky_notes,
    subtracted_levels,
    without_sky,
)
from clresample.files.scene_keys import SceneError
from clresample.sky.box import Box

SHAPE = (300, 260)
TOML = """
[[mosaic]]
name = "A"
image = "a.fits"
psf = "psf.fits"
{more}
"""


@pytest.fixture
def files(tmp_path):
    """An image of noise 2 on a sloping sky of 100, its variance, a mask with named bits, a PSF."""
    rng = np.random.default_rng(0)
    flat = Grid.flat(SHAPE, 0.2)
    header = flat.to_wcs(ra_deg=10, dec_deg=-30).to_header()
    header["MAGZERO"], header["BAND"] = 25.5, "r"
    slope = 0.02 * np.indices(SHAPE)[0]
    image = rng.normal(100, 2, SHAPE) + slope
    fits.PrimaryHDU(image.astype(np.float32), header).writeto(tmp_path / "a.fits")
    fits.PrimaryHDU(np.full(SHAPE, 4.0, np.float32)).writeto(tmp_path / "var.fits")
    flags = np.zeros(SHAPE, np.int32)
    flags[5], flags[6] = 1 << 3, 1 << 5
    mask = fits.PrimaryHDU(flags)
    mask.header["MP_SAT"], mask.header["MP_CR"] = 3, 5
    mask.writeto(tmp_path / "mask.fits")
    large = np.ones((SHAPE[0] + 1, SHAPE[1]), np.int32)
    fits.PrimaryHDU(large).writeto(tmp_path / "large.fits")
    fits.PrimaryHDU(PSF.gaussian(1.5).images).writeto(tmp_path / "psf.fits")
    return tmp_path


def field_of(folder, more="", rest=""):
    path = folder / "field.toml"
    path.write_text(TOML.format(more=more) + rest)
    return read_field(path)


def test_zero_point_band_variance_and_named_bits_are_found(files):
    more = 'variance = "var.fits"\nmask = "mask.fits"\nmask_bits = ["SAT"]'
    field = field_of(files, more)
    (channel,) = field.mosaics[0].channels
    assert (channel.name, channel.zero_point) == ("r", 25.5)
    weights = channel.weights(Box(0, 0, 10, 10))
    assert (weights[5] == 0).all() and np.allclose(weights[[4, 6]], 0.25)
    assert set(field.inputs) >= {"field", "image of A", "mask of A"}


def test_noise_and_sky_are_estimated_where_they_are_asked_for(files):
    field = field_of(files, 'background = "subtract"')
    (channel,) = field.mosaics[0].channels
    assert any("noise of channel r estimated" in note for note in field.notes)
    box = Box(40, 40, 260, 220)
    assert abs(channel.weights(box)[0, 0] ** -0.5 - 2) < 0.03
    assert abs(np.mean(channel.read(box))) < 0.1
    rows = channel.read(box).mean(axis=1)
    assert abs(np.polyfit(np.arange(len(rows)), rows, 1)[0]) < 0.003  # a slope of 0.02 before


def test_a_bright_galaxy_is_not_taken_for_sky():
    rng = np.random.default_rng(1)
    y, x = np.indices((512, 512))
    galaxy = 500 * np.exp(-np.hypot(y - 250, x - 260) / 12)
    image = rng.normal(7, 1, galaxy.shape) + galaxy
    everywhere = lambda box: np.ones(box.shape, bool)  # noqa: E731
    sky = find_background(lambda box: image[box.slices], everywhere, image.shape)
    level = sky.read(Box(200, 200, 300, 300))
    assert abs(level - 7).max() < 0.3


def test_backgrounds_and_noise_leave_out_filled_pixels():
    image = np.random.default_rng(3).normal(50, 2, (512, 512)) + np.arange(512) / 50
    image[:, :300] = 0  # two columns of cells, and a part of the third
    everywhere = lambda box: np.ones(box.shape, bool)  # noqa: E731
    sky = find_background(lambda box: image[box.slices], everywhere, image.shape)
    assert abs(sky.read(Box(0, 320, 512, 500)) - image[:, 320:500]).mean() < 2
    assert sky.levels.min() > 50
    channel = Channel("r", ArrayPlane(image), background=sky)
    mosaic = Mosaic("A", Grid.flat(image.shape, 0.1), (channel,), PSF.gaussian(2.0))
    notes = []
    (channel,) = estimate_weights(mosaic, notes).channels
    assert channel.weight.value**-0.5 == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize("level", [0.3, -0.2, 0.03])
def test_a_sky_that_was_left_in_is_measured_once_and_subtracted(tmp_path, level):
    """That of the darkest cells; not of an image of so few that a galaxy may fill it."""
    image = np.random.default_rng(2).normal(2 * level, 2, (640, 640)).astype(np.float32)
    y, x = np.indices(image.shape)
    image += 500 * np.exp(-np.hypot(y - 100, x - 260) / 30)
    assert find_sky(*_readers(image[:384]), (384, 640)) is None  # 60 cells

    def mosaic(data):
        grid, psf = Grid.flat(image.shape, 0.1), PSF.gaussian(2.0)
        return Mosaic.of_arrays("A", data[None], psf, grid, channels=["r"], weights=0.25)

    found = measured_sky([mosaic(image)], tmp_path)
    assert measured_sky([mosaic(image + 9)], tmp_path) == found  # of the first start
    (plain,), levels = mosaic(image).channels, {name: pair[0] for name, pair in found.items()}
    (lowered,), (counts, part) = without_sky([mosaic(image)], levels), found["r"]
    (channel,) = lowered.channels
    if level == 0.03:
        assert found["r"] == (0, 0) and channel.background is None
        assert not sky_notes([lowered], found) and not subtracted_levels([lowered])
        return
    assert subtracted_levels([lowered]) == levels
    assert part == pytest.approx(level, abs=0.05) and counts == pytest.approx(2 * part, rel=0.02)
    box = Box(5, 7, 9, 12)
    np.testing.assert_array_equal(channel.read(box), plain.read(box) - counts)
    told = ["A: sky is left in: r", "B: sky is left in: r"]
    assert messages_in_run(told, [mosaic(image)]) == told
    own = f"{lowered.name}: too much sky was subtracted: r -1"
    assert messages_in_run([own, told[1]], [lowered]) == [
        f"{lowered.name}: the sky is darker than the level that the run subtracted: r -1",
        told[1],
    ]
    (note,) = sky_notes([lowered], found)
    assert f"r {part:+.2f}" in note and "fit_sky=False" in note


def test_levels_of_a_start_that_ended_before_the_search_are_measured_again(tmp_path):
    image, options = _noise((640, 640)) + 0.4, FieldOptions()
    grid, psf = Grid.flat(image.shape, 0.1), PSF.gaussian(2.0)
    mosaic = Mosaic.of_arrays("A", image[None], psf, grid, weights=1.0)
    given = tmp_path, [mosaic], mosaic.grid, options, False, False, RunProgress()
    work, _ = open_folder(*given)
    ((_, part),) = measured_sky([mosaic], work).values()
    assert part > 0.3
    work, _ = open_folder(*given)
    assert not list(work.glob("sky*"))


def _noise(shape=(1024, 1024)):
    return np.random.default_rng(4).normal(0, 1, shape).astype(np.float32)


def _with_bowl(image):
    image[:400, :400] -= 0.3
    return image


@pytest.mark.parametrize(
    "image",
    [
        _with_bowl(_noise()),
        _noise() + np.linspace(-0.5, 0.5, 1024, dtype=np.float32),
        _noise() + 50 * np.exp(-np.hypot(*np.indices((1024, 1024)) - 512.0) / 120),
    ],
    ids=["a bowl", "a gradient", "a galaxy"],
)
def test_what_is_not_the_same_everywhere_is_no_level_of_the_sky(image):
    assert find_sky(*_readers(image), image.shape) is None


def test_a_level_is_not_that_of_the_border_or_of_few_pixels():
    shape = (64 * 40, 64 * 40)

    def read(box):
        y, x = np.ogrid[box.y0 : box.y1, box.x0 : box.x1]
        edge = np.minimum(np.minimum(y, shape[0] - 1 - y), np.minimum(x, shape[1] - 1 - x)) < 64
        return np.random.default_rng(box.y0 * shape[1] + box.x0).normal(0, 1, box.shape) - edge

    assert find_sky(read, lambda box: np.ones(box.shape, bool), shape) == (0, 0)

    def few(box):
        return np.random.default_rng(box.y0).uniform(size=box.shape) < 0.003

    assert find_sky(lambda box: read(box) + 1, few, shape) is None


def test_the_level_of_a_narrow_mosaic_with_a_masked_end_is_found():
    image = _noise((160, 128 * 40)) + 0.4
    found = find_sky(lambda box: image[box.slices], lambda box: _right_of(box, 300), image.shape)
    assert found is not None and found[1] == pytest.approx(0.4, abs=0.03)


def _right_of(box, column):
    return np.broadcast_to(np.arange(box.x0, box.x1) >= column, box.shape)


def _readers(image):
    return lambda box: image[box.slices], lambda box: np.ones(box.shape, bool)


def test_options_of_the_file(files):
    rest = (
        "[field]\nfield_number = 7\ntile_px = 500\nmax_sources = 12\n[detection]\nthreshold = 4.5\n"
    )
    options = field_of(
        files,
        'variance = "var.fits"',
        rest + "[fit]\nmax_iter = 9\npsf_tolerance = 0.01\nfit_shifts = true\n",
    ).options
    assert (options.field_number, options.tile_px, options.threshold) == (7, 500, 4.5)
    assert options.limits.max_sources == 12 and options.settings.max_iter == 9
    assert options.settings.psf_tolerance == 0.01 and options.settings.fit_shifts


def test_names_of_a_list_are_those_of_its_positions(files):
    listed = 'variance = "var.fits"', '[sources]\ncatalogue = "list.csv"\n'
    for rows, names in (("name,ra,dec\nb,10,-30\n", ["b"]), ("ra,dec\n10,-30\n", None)):
        (files / "list.csv").write_text(rows)
        options = field_of(files, *listed).options
        assert options.names == names and options.positions.tolist() == [[10, -30]]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("varianze = 1.0", "mosaic 1: key varianze is unknown"),
        ("weight = 1.0\nrms = 2.0", "mosaic 1: weight and rms are both given: an image takes one"),
        ("weight = -1.0", "mosaic 1: weight is -1.0, must be"),
        ('variance = "none.fits"', "none.fits: no such file"),
        ('weight = 1.0\nmask = "mask.fits"\nmask_bits = ["BAD"]', "names SAT, CR"),
        ('weight = 1.0\npsf_format = "cells"', "psf_cell_px is missing"),
        (
            "weight = 1.0\nzero_point = [1.0, 2.0]",
            "zero_point has 2 numbers, must have one for all",
        ),
        ('weight = "a.fits"', "weight is in the image's own file"),
        ('variance = "large.fits"', "variance has (301, 260) pixels"),
        ('weight = 1.0\nmask = "large.fits"', "mask has (301, 260) pixels"),
        ('weight = 1.0\nmask = "mask.fits"\nmask_bits = [63]', "mask_bits has 63, bit 63, must be"),
    ],
)
def test_mistakes_are_one_line_that_names_the_key(files, more, message):
    with pytest.raises(SceneError, match=re.escape(message)) as caught:
        field_of(files, more)
    assert "\n" not in str(caught.value)
    assert "damaged" not in str(caught.value)  # a mistake in field.toml is none of a file's


def test_a_package_that_is_not_there_is_one_line(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "piff", None)
    (files / "field.toml").write_text(TOML.format(more='weight = 1.0\npsf_format = "piff"'))
    assert main(["field", str(files / "field.toml"), "-o", str(files / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "field.toml: Piff files need piff" in line and "pip install" in line


@pytest.mark.parametrize(
    ("cards", "expected"),
    [
        ({"BUNIT": "nJy"}, 31.4),
        ({"BUNIT": "nanomaggies"}, 22.5),
        ({"FLUXMAG0": 63095734448.0194}, 27.0),
        ({"MAGZERO": 24.6}, 24.6),
        ({"BUNIT": "MJy/sr", "PIXAR_SR": 1e-14}, 8.9 + 20.0),
        # F814W of ACS: PHOTFLAM 7.03e-20, PHOTPLAM 8045: AB 25.94
        ({"PHOTFLAM": 7.0332e-20, "PHOTPLAM": 8045.5}, 25.947),
        # and of electrons of all of an exposure, which are those of a second times its seconds
        (
            {"PHOTFLAM": 7.0332e-20, "PHOTPLAM": 8045.5, "BUNIT": "ELECTRONS/S", "EXPTIME": 100.0},
            25.947,
        ),
        (
            {"PHOTFLAM": 7.0332e-20, "PHOTPLAM": 8045.5, "BUNIT": "ELECTRONS", "EXPTIME": 100.0},
            30.947,
        ),
        ({"PHOTFLAM": 7.0332e-20, "PHOTPLAM": 8045.5, "BUNIT": "ELECTRONS"}, None),
        ({"MAGZERO": 24.6, "BUNIT": "ELECTRONS", "EXPTIME": 100.0}, 24.6),
        ({"EXPTIME": 3.0}, None),
    ],
)
def test_zero_points_of_headers(cards, expected):
    found = zero_point(fits.Header(cards), 0.1)
    assert found is None if expected is None else abs(found - expected) < 2e-3


@pytest.mark.parametrize("unit", ["Jy/beam", "JY BEAM-1", "mag/arcsec^2", "mJy/sr", "nJy arcsec-2"])
def test_surface_brightness_is_refused(unit):
    with pytest.raises(ValueError, match="BUNIT is .* must be a flux per pixel: multiply"):
        zero_point(fits.Header({"BUNIT": unit, "MAGZERO": 25.0}), 0.1)


def test_bits_by_number_and_name():
    header = fits.Header({"MP_SAT": 3})
    assert mask_value(header, ["SAT", 0]) == 9
    assert mask_value(header, 4) == 16


def test_commands_from_simulation_to_catalogue_in_worker_processes(tmp_path, capsys):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    sky, out = tmp_path / "sky", tmp_path / "out"
    size = ["--size", "112", "--density", "120", "--bands", "i", "--seed", "3"]
    assert main(["simulate", "field", "-o", str(sky), *size]) == 0
    assert main(["simulate", "field", "-o", str(sky)]) == 2  # kept
    command = ["field", str(sky / "field.toml"), "-o", str(out), "--quiet"]
    assert main([*command, "--device", "no such device"]) == 2
    assert main([*command, "--workers", "2"]) == 0  # of the mistake nothing is left in the way
    printed = capsys.readouterr().out
    assert "converged" in printed and str(out / "catalogue.fits") in printed
    before = (out / "catalogue.fits").read_bytes()
    assert main(command) == 2  # holds a run
    capsys.readouterr()
    assert main([*command[:3], str(tmp_path / "other"), "--worker-memory", "100M"]) == 2
    assert "--worker-memory is 100M, must be 1G or more" in capsys.readouterr().err
    assert main([*command, "--resume", "--workers", "0"]) == 0
    assert (out / "catalogue.fits").read_bytes() == before
    assert main([*command, "--overwrite", "--workers", "0"]) == 0
    assert (out / "catalogue.fits").read_bytes() == before  # by workers or not


@pytest.mark.parametrize(
    "text, said",
    [
        ("x = " + "[" * 3000 + "]" * 3000, "nested too deeply"),
        ("[[mosaic]]\nname = 'a'\nimage = 'a'\npsf = 'p'\nzero_point = nan", "zero_point is nan"),
    ],
)
def test_a_field_file_is_checked_as_scene_files_are(tmp_path, text, said):
    path = tmp_path / "field.toml"
    path.write_text(text)
    with pytest.raises(SceneError, match=said):
        parse_field(path)
    with pytest.raises(SceneError, match="not a regular file"):
        parse_field(tmp_path)
