"""Fitted blends written and read back, equal to the last bit."""

from dataclasses import fields, replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import Sip
from helpers.blends import SCALE, blend, observe, round_component
from helpers.headers import OBSERVED, grid_of, header, observed_headers, with_tables

from clresample.deblending.component_images import ComponentImages
from clresample.deblending.ended import Ended
from clresample.files import results as store
from clresample.files.fits import FileError, read_image
from clresample.files.results import read_result, write_result
from clresample.files.tables import read_catalogue, write_catalogue
from clresample.measurement.catalogue import Flag, catalogue
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource


def same(one, other, where="result"):
    """Asserts that two values of any kind in a Result are equal, bit by bit."""
    assert type(one) is type(other), where
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, err_msg=where)
        np.testing.assert_array_equal(np.signbit(one), np.signbit(other), err_msg=where)
    elif isinstance(one, ComponentImages):
        same(np.asarray(one), np.asarray(other), where)
    elif isinstance(one, Grid):
        same(one.shape, other.shape, where)
        n, m = np.indices(one.shape, dtype=float)
        same(one.sky(n, m), other.sky(n, m), where)
        if one.is_flat:
            same((one.jacobian, one.origin), (other.jacobian, other.origin), where)
        else:
            same(distortions(one.wcs), distortions(other.wcs), where)
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for i, pair in enumerate(zip(one, other, strict=True)):
            same(*pair, f"{where}[{i}]")
    elif hasattr(one, "__dataclass_fields__") and type(one).__eq__ is object.__eq__:
        for field in fields(one):
            same(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    else:
        assert one == other, where


def distortions(wcs):
    """SIP polynomials and look-up tables: their last bits vanish in a position's own rounding."""
    sip = wcs.sip and (wcs.sip.a, wcs.sip.b, np.array(wcs.sip.crpix))
    names = ("cpdis1", "cpdis2", "det2im1", "det2im2")
    tables = [table for name in names if (table := getattr(wcs, name, None)) is not None]
    return sip, tuple((t.data, t.crpix, t.crval, t.cdelt) for t in tables)


def rich(rng, grid, other, **given):
    """A result whose numbers need every digit, of two instruments with all the rest."""
    sources = (
        ExtendedSource(sky_deg=tuple(grid.sky(8.1, 9.2)), name="naïve", n_components=2),
        PointSource(position_px=(10 / 3, 20.0), free_position=True),
        ExtendedSource(position_px=(500.0, 1.0)),
    )
    components = [
        replace(round_component(s, (10, x), rng.random(3), n=n), origin=origin)
        for s, x, n, origin in ((0, 9, 5, (3, 4)), (0, 9, 9, (0, 0)), (1, 20, 3, (9, 19)))
    ]
    data = rng.normal(size=(2, *grid.shape))
    data[0, 3, 4] = np.nan
    psf = PSF(rng.random((2, 7, 9)) + np.pad([[4000.0]], ((3, 3), (4, 4))), center=(3.1, 4 + 1e-9))
    first = Observation(
        data, psf, grid, weights=rng.random(2), channels=("g 1", "ö"), zero_points=[25 + 1 / 3, 30],
        name="cam",
    )  # fmt: skip
    second = Observation(
        rng.normal(size=other.shape), PSF.gaussian(2.1, spacing=0.5), other, zero_points=26.1
    )
    rendered = tuple(rng.normal(size=(3, *o.shape)).astype(np.float32) for o in (first, second))
    return blend(
        components,
        grid=grid,
        observations=(first, second),
        sources=sources,
        rendered=rendered,
        sky=rng.normal(size=3),
        covariance=np.where(np.eye(3) == 1, np.inf, rng.normal(size=(3, 3, 3))),
        shifts=rng.normal(size=(2, 2)),
        losses=rng.random(17),
        status=Ended.FAILED,
        messages=("one 'line'", 'another\twith "quotes"'),
        psf_error=0.03,
        seconds={"set-up": 1 / 3, "fit": np.float64(2 / 7)},
        **given,
    )


def moved(cards, rng):
    """The same kind of header with numbers of full length."""
    for key in cards:
        if isinstance(cards[key], float) and cards[key]:
            cards[key] *= 1 + 1e-3 * rng.random()
    return cards


def round_trip(result, tmp_path):
    write_result(tmp_path / "blend.fits", result)
    found = read_result(tmp_path / "blend.fits")
    same(result, found)
    return found


def test_a_flat_blend_comes_back_bit_by_bit(tmp_path):
    grid = Grid.flat((30, 33), 1 / 3, angle_deg=17, center_arcsec=(0.1, 0.7))
    result = rich(np.random.default_rng(1), grid, Grid.flat((11, 10), 0.7, angle_deg=4, flip=True))
    assert result.observations[0].n_invalid == 1 and result.observations[0].messages
    found = round_trip(result, tmp_path)
    assert found.rendered[0].images[0].flags.c_contiguous and found.rendered[0].dtype.isnative
    assert found.observations[0].messages == result.observations[0].messages
    assert not found.observations[0].data.flags.writeable


@pytest.mark.parametrize("cards", [pytest.param(h, id=name) for name, h in observed_headers()])
def test_a_blend_with_any_wcs_comes_back_bit_by_bit(cards, tmp_path):
    rng = np.random.default_rng(2)
    other = grid_of(moved(cards, rng), OBSERVED)
    round_trip(rich(rng, grid_of(moved(header((30, 33)), rng), (30, 33)), other), tmp_path)


def test_every_observation_keeps_its_own_distortion(tmp_path):
    """Two distorted instruments in one file, and a distorted frame; numbers of full length."""
    grids = []
    for scale in (1.0, -2.0, 3.0):
        wcs = with_tables()
        for key in ("cpdis1", "det2im1"):
            getattr(wcs, key).data = np.float32(scale) * getattr(wcs, key).data
            getattr(wcs, key).crval = (1 / 3, 1 / 3)
        wcs.sip = Sip(wcs.sip.a / 3, wcs.sip.b / 3, None, None, wcs.wcs.crpix)
        grids.append(Grid.from_wcs(wcs, OBSERVED))
    assert len({float(grid.sky(20, 20)[0]) for grid in grids}) == 3
    result = rich(np.random.default_rng(3), *grids[:2])
    result = replace(result, frame=Frame(grids[2], result.frame.psf))
    round_trip(result, tmp_path)


@pytest.mark.parametrize("sources", [(), (PointSource(position_px=(-9.0, 0.0)),)])
def test_a_blend_without_components_comes_back(sources, tmp_path):
    result = blend([], sources=sources, losses=np.zeros(0))
    found = round_trip(result, tmp_path)
    assert found.rendered[0].shape == (0, 2, 60, 70)


def test_the_comparison_sees_a_last_bit(tmp_path):
    result = rich(np.random.default_rng(1), *2 * [grid_of(header((30, 33)), (30, 33))])
    found = round_trip(result, tmp_path)
    wcs = found.frame.grid.to_wcs()
    wcs.wcs.crval = wcs.wcs.crval * (1 + 1e-15)
    for changed in (
        {"sky": np.nextafter(found.sky, 2)},
        {"frame": Frame(Grid.from_wcs(wcs, (30, 33)), found.frame.psf)},
        {"seconds": {}},
        {"psf_error": 0.02},
        {"sources": found.sources[::-1]},
    ):
        with pytest.raises(AssertionError):
            same(result, replace(found, **changed))


# what others read in the file


def test_the_files_images_are_ordinary_ones(tmp_path):
    rng = np.random.default_rng(4)
    grid, other = grid_of(header((30, 33)), (30, 33)), grid_of(header((11, 10)), (11, 10))
    result = rich(rng, grid, other)
    path = tmp_path / "blend.fits"
    write_result(path, result, device="PoCL", inputs={"image of cam": "dir/cam.fits"})
    for i in range(2):
        o = result.observations[i]
        for name, expected in (
            ("DATA", o.data),
            ("WEIGHTS", o.weights),
            ("MODEL", result.model(i)),
            ("RESIDUAL", np.where(o.weights > 0, result.residual(i), 0)),
        ):
            image = read_image(path, hdu=f"{name},{i + 1}")
            np.testing.assert_array_equal(image.data, expected)
            same(image.grid, o.grid)
    assert image.bands == ("channel0",)
    scene = read_image(path, hdu="SCENE").data
    expected = sum(result.source_model(i) for i in range(3))
    np.testing.assert_allclose(scene, expected, rtol=1e-13)
    with fits.open(path, checksum=True) as hdus:
        assert hdus[0].header["CLDEVICE"] == "PoCL" and hdus[0].header["CLFILE1"] == "cam.fits"
        assert hdus[0].header["CREATOR"].startswith("clresample ")
        assert hdus[0].header["CLDTYPE"] == "float32"
        assert hdus[0].header["CLSTATUS"].startswith("failed")
        hdus.verify("exception")
        flags = {row["flag"]: row["value"] for row in hdus["FLAGS"].data}
    assert flags == {flag.name: flag.value for flag in Flag}


def test_the_files_catalogue_is_the_catalogue(tmp_path):
    grid = Grid.flat((30, 33), 0.1)
    result = rich(np.random.default_rng(5), grid, Grid.flat((11, 10), 0.3))
    write_result(tmp_path / "blend.fits", result)
    check_catalogue(QTable.read(tmp_path / "blend.fits", hdu="CATALOGUE"), catalogue(result))


def check_catalogue(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found.colnames, expected.colnames, strict=True):
        assert one in (other, other.encode("ascii", "replace").decode())
        assert found[one].unit == expected[other].unit
        if other != "name":
            np.testing.assert_array_equal(np.array(found[one]), np.array(expected[other]))


@pytest.mark.parametrize("name", ["cat.fits", "cat.fits.gz", "cat.ecsv", "cat.parquet"])
def test_catalogues_are_read_with_units_and_descriptions(name, tmp_path):
    """Parquet too, in whose environment here there is no pandas."""
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    grid = grid_of(header((30, 33)), (30, 33))
    table = catalogue(rich(np.random.default_rng(6), grid, grid), magnitudes=True)
    write_catalogue(tmp_path / name, table)
    found = read_catalogue(tmp_path / name)
    texts = [[each[name].info.description for name in each.colnames] for each in (found, table)]
    plain = (lambda text: text.replace("ö", "?")) if "fits" in name else str
    assert "16 OUTSIDE_FRAME" in table["flags"].info.description
    assert texts[0] == [plain(text) for text in texts[1]]
    assert not [key for key in found.meta if key.startswith("TCOMM")]
    if "fits" in name:
        found["name"][0] = "naïve"
    check_catalogue(found, table)
    assert found["name"].tolist() == table["name"].tolist()
    (tmp_path / name).write_bytes(b"no table")
    with pytest.raises(FileError, match=f"{name}: cannot be read as a table"):
        read_catalogue(tmp_path / name)
    with pytest.raises(FileError, match="no such file"):
        read_catalogue(tmp_path / "none.fits")


@pytest.mark.parametrize("name", ["cat.fits", "cat.fits.gz", "cat.ecsv"])
def test_catalogues_are_written_with_units(name, tmp_path):
    grid = grid_of(header((30, 33)), (30, 33))
    table = catalogue(rich(np.random.default_rng(6), grid, grid), magnitudes=True)
    write_catalogue(tmp_path / name, table)
    hdu = {} if name.endswith("ecsv") else {"hdu": "CATALOGUE"}
    found = QTable.read(tmp_path / name, **hdu)
    if not hdu:
        assert found.colnames == table.colnames and found["name"][0] == "naïve"
        assert found.meta == table.meta and found["flags"].info.description
        found = QTable(found, names=[n.encode("ascii", "replace").decode() for n in found.colnames])
    check_catalogue(found, table)
    with pytest.raises(FileError, match="exists already"):
        write_catalogue(tmp_path / name, table)
    write_catalogue(tmp_path / name, table[:1], overwrite=True)
    assert len(Table.read(tmp_path / name, **hdu)) == 1
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_channels_that_differ_in_case_only_keep_their_columns(tmp_path):
    observation = observe(Grid.flat((60, 70), SCALE), ("r", "R"))
    result = blend([round_component(0, (30, 35), (1, 2))], observations=(observation,))
    write_catalogue(tmp_path / "cat.fits", catalogue(result))
    found = Table.read(tmp_path / "cat.fits", hdu="CATALOGUE")
    assert found["flux_R"][0] == 2 * found["flux_r"][0]


# what is wrong is reported in one line, and nothing is half-written


def test_a_file_is_whole_or_absent(tmp_path, monkeypatch):
    path = tmp_path / "blend.fits"
    result = blend([round_component(0, (30, 35), (1, 2))])
    write_result(path, result)
    before = path.read_bytes()
    with pytest.raises(FileError, match="exists already"):
        write_result(path, result)
    with pytest.raises(FileError, match="does not exist"):
        write_result(tmp_path / "no" / "blend.fits", result)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(FileError, match="cannot be written .No space"):
        write_result(path, result, overwrite=True)
    with pytest.raises(FileError, match="cannot be written .No space"):
        write_catalogue(tmp_path / "cat.ecsv", catalogue(result))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["blend.fits"]


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="cat.txt.*ecsv"):
        write_catalogue(tmp_path / "cat.txt", Table())
    assert not list(tmp_path.iterdir())


def test_files_of_other_kinds_are_refused(tmp_path):
    path = tmp_path / "blend.fits"
    with pytest.raises(FileError, match="no such file"):
        read_result(path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(path)
    with pytest.raises(FileError, match="holds no fitted blend"):
        read_result(path)


def test_damaged_and_newer_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "blend.fits"
    result = blend([round_component(0, (30, 35), (1, 2))])
    write_result(path, result)
    whole = path.read_bytes()
    for n in (5000, len(whole) // 2, len(whole) - 40000):
        path.write_bytes(whole[:n])
        with pytest.raises(FileError) as error:
            read_result(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
    monkeypatch.setattr(store, "FORMAT", 8)
    write_result(path, result, overwrite=True)
    monkeypatch.undo()
    with pytest.raises(FileError, match="format 8, this version reads 7"):
        read_result(path)
