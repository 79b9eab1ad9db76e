"""The report of a run: whole, unfinished, empty, in parts, damaged; bounded; with hostile names."""

import base64
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from helpers.field_folder import write_folder
from helpers.fields import mosaics_of

from clresample import write_report
from clresample.fields.mosaic import ArrayPlane
from clresample.fields.run import run_field
from clresample.files.atomic import FileError
from clresample.report.run_folder import read_run


class Elements(HTMLParser):
    """All elements of a page as (name, attributes), and what its scripts hold."""

    def __init__(self, text):
        super().__init__()
        self.all, self.scripts, self.texts = [], [], []
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.all.append((tag, dict(attrs)))
        self.inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        if self.inside == "script":
            self.scripts[-1] += data
        self.texts.append(data)

    def named(self, tag):
        return [attributes for name, attributes in self.all if name == tag]


def page_of(folder, **options):
    """(Elements, the script's data, text) of the page of a folder."""
    report = write_report(folder, **options)
    text = report.path.read_text()
    elements = Elements(text)
    return elements, json.loads(elements.scripts[0]), text


def test_the_page_holds_every_source_and_loads_nothing(done, tmp_path):
    folder, _ = done
    rows = QTable.read(folder / "catalogue.fits")
    report = write_report(folder, tmp_path / "page.html")
    text = report.path.read_text()
    elements = Elements(text)
    data = json.loads(elements.scripts[0])
    assert report.n_sources == report.n_pictures == len(rows)
    assert report.n_bytes == len(text.encode())
    assert sorted(data["sources"]["id"]) == sorted(str(i) for i in rows["id"])
    assert all(str(i) in text for i in rows["id"])
    order = np.argsort(-rows["snr"])
    np.testing.assert_allclose(data["sources"]["x"], rows["x"].value[order], atol=0.006)
    assert [len(i["levels"][0]["model"]) for i in data["instruments"]] == [1, 1]
    assert {r["name"] for r in data["details"]["0"]["stamps"]["rows"]} == {"VIS", "i"}
    for _, attributes in elements.all:
        for key in ("src", "href", "action", "data"):
            assert attributes.get(key, "#").startswith(("#", "data:"))
    assert "://" not in text and "@import" not in text and "url(" not in text
    write_report(folder, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text() == text


def test_only_its_own_script_and_style_may_run(done, tmp_path):
    folder, _ = done
    elements, _, _ = page_of(folder, path=tmp_path / "page.html")
    policy = next(m["content"] for m in elements.named("meta") if "http-equiv" in m)
    digest = base64.b64encode(hashlib.sha256(elements.scripts[1].encode()).digest()).decode()
    assert len(elements.scripts) == 2 and f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_pulls_and_completeness_are_those_of_the_truth(done, sky, tmp_path):
    folder, _ = done
    truth = tmp_path / "truth.ecsv"
    QTable(sky.truth).write(truth, format="ascii.ecsv")
    _, _, text = page_of(folder, path=tmp_path / "page.html", truth=truth)
    rows = QTable.read(folder / "catalogue.fits")
    at = np.stack([rows["y"].value, rows["x"].value], axis=1)
    true = np.stack([sky.truth["y"], sky.truth["x"]], axis=1)
    apart = np.hypot(*(true[:, None] - at[None]).transpose(2, 0, 1))
    own = {}
    while apart.min() <= 4:  # the nearest pair first
        t, k = np.unravel_index(apart.argmin(), apart.shape)
        own[t] = k
        apart[t], apart[:, k] = np.inf, np.inf
    inner = ((true > 8) & (true < 191 - 8)).all(axis=1)
    n = sum(inner[t] for t in own)
    assert f"{n} of the {inner.sum()} true sources over 8 pixels from the edge have a" in text
    for channel in ("VIS", "i"):
        flux, error = (rows[f"{n}_{channel}"].value for n in ("flux", "flux_err"))
        pulls = [(flux[k] - sky.truth[f"flux_{channel}"][t]) / error[k] for t, k in own.items()]
        pulls = np.array(pulls)[np.isfinite(pulls)]  # sources beside Euclid's image have no VIS
        middle = np.median(pulls)
        width = 1.4826 * np.median(np.abs(pulls - middle))
        told = f"median {middle:.2f}, width {width:.2f}, n = {len(pulls)}".replace("-", "−")
        assert told in text


def test_an_unfinished_run_shows_what_is_done(done, tmp_path):
    folder, _ = done
    shutil.copytree(folder / "work", tmp_path / "work")
    parts = sorted((tmp_path / "work").glob("fit-*.arrays"))
    rows = len(QTable.read(folder / "catalogue.fits"))
    _, data, text = page_of(tmp_path)
    assert "This run has not finished" in text and data["instruments"] == []
    assert len(data["sources"]["id"]) == rows
    fits_done = len(QTable.read(folder / "fit_table.ecsv"))
    assert re.search(rf"1 of 1 tiles searched, {fits_done} of \d+ blends fitted", text)
    parts[-1].unlink()
    parts[0].write_bytes(parts[0].read_bytes()[:4000])
    report = write_report(tmp_path)
    assert report.n_sources < rows and any(parts[0].name in note for note in report.notes)
    for path in (tmp_path / "work").glob("*.*"):
        if path.name != "run.json":
            path.unlink()
    _, data, text = page_of(tmp_path)  # begun, and nothing more
    assert data["sources"]["id"] == [] and "0 tiles searched" in text


def test_a_field_without_a_source_has_a_page(sky, tmp_path):
    pytest.importorskip("sep")
    euclid = mosaics_of(sky)[0]
    noise = np.random.default_rng(1).normal(0, 20, euclid.grid.shape)
    channel = replace(euclid.channels[0], data=ArrayPlane(noise))
    run_field([replace(euclid, channels=(channel,))], tmp_path)
    assert len(QTable.read(tmp_path / "catalogue.ecsv")) == 0
    _, data, text = page_of(tmp_path)
    assert data["sources"]["id"] == [] and "No source was found" in text
    assert len(data["instruments"]) == 1


def test_a_part_of_a_field_is_shown_in_its_own_images(tmp_path):
    rows = write_folder(tmp_path, part_from=64)
    run = read_run(tmp_path)
    np.testing.assert_array_equal(run.offset, [0, 64])
    _, data, text = page_of(tmp_path)
    order = np.argsort(-rows["snr"])
    np.testing.assert_allclose(data["sources"]["x"], rows["x"].value[order] - 64, atol=0.006)
    model = fits.getdata(tmp_path / "model_Euclid.fits")[0]
    y, x = np.unravel_index(model.argmax(), model.shape)
    assert abs(data["sources"]["y"][0] - y) < 1 and abs(data["sources"]["x"][0] - x) < 1
    assert "Part 2 of 2 of its field" in text


HOSTILE = "</script><script>pwned=1</script><img src=x onerror=pwned=2>\"'&"


def test_names_from_files_stay_texts(tmp_path):
    write_folder(
        tmp_path,
        instruments={"<b>E": ('<i onclick="pwned=3">',), "R": ("</script>", "&lt;", "i")},
        status={0: ("failed", HOSTILE), 1: ("failed", "no device")},
    )
    plain, _, _ = page_of(tmp_path)
    told = json.loads((tmp_path / "provenance.json").read_text())
    told |= {"failed_tiles": {"3": HOSTILE}, "device": HOSTILE, "packages": {HOSTILE: HOSTILE}}
    told["inputs"] = {HOSTILE: {"file": HOSTILE, "sha256": HOSTILE}}
    (tmp_path / "provenance.json").write_text(json.dumps(told))
    elements, data, text = page_of(tmp_path)
    assert len(elements.scripts) == 2 and not elements.named("img") and not elements.named("b")
    assert not [key for _, attributes in elements.all for key in attributes if key[:2] == "on"]
    assert "pwned=1" in "".join(elements.texts)
    assert ["Reason", HOSTILE] in data["details"]["0"]["facts"]
    assert data["instruments"][1]["channels"] == ["</script>", "&lt;", "i"]
    assert data["sources"]["state"][:3] == [2, 2, 0]
    assert f"Tile 3 is lost: {HOSTILE}" in "".join(elements.texts)


def test_a_page_stays_within_its_limit_and_says_what_it_left_out(tmp_path):
    write_folder(tmp_path, n_sources=150, n_px=1400)
    full = write_report(tmp_path)
    least = write_report(tmp_path, tmp_path / "least.html", most_bytes=2_000_000)
    assert full.n_bytes > 4_000_000 and full.n_pictures == 150
    assert 800_000 < least.n_bytes <= 2_000_000
    assert 0 < least.n_pictures < 150
    assert f"{least.n_pictures} of 150 sources have pictures in this page" in least.notes
    data = json.loads(Elements(least.path.read_text()).scripts[0])
    assert data["instruments"][0]["levels"][0]["scale"] > 1
    assert "Euclid is shown in pixels of" in least.path.read_text()
    with pytest.raises(ValueError, match="most_bytes is 1000, must be 2000000"):
        write_report(tmp_path, most_bytes=1000)


def test_what_cannot_be_read_is_said(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(FileError, match="no such folder"):
        write_report(folder)
    folder.mkdir()
    with pytest.raises(FileError, match="holds no run of `clresample field`"):
        write_report(folder)
    write_folder(folder)
    (folder / "model_Rubin.fits").unlink()
    path = folder / "residual_Euclid.fits"
    path.write_bytes(path.read_bytes()[:-60000])
    (folder / "fit_table.ecsv").unlink()
    (folder / "provenance.json").write_text("{")
    report = write_report(folder)
    notes = " | ".join(report.notes)
    for name in ("model_Rubin.fits", "residual_Euclid.fits", "fit_table.ecsv", "provenance.json"):
        assert name in notes
    places = tmp_path / "places.ecsv"
    QTable({"y": [1.0], "x": [1.0]}).write(places, format="ascii.ecsv")
    with pytest.raises(FileError, match="truth.ecsv: no such file"):
        write_report(folder, truth=tmp_path / "truth.ecsv")
    with pytest.raises(FileError, match="is not the truth of a field"):
        write_report(folder, truth=places)
    with pytest.raises(FileError, match="exists already"):
        write_report(folder, report.path)
    with pytest.raises(FileError, match="is one of the inputs"):
        write_report(folder, folder / "catalogue.fits", overwrite=True)
    (folder / "catalogue.fits").write_bytes((folder / "catalogue.fits").read_bytes()[:3000])
    with pytest.raises(FileError, match="catalogue.fits: cannot be read as a table"):
        write_report(folder)
