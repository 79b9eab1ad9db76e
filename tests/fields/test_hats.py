"""The HATS layout: partitions, index, metadata; LSDB opens it where it is installed."""

import csv
import shutil

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from helpers.fields import mosaics_of

from clresample import FieldOptions, Grid
from clresample.fields import hats
from clresample.fields.hats import check_hats, healpix_index, partitions, write_hats
from clresample.fields.run import run_field
from clresample.files.atomic import FileError

pytest.importorskip("astropy_healpix")
parquet = pytest.importorskip("pyarrow.parquet")


@pytest.fixture
def table():
    """900 sources, most of them in one square degree, with a unit and a description."""
    rng = np.random.default_rng(5)
    ra = np.concatenate([rng.uniform(149.5, 150.5, 800), rng.uniform(0, 360, 100)]) * u.deg
    dec = np.concatenate([rng.uniform(1.5, 2.5, 800), rng.uniform(-89, 89, 100)]) * u.deg
    table = QTable({"id": np.arange(900), "ra": ra, "dec": dec, "status": ["fine"] * 900})
    table["flux_r"] = rng.normal(1, 1, 900) * u.uJy
    table["flux_r"].info.description = "total flux in r"
    return table


def test_the_index_is_healpix_nested():
    # order 0: pixel 4 is about (0, 0), 0 and 8 touch it from north and south-east
    index = healpix_index([0.0, 45.0, 45.0], [0.0, 41.0, -41.0])
    assert (index >> 58).tolist() == [4, 0, 8]
    with pytest.raises(ValueError, match="1 rows of 2 that are not finite"):
        healpix_index([0.0, np.nan], [0.0, 0.0])


def test_partitions_hold_each_row_once_and_none_too_many(table):
    index = healpix_index(table["ra"].value, table["dec"].value)
    found = partitions(index, most=100)
    n = [int((index >> 2 * (29 - order) == pixel).sum()) for order, pixel in found]
    assert sum(n) == 900 and 0 < min(n) and max(n) <= 100
    parents = [
        int((index >> 2 * (30 - order) == pixel >> 2).sum()) for order, pixel in found if order
    ]
    assert min(parents) > 100  # none is divided without need
    same = np.full(900, index[0])
    assert partitions(same, most=100) == [(10, int(same[0] >> 38))]  # and none for ever


def test_files_and_metadata(table, tmp_path):
    folder = write_hats(tmp_path / "hats", table, most_rows=100)
    properties = dict(
        line.split("=", 1)
        for line in (folder / "hats.properties").read_text().splitlines()
        if not line.startswith("#")
    )
    assert properties["hats_nrows"] == "900" and properties["dataproduct_type"] == "object"
    whole = parquet.read_metadata(folder / "dataset" / "_metadata")
    assert whole.num_rows == 900
    listed = {whole.row_group(i).column(0).file_path for i in range(whole.num_row_groups)}
    there = {str(p.relative_to(folder / "dataset")) for p in folder.rglob("Npix=*.parquet")}
    assert listed == there and len(there) > 5
    with open(folder / "partition_info.csv") as file:
        pixels = [(int(row["Norder"]), int(row["Npix"])) for row in csv.DictReader(file)]
    assert {f"Norder={k}/Dir={n // 10000 * 10000}/Npix={n}.parquet" for k, n in pixels} == there
    rows = []
    for order, pixel in pixels:
        place = f"Norder={order}/Dir={pixel // 10000 * 10000}/Npix={pixel}.parquet"
        part = parquet.ParquetFile(folder / "dataset" / place).read()
        index = part["_healpix_29"].to_numpy()
        assert (index >> 2 * (29 - order) == pixel).all() and (np.diff(index) >= 0).all()
        rows += part["id"].to_pylist()
    assert sorted(rows) == list(range(900))
    field = parquet.read_schema(folder / "dataset" / "_common_metadata").field("flux_r")
    assert field.metadata == {b"unit": b"uJy", b"description": b"total flux in r"}


def test_the_same_catalogue_gives_the_same_bytes(table, tmp_path):
    both = [write_hats(tmp_path / name, table, most_rows=100) for name in "ab"]
    files = [sorted(f.relative_to(d) for f in d.rglob("*") if f.is_file()) for d in both]
    assert files[0] == files[1]
    for name in files[0]:
        assert (both[0] / name).read_bytes() == (both[1] / name).read_bytes()


def test_an_older_one_is_replaced_and_other_folders_are_kept(table, tmp_path):
    write_hats(tmp_path / "hats", table)
    write_hats(tmp_path / "hats", table[:7])
    assert "hats_nrows=7" in (tmp_path / "hats" / "hats.properties").read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["hats"]
    (tmp_path / "mine").mkdir()
    with pytest.raises(FileError, match="holds no HATS, and is kept"):
        write_hats(tmp_path / "mine", table)
    with pytest.raises(ValueError, match="columns ra and dec"):
        write_hats(tmp_path / "other", table["id", "dec"])
    with pytest.raises(ValueError, match="needs rows"):
        write_hats(tmp_path / "other", table[:0])


def test_a_flat_field_is_refused_before_it_runs(monkeypatch):
    with pytest.raises(ValueError, match="the field is flat"):
        check_hats(Grid.flat((9, 9), 0.1))
    monkeypatch.setattr(hats, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match="HATS needs pyarrow"):
        check_hats(Grid.from_wcs(Grid.flat((9, 9), 0.1).to_wcs(), (9, 9)))


def test_a_field_leaves_it_on_request(sky, done, tmp_path):
    folder = shutil.copytree(done[0], tmp_path / "again")
    run_field(mosaics_of(sky), folder, options=FieldOptions(hats=True), resume=True)
    catalogue = QTable.read(folder / "catalogue.fits")
    (path,) = folder.rglob("Npix=*.parquet")
    there = parquet.ParquetFile(path).read()
    assert sorted(there["id"].to_pylist()) == catalogue["id"].tolist()


def test_lsdb_opens_it(table, tmp_path):
    lsdb = pytest.importorskip("lsdb")
    folder = write_hats(tmp_path / "hats", table, name="ours", most_rows=100)
    catalogue = lsdb.open_catalog(str(folder))
    assert len(catalogue) == 900
    near = catalogue.cone_search(ra=150.0, dec=2.0, radius_arcsec=900).compute()
    own = np.hypot((table["ra"].value - 150) * np.cos(np.radians(2)), table["dec"].value - 2)
    assert len(near) == (own < 0.25).sum() > 50
    own = lsdb.open_catalog(str(folder))
    matched = catalogue.crossmatch(own, radius_arcsec=0.1, suffixes=("_a", "_b")).compute()
    assert (matched["id_a"] == matched["id_b"]).sum() == 900


def test_the_validator_of_hats_finds_no_fault(table, tmp_path):
    validation = pytest.importorskip("hats.io.validation", reason="hats, the package, is missing")
    folder = write_hats(tmp_path / "hats", table, most_rows=100)
    assert validation.is_valid_catalog(folder, strict=True, verbose=False)
