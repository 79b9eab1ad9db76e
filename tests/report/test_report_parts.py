"""Parts of the report: PNG, tiles and their positions, maps of chi2, matches, axes."""

import base64
import io
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from helpers.field_folder import SIGMA, write_folder

from clresample import Grid
from clresample.report import alone, codes, colours, pyramid
from clresample.report.charts import chi2_numbers, chi2_palette, magnitudes
from clresample.report.html import data_block, format_number
from clresample.report.page_data import flag_names
from clresample.report.png import png
from clresample.report.run_folder import RunFolder, read_run
from clresample.report.svg import Chart, ChartAxis
from clresample.report.truth import FOUND_PX, matched
from clresample.sky.box import Box


def decoded(data):
    """The pixels of a PNG without filters, or with differences of rows, by its definition."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed = 8, b""
    while at < len(data):
        (n,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + n]
        (crc,) = struct.unpack(">I", data[at + 8 + n : at + 12 + n])
        assert crc == zlib.crc32(kind + body)
        if kind == b"IHDR":
            n_x, n_y, depth, colour = struct.unpack(">IIBB", body[:10])
            assert depth == 8
        packed += body if kind == b"IDAT" else b""
        at += 12 + n
    n_c = 3 if colour == 2 else 1
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(n_y, 1 + n_c * n_x)
    pixels = rows[:, 1:]
    if rows[0, 0] == 2:
        pixels = np.cumsum(pixels, axis=0, dtype=np.uint8)
    return pixels.reshape((n_y, n_x, 3) if n_c == 3 else (n_y, n_x))


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (1, 1)])
@pytest.mark.parametrize("smooth", [False, True])
def test_a_png_gives_its_pixels_back(shape, smooth):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_array_equal(decoded(png(image, smooth=smooth)), image)
    other = pytest.importorskip("PIL.Image").open(io.BytesIO(png(image, smooth=smooth)))
    np.testing.assert_array_equal(np.asarray(other), image)


def values_of(text, shape, step, smooth):
    """Values [unit] of a text of `codes.encode`, by its definition."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).astype(int)
    code = data[: data.size // 2] + 256 * data[data.size // 2 :]
    code = code.reshape(shape)
    if smooth:
        code = np.cumsum(code, axis=0) % 65536
    steps = np.where(code % 2, (code - 1) // 2, -(code // 2))
    return np.where(code == 0, np.nan, codes.KNEE * np.sinh(step * steps))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_text_gives_values_back_to_half_a_step(smooth):
    step = codes.SMOOTH_STEP if smooth else codes.NOISY_STEP
    rng = np.random.default_rng(0)
    image = 3.0 * np.concatenate([rng.normal(0, 2, (9, 7)), rng.normal(0, 1, (4, 7)) * 1e6])
    image[2, 3] = np.nan
    got = 3.0 * values_of(codes.encode(image, 3.0, smooth=smooth), image.shape, step, smooth)
    np.testing.assert_array_equal(np.isnan(got), np.isnan(image))
    most = 1.001 * step / 2 * np.hypot(3.0 * codes.KNEE, image)
    good = np.isfinite(image)
    assert (np.abs(got - image)[good] <= most[good] * (1 + step)).all()


def test_the_first_stretch_shows_the_three_channels_of_the_most_signal():
    sigma = np.array([1.0, 2.0, 4.0, 4.0])
    light = np.zeros((4, 400))
    light[:, :40] = np.array([50.0, 100.0, 400.0, 1.0])[:, None]
    stretch = colours.stretch_of(light, sigma)
    assert stretch.chosen == (0, 1, 2)
    np.testing.assert_allclose(stretch.balance * light[:3].sum(axis=1), light[:3].sum() / 3)
    np.testing.assert_allclose(stretch.whites, [50, 100, 400, 8 * 2.5 * 4])


class OneModel:
    """Cutouts of a run whose sources are all a square of ones at (y, x) = (10, 20)."""

    def __init__(self, folder):
        self.mosaics = (SimpleNamespace(name="E"),)

    def separate(self, ids, i_mosaic):
        if ids == [7]:
            raise alone.MissingSource("none")
        return SimpleNamespace(own=np.ones((2, 4, 4))), None, (10, 20)


def test_own_models_are_put_where_they_are(monkeypatch, tmp_path):
    (tmp_path / "models.fits").touch()
    monkeypatch.setattr(alone, "FieldCutouts", OneModel)
    notes, run = [], SimpleNamespace(finished=True, settings={}, folder=tmp_path)
    own = alone.OwnModels(run, notes)
    one = SimpleNamespace(name="E", channels=("a", "b"))
    image = own.on(3, one, Box(8, 22, 13, 30))
    expected = np.zeros((2, 5, 8))
    expected[:, 2:, :2] = 1
    np.testing.assert_array_equal(image, expected)
    assert own.on(7, one, Box(0, 0, 9, 9)) is None and notes == []
    monkeypatch.setattr(alone, "MAX_SOURCES", 2)
    assert own.on(4, one, Box(0, 0, 9, 9)) is None and own.on(3, one, Box(0, 0, 9, 9)) is not None
    (tmp_path / "models.fits").unlink()
    assert alone.OwnModels(run, notes).on(3, one, Box(0, 0, 9, 9)) is None and notes == []
    (tmp_path / "models.fits").touch()
    monkeypatch.undo()
    assert alone.OwnModels(run, notes).on(3, one, Box(0, 0, 9, 9)) is None
    assert "no pictures of sources without their neighbours: " in notes[0]


def test_means_of_blocks_leave_out_what_is_not_there():
    rng = np.random.default_rng(2)
    image = rng.normal(size=(2, 7, 10))
    image[:, :4, :4] = np.nan
    image[0, 5, 5] = np.nan
    got = pyramid._averaged(image, 4)
    assert got.shape == (2, 2, 3) and np.isnan(got[:, 0, 0]).all()
    for c in range(2):
        for y in range(2):
            for x in range(3):
                block = image[c, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4]
                if np.isfinite(block).any():
                    np.testing.assert_allclose(got[c, y, x], np.nanmean(block), rtol=1e-6)


@pytest.mark.parametrize("scale", [1, 4])
def test_tiles_lie_where_their_pixels_are(scale):
    frame = Grid.flat((300, 280), 0.1, center_arcsec=(1.0, -2.0))
    grid = Grid.flat((160, 150), 0.2, angle_deg=25, flip=True)
    place = pyramid.frame_transform(grid, frame, (8, 16), (24, 20), scale)
    u, v = 3.7, 11.2  # column and row in the tile, from its outer corner
    pixel = (8 + v) * scale - 0.5, (16 + u) * scale - 0.5
    y, x = frame.pixel(*grid.sky(*pixel))
    a, b, c, d, e, f = place
    np.testing.assert_allclose([a * u + c * v + e, b * u + d * v + f], [x, y], atol=1e-4)


def test_a_pyramid_is_of_the_mosaic_and_its_chi2_of_the_noise(tmp_path):
    write_folder(tmp_path, n_px=600, n_sources=20)
    euclid, rubin = read_run(tmp_path).instruments
    assert (euclid.name, rubin.name) == ("Euclid", "Rubin")
    np.testing.assert_allclose(rubin.noise_sigma, SIGMA, rtol=0.03)
    made = pyramid.pyramid_of(rubin, euclid.grid, 10**8)
    assert [level["scale"] for level in made.levels] == [1, 2]
    assert [len(level["model"]) for level in made.levels] == [4, 1]
    assert made.n_bytes == sum(len(t) for level in made.levels for n in pyramid.LAYERS
                               for tile in level[n] for t in tile)  # fmt: skip
    assert made.chi2.shape == (38, 38)
    assert abs(np.nanmean(made.chi2) - 1) < 0.03
    assert np.nanmax(np.abs(made.chi2 - 1)) < 0.6
    few = pyramid.pyramid_of(rubin, euclid.grid, 1)
    assert [level["scale"] for level in few.levels] == [2] and few.finest == 1
    again = pyramid.pyramid_of(rubin, euclid.grid, made.n_bytes - 1)
    assert again.levels == made.levels[1:]


def test_dead_columns_are_no_light(tmp_path):
    from astropy.io import fits

    write_folder(tmp_path, n_px=300)
    with fits.open(tmp_path / "residual_Euclid.fits", mode="update") as hdus:
        hdus[0].data[:, :, 40] = 1e6
    (euclid, _) = read_run(tmp_path).instruments
    made = pyramid.pyramid_of(euclid, euclid.grid, 10**8)
    assert np.nanmax(made.chi2) < 2.5
    planes, _, _ = pyramid._read(euclid, 0)
    for plane in planes:
        assert np.isnan(plane[0, :, 40]).all() and np.isfinite(plane[0, :, 41]).all()


def test_the_nearest_pairs_are_taken_first_each_once():
    true = np.array([[10.0, 10.0], [12.0, 10.0], [50.0, 50.0], [80.0, 80.0]])
    rows = np.array([[11.5, 10.0], [9.0, 10.0], [50.0, 50.0 + 1.01 * FOUND_PX], [80.0, 80.0]])
    np.testing.assert_array_equal(matched(rows, true), [1, 0, -1, 3])
    np.testing.assert_array_equal(matched(rows[:0], true), [-1] * 4)
    rows[3] = np.nan
    assert matched(rows, true)[3] == -1
    true[0] = np.nan
    assert matched(rows, true)[0] == -1


@pytest.mark.parametrize(
    ("scale", "texts"),
    [
        (ChartAxis(-1.05, 1.05, ""), ["−1.0", "−0.5", "0.0", "0.5", "1.0"]),
        (ChartAxis(0, 2100, ""), ["0", "500", "1000", "1500", "2000"]),
        (ChartAxis(0.9, 1.1e6, "", True), ["1", "10", "100", "1000", "10000", "10⁵", "10⁶"]),
        (ChartAxis(3, 40, "", True), ["5", "10", "20"]),
    ],
)
def test_axes_have_round_numbers(scale, texts):
    assert [text for _, text in scale.ticks()] == texts


@pytest.mark.parametrize("values", [[], [np.nan], [3.0], [0.0, -1.0], [1e-30, 1e30]])
@pytest.mark.parametrize("log", [False, True])
def test_any_values_have_an_axis(values, log):
    scale = ChartAxis.over(values, "x", log=log)
    assert np.isfinite([scale.low, scale.high]).all() and scale.low < scale.high
    chart = Chart(scale, scale, "a <b>")
    chart.points(values, values)
    chart.steps([scale.low, scale.high], [scale.high], "bars")
    assert "nan" not in chart.svg and "a &lt;b&gt;" in chart.svg


def test_many_points_become_cells():
    chart = Chart(ChartAxis(0, 1, "x"), ChartAxis(0, 1, "y"), "many")
    chart.points(*np.random.default_rng(3).uniform(0, 1, (2, 50_000)))
    assert 'class="cells s3"' in chart.svg and len(chart.svg) < 60_000


def test_numbers_flags_and_magnitudes_are_told():
    assert (
        format_number(-1.5) == "−1.5" and format_number(float("nan")) == format_number(None) == "–"
    )
    assert flag_names(0) == "none" and flag_names(66 + 4096) == "NOT_CONVERGED, MISFIT, 4096"
    np.testing.assert_allclose(magnitudes(np.array([1.0, 100.0]), "uJy"), [23.9, 18.9])
    assert np.isnan(magnitudes(np.array([-1.0]), "uJy")).all()
    assert "</script" not in data_block("x", ["</script>"])[:-9]
    middle = chi2_palette()[chi2_numbers(np.array([[1.0]]))[0, 0]]
    np.testing.assert_array_equal(middle, [228, 228, 226])
    assert chi2_numbers(np.array([[np.nan, 1e9, 0.0]])).tolist() == [[0, 31, 1]]


def test_a_part_of_a_flat_field_knows_where_it_begins():
    whole = Grid.flat((300, 280), 0.1, angle_deg=7, center_arcsec=(3.0, -2.0))
    placed = whole.cutout(20, 110, (280, 170)).to_wcs()
    one = SimpleNamespace(grid=Grid.from_wcs(placed, (280, 170)))
    settings = {"part": [2, 2, 64], "corner": whole.sky(0, 0).tolist()}
    rows = QTable({"y_sky": [0.0] * u.arcsec, "x_sky": [0.0] * u.arcsec})
    run = RunFolder(Path("run"), rows, QTable(), (one,), settings=settings)
    np.testing.assert_array_equal(run.offset, [20, 110])
