"""What the files of a run say of themselves: units, descriptions, provenance."""

import hashlib
import json

import numpy as np
import pytest
from astropy.table import QTable
from helpers.fields import mosaics_of

import clresample
from clresample import FieldOptions
from clresample.fields.run import run_field


def test_every_column_has_its_unit_and_a_description(done):
    folder, _ = done
    parquet = pytest.importorskip("pyarrow.parquet")
    rows, schema = (
        QTable.read(folder / "catalogue.ecsv"),
        parquet.read_schema(folder / "catalogue.parquet"),
    )
    assert schema.names == rows.colnames
    for name in rows.colnames:
        about = schema.field(name).metadata
        assert about[b"description"].decode() == rows[name].info.description
        assert about.get(b"unit", b"").decode() == str(getattr(rows[name], "unit", None) or "")
    blends = QTable.read(folder / "blends.ecsv")
    assert all(blends[name].info.description for name in blends.colnames)
    assert blends["seconds"].unit == "s"


def test_the_provenance_says_what_was_read_and_with_what(sky, tmp_path):
    (tmp_path / "in.txt").write_text("input")
    options = FieldOptions(passes=1, threshold=7.0)
    about = {"inputs": {"x": tmp_path / "in.txt"}}
    run_field(mosaics_of(sky)[:1], tmp_path / "out", options=options, about=about)
    found = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert found["inputs"]["x"]["sha256"] == hashlib.sha256(b"input").hexdigest()
    assert found["clresample"] == clresample.__version__
    assert found["packages"]["numpy"] == np.__version__ and found["device"] and found["system"]
    assert found["run"]["threshold"] == 7.0 and "max_iter=" in found["run"]["settings"]
    assert {"search", "link", "fit"} <= set(found["seconds"])
