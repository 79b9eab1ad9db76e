"""The paper's evidence on a tiny configuration: runs that are resumed, and their report."""

import json

import pytest
from helpers.benches import run_bench

from clresample import get_device

TIMING = ("--sizes", 20, 30, "--pairs", "HST-RUBIN", "EUCLID-RUBIN", "--seconds", 0.01)
METHODS = ("ours", "ours64", "paper", "quintic", "sinc")


def load(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with small runs of both sections, the first one extended, and their report."""
    pytest.importorskip("galsim")
    pytest.importorskip("matplotlib")
    if not get_device().has_fp64:
        pytest.skip(f"{get_device().name} has no double precision, which the paper's figures need")
    folder = tmp_path_factory.mktemp("report")
    pairs = ("--pairs", "EUCLID-RUBIN", "RUBIN-RUBIN", "--processes", 1, "--folder", folder)
    run_bench("paper.accuracy", "--galaxies", 1, *pairs)
    run_bench("paper.accuracy", "--galaxies", 2, *pairs)
    run_bench("paper.timing", *TIMING, "--folder", folder)
    run_bench("paper.report", "--folder", folder)
    return folder


def test_accuracy(folder):
    found = load(folder, "accuracy")
    assert [(p["from"], p["to"], p["n_galaxies"]) for p in found["pairs"]] == [
        ("EUCLID", "RUBIN", 2), ("RUBIN", "RUBIN", 2),
    ]  # fmt: skip
    off, same = found["pairs"]
    assert set(off["mean"]) == set(METHODS)
    assert off["mean"]["ours"] > off["mean"]["quintic"] + 7  # dB
    assert off["mean"]["ours64"] > off["mean"]["sinc"] - 0.5  # dB
    assert same["exact"] == {name: name == "ours64" for name in METHODS}
    assert same["mean"]["ours64"] is None  # infinite: not a number of JSON
    assert same["mean"]["ours"] > 70  # dB: the truth rounded to float32
    for case in found["worst"]:
        assert [row["n_model"] for row in case["padded"]] == [118, 148, 178, 236]
        assert case["wide"]["n_model"] == 118


def test_a_run_adds_to_what_is_there(folder):
    lines = (folder / "accuracy.jsonl").read_text().splitlines()
    settings, *parts = map(json.loads, lines)
    assert settings["stamp"] == 60
    assert [(key, len(rows)) for key, rows in parts] == [
        (["EUCLID", "RUBIN", 0], 1), (["RUBIN", "RUBIN", 0], 1),
        (["EUCLID", "RUBIN", 0], 2), (["RUBIN", "RUBIN", 0], 2),
    ]  # fmt: skip
    assert parts[0][1][0] == parts[2][1][0]  # the same galaxy, measured again in a longer chunk


def test_timing(folder):
    found = load(folder, "timing")
    cases = [(r["from"], r["n_model"]) for r in found["rows"]]
    assert cases == [(name, n) for name in ("HST", "EUCLID") for n in (20, 30)]
    for row in found["schemes"]:
        assert row["n_model"] == [20, 30]
        assert min(row["ours"] + row["paper"]) > 0
    assert [row["angle_deg"] for row in found["schemes"]] == [0, 30]
    for row in found["rows"]:
        assert set(row["ms"]) == set(row["setup_ms"]) == {"ours", "paper", "quintic", "sinc"}
        assert min(row["ms"].values()) > 0


def test_report_shows_every_figure_beside_its_statement(folder):
    from bench.paper import report

    text, more = ((folder / f"{name}.md").read_text() for name in ("report", "details"))
    results = report.load(folder)
    assert results.keys() == {"accuracy", "timing"}
    assert text == report.statements(results) and more == report.details(results)
    found = [f for s in report.SECTIONS if s.name in results for f in s.findings(results[s.name])]
    figures = {finding.figure for finding in found} - {None}
    assert {path.name for path in folder.glob("*.png")} == figures
    for finding in found:
        assert all(finding.claim.text in page and finding.found in page for page in (text, more))
        assert finding.figure is None or f"({finding.figure})" in more
    for label in ("SDR", "SDR_diff", "SDR_sinc", "visual", "visual_edge", "time_ratios(M)"):
        assert f"`fig:{label}`" in text
    assert not list(folder.glob(".part*"))


def test_a_run_says_what_it_found(folder):
    text = run_bench("paper.timing", *TIMING, "--folder", folder)  # all of it is in the log
    assert "Section 4: speed: Time beside GalSim's sinc: " in text
    assert "Growth of both schemes with N: Not decided." in text  # no slope from sizes below 100


def test_the_report_that_is_kept_says_why_a_statement_does_not_hold():
    from bench.harness.options import REPORT
    from bench.paper import report

    text = (REPORT / "report.md").read_text()
    for part in (report.INTRODUCTION, report.PAPER, report.ELSEWHERE, report.TARGETS):
        assert f"{part}\n" in text
    assert all(f"\n### {s.title}\n" in text for s in report.SECTIONS if not s.departs)
    assert all(f"| {s.how} |" in text for s in report.SECTIONS if s.departs)
    # the paper's statements first, our own targets under their own heading
    first, second = (text.index(f"\n## {name}") for name in ("The paper's st", "Our own targets"))
    assert 0 < first < second
    assert "Off the diagonal, in float32" not in text[:second]
    for line in text.splitlines():
        if "Does not hold" in line:
            reasons = ("we are better", "another setting", "another start", "we fall short")
            assert any(f"Does not hold: {reason}" in line for reason in reasons) or any(
                f"Does not hold: the statement is about {reason}" in line for reason in reasons
            )
