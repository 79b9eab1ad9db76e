"""Descriptions in the files of a run: units, meanings, provenance."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from helpers.fields import mosaics_of

import clresample
from clresample import FieldOptions, Flag, Grid
from clresample.fields.columns import empty_catalogue
from clresample.fields.mosaic import ConstantPlane, FilePlane
from clresample.fields.outputs import _noted_messages
from clresample.fields.run import run_field
from clresample.fields.strips import STRIPS
from clresample.files.atomic import FileError
from clresample.files.tables import read_catalogue
from clresample.sky.box import Box


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
    one, other = read_catalogue(folder / "catalogue.parquet"), rows
    assert [one[n].unit for n in one.colnames] == [other[n].unit for n in one.colnames]
    np.testing.assert_array_equal(one["colour_err_VIS_i"].value, other["colour_err_VIS_i"].value)
    blends = QTable.read(folder / "fit_table.ecsv")
    assert all(blends[name].info.description for name in blends.colnames)
    assert blends["seconds"].unit == "s"


def test_columns_follow_from_the_mosaics_alone(done, sky):
    rows, mosaics = QTable.read(done[0] / "catalogue.ecsv"), mosaics_of(sky)
    job = SimpleNamespace(mosaics=mosaics, bands=("VIS", "i"), reference=mosaics[0].grid)
    empty = empty_catalogue(job).table()
    assert empty.colnames == rows.colnames and len(empty) == 0
    for name in rows.colnames:
        unit, expected = (getattr(table[name], "unit", None) for table in (empty, rows))
        assert unit == expected, name
    assert empty.meta["FRAME"] == rows.meta["FRAME"]
    bare = replace(mosaics[1], channels=(replace(mosaics[1].channels[0], zero_point=None),))
    flat = SimpleNamespace(mosaics=(bare,), bands=("i",), reference=Grid.flat((9, 9), 0.2))
    without = empty_catalogue(flat).table()
    assert without["flux_i"].unit == "ct" and "mag_i" not in without.colnames
    assert "y_sky" in without.colnames and not without.meta


def test_an_instrument_without_a_usable_pixel_has_empty_columns_flags_and_a_note(sky, tmp_path):
    euclid, rubin = mosaics_of(sky)
    rubin = replace(rubin, channels=(replace(rubin.channels[0], mask=ConstantPlane(1)),))
    options = FieldOptions(passes=1, threshold=30.0)
    found = run_field([euclid, rubin], tmp_path, options=options).outputs
    rows = read_catalogue(tmp_path / "catalogue.fits")
    assert len(rows) and np.isnan(rows["flux_i"]).all() and np.isfinite(rows["flux_VIS"]).any()
    assert (rows["flags"] & Flag.NO_COVERAGE).all()
    assert [n for n in found.notes if n.startswith("Rubin: no pixel at any source has a weight")]


def test_messages_of_fits_are_counted_by_their_kind():
    job = SimpleNamespace(mosaics=[SimpleNamespace(name="acs_f814w")])
    texts = [
        "acs_f814w: sky is left in: g +0.3 sigma | light in B2 lies away from that in C: by (1, 2)",
        "",
        "acs_f814w: sky is left in: r",
    ]
    twice = "light in B2 lies away from that in C: by (3, 4)"
    fits = QTable({"messages": [*texts, f"{twice} | {twice}"]})
    assert _noted_messages(job, fits) == [
        "2 of 4 fits: acs_f814w: sky is left in; see fit_table.ecsv",
        "2 of 4 fits: light in B2 lies away from that in C; see fit_table.ecsv",
    ]


SOURCES = tuple(Path(clresample.__file__).parent.glob("[dr]e*/**/*.py"))
LEVELS = "sky is left in", "too much sky was subtracted"  # in a table, the colon elsewhere
SENTENCES = (
    *LEVELS,
    "a source is {} than the PSF of {}",
    "a source lies far from any light",
    "a source lies outside the model frame",
    "channel {} has light sharper than its PSF",
    "channel {} has pixels sharper than its PSF, cosmic rays or hot pixels",
    "channel {} is saturated",
    "errors are those of fixed morphologies",
    "light in channel {} lies away from that in {}",
    "light in {} lies away from that in {}",
    "no pixel of {} has a weight",
    "pixels without a source do not scatter as the weights say",
    "second components could not be fitted",
    "sources lie within {} model pixel of each other",
    "the PSF of {} is sampled too coarsely",
    "the model does not describe the data",
    "the noise of neighbouring pixels is correlated",
    "the observed PSF has power where the model's has hardly any",
    "the pixels furthest from the sources are not dark",
    "the sky is fitted, and pixels without a source hardly tell its level",
    "the sky's level is unsure, as the sources' wings reach all over the image",
    "the sources' light lies away from their positions",
    "there is light that no source is listed for",
)


@pytest.mark.parametrize("sentence", SENTENCES)
def test_every_message_of_a_fit_begins_with_a_sentence(sentence):
    """In the code, where strings go on over lines, it is followed by a colon or bracket."""
    code = "".join(re.sub(r'"\s*f?"', "", path.read_text()) for path in SOURCES)
    pattern = re.escape(sentence).replace(r"\{\}", r"\{[^}]*\}")
    end = '"' if sentence in LEVELS else " ?[:(]"
    assert re.search('[" ]' + pattern + end, code)
    line = "A: " + sentence.format("1", "g") + ": at (1, 2)"
    job = SimpleNamespace(mosaics=[SimpleNamespace(name="A")])
    (note,) = _noted_messages(job, QTable({"messages": [line]}))
    assert note == f"1 of 1 fits: A: {sentence.format('1', 'g')}; see fit_table.ecsv"


@pytest.fixture(scope="module")
def packed(sky, tmp_path_factory):
    """A run over Euclid's compressed image alone: its folder, the channel, rows that it left."""
    folder = tmp_path_factory.mktemp("packed")
    (euclid,) = mosaics_of(sky)[:1]
    (channel,) = euclid.channels
    pixels = channel.data.read(Box.of(euclid.grid.shape))
    lossless = {"compression_type": "GZIP_2", "quantize_level": 0}
    fits.CompImageHDU(pixels, **lossless).writeto(folder / "packed.fits")
    channel = replace(channel, data=FilePlane(folder / "packed.fits", 1))
    options = FieldOptions(passes=1, threshold=7.0)
    (folder / "in.txt").write_text("input")
    about = {"inputs": {"x": folder / "in.txt"}}
    given = {"options": options, "about": about}
    run_field([replace(euclid, channels=(channel,))], folder / "out", **given)
    return folder / "out", channel, STRIPS.n_bytes


def test_a_run_leaves_no_decoded_rows(packed):
    """They may be hundreds of megabytes, which a notebook would hold to its end."""
    _, channel, n_bytes = packed
    assert n_bytes == 0
    STRIPS.clear()
    channel.data.read(Box(0, 0, 9, 9))
    assert STRIPS.n_bytes > 0  # they would have been kept
    STRIPS.clear()


def test_the_provenance_says_what_was_read_and_with_what(packed):
    found = json.loads((packed[0] / "provenance.json").read_text())
    assert found["inputs"]["x"]["sha256"] == hashlib.sha256(b"input").hexdigest()
    assert found["clresample"] == clresample.__version__
    assert found["packages"]["numpy"] == np.__version__ and found["device"] and found["system"]
    assert found["run"]["threshold"] == 7.0 and "max_iter=" in found["run"]["settings"]
    assert {"search", "link", "fit"} <= set(found["seconds"])


def test_a_run_that_fails_leaves_no_decoded_rows(sky, tmp_path, monkeypatch):
    def broken(*_):
        STRIPS.n_bytes = 1
        raise MemoryError

    monkeypatch.setattr("clresample.fields.run.prepare_search", broken)
    with pytest.raises(MemoryError):
        run_field(mosaics_of(sky)[:1], tmp_path / "out", options=FieldOptions())
    assert STRIPS.n_bytes == 0


def test_what_is_in_the_way_is_told_at_once(sky, tmp_path):
    (euclid,) = mosaics_of(sky)[:1]
    for name in ("catalogue.ecsv", f"residual_{euclid.name}.fits"):
        (tmp_path / name).symlink_to("nowhere")
        with pytest.raises(FileError, match=f"{name}: is a symbolic link, and is kept"):
            run_field([euclid], tmp_path, options=FieldOptions())
        assert [p.name for p in tmp_path.iterdir()] == [name]
        (tmp_path / name).unlink()


def test_all_outputs_appear_together(sky, tmp_path, monkeypatch):
    """One that cannot be written leaves those of the run before; the next run replaces all."""
    options, folder = FieldOptions(passes=1, threshold=7.0), tmp_path / "out"
    folder.mkdir()
    (folder / "catalogue.fits").write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("clresample.fields.outputs._write_provenance", full)
        with pytest.raises(FileError, match="cannot be written .No space left"):
            run_field(mosaics_of(sky)[:1], folder, options=options)
    assert {p.name for p in folder.iterdir()} == {"catalogue.fits", "work"}
    assert (folder / "catalogue.fits").read_text() == "old"
    run_field(mosaics_of(sky)[:1], folder, options=options, resume=True)
    assert len(QTable.read(folder / "catalogue.fits"))
    assert (folder / "provenance.json").exists()
