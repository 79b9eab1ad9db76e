"""The paper's evidence on a tiny configuration: resumed runs, findings from numbers, the report."""

import json

import numpy as np
import pytest
from helpers.checkout import run_python

METHODS = ("ours", "ours64", "paper", "quintic", "sinc")


def run(module, *options):
    result = run_python("-m", f"bench.{module}", *map(str, options))
    assert result.returncode == 0, result.stderr
    return result.stdout


def load(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with small runs of both sections, the first one extended, and their report."""
    pytest.importorskip("galsim")
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("report")
    pairs = ("--pairs", "EUCLID-RUBIN", "RUBIN-RUBIN", "--processes", 1, "--folder", folder)
    run("paper.accuracy", "--galaxies", 1, *pairs)
    run("paper.accuracy", "--galaxies", 2, *pairs)
    pairs = ("--pairs", "HST-RUBIN", "EUCLID-RUBIN")
    run("paper.timing", "--sizes", 20, 30, *pairs, "--seconds", 0.01, "--folder", folder)
    run("paper.report", "--folder", folder)
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
    assert found["findings"][-1]["holds"] is None  # no slope from sizes below 100


def test_report_shows_every_figure_beside_its_statement(folder):
    text = (folder / "report.md").read_text()
    figures = {f["figure"] for n in ("accuracy", "timing") for f in load(folder, n)["findings"]}
    figures.discard(None)
    assert {path.name for path in folder.glob("*.png")} == figures
    for name in ("accuracy", "timing"):
        for finding in load(folder, name)["findings"]:
            assert finding["claim"] in text
            assert finding["found"] in text
            assert finding["figure"] is None or f"({finding['figure']})" in text
    for label in ("SDR", "SDR_diff", "SDR_sinc", "visual", "visual_edge", "time_ratios(M)"):
        assert f"`fig:{label}`" in text
    assert not list(folder.glob(".part*"))


def accuracy_numbers(sinc=50.0, wins=0.0, wide=45.0, spread=11.0):
    """Numbers of a run of two pairs in which every statement holds, but for what is given."""
    mean = {"ours": 50.0, "ours64": 50.0, "paper": 50.0, "quintic": 40.0, "sinc": sinc}
    same = {"ours": 76.0, "ours64": np.inf, "paper": 70.0, "quintic": 41.0, "sinc": 60.0}
    pairs = [
        {
            "from": "EUCLID",
            "to": to,
            "n_model": 118,
            "n_galaxies": 9,
            "mean": values,
            "std": dict.fromkeys(METHODS, spread),
            "exact": {name: value == np.inf for name, value in values.items()},
            "quintic_wins": wins,
        }
        for to, values in (("RUBIN", mean), ("EUCLID", same))
    ]
    rows = [
        {"n_model": n, "edge": 1e-4, "ours": s, "quintic": 41.0} for n, s in ((118, 40), (236, 60))
    ]
    worst = {"from": "EUCLID", "to": "RUBIN", "galaxy": 3, "edge_rank": 0.9, "padded": rows}
    worst["wide"] = {"ours": wide, "quintic": 41.0}
    visual = [{"title": "EUCLID → RUBIN", "ours": 50.0, "quintic": 40.0}]
    return {"pairs": pairs, "worst": [worst], "edge_correlation": -0.5, "visual": visual}


@pytest.mark.parametrize(
    ("change", "failing"),
    [
        ({}, ()),
        ({"spread": 1.0}, ("Scatter of the SDR",)),
        ({"sinc": 50.2}, ("Off the diagonal, in float32", "Off the diagonal, in float64")),
        ({"wins": 0.02}, ("Where GalSim's default wins",)),
        ({"wide": 65.0}, ("Why: light at the stamp's edge, light folded in, and padding",)),
    ],
)
def test_verdicts_follow_the_numbers(change, failing):
    from bench.paper.accuracy_findings import findings

    found = findings("accuracy", **accuracy_numbers(**change))
    assert tuple(f.title for f in found if f.holds is False) == failing
    assert all(isinstance(f.holds, bool) for f in found)


def test_fits_of_times():
    from bench.paper.timing_findings import findings, line_fit, slope

    sizes = [50, 100, 200, 400]
    assert slope(sizes, [9.0] + [1e-8 * n**4 for n in sizes[1:]]) == pytest.approx(4)
    assert slope(sizes[:2], [1, 2]) is None
    rows = [
        {"n_obs": m, "ms": {"quintic": 2.0, "paper": 2 * (0.048 * m - 0.17), "ours": 0.1 + m / 1e3}}
        for m in (10, 50, 100)
    ]
    assert line_fit(rows, "paper") == (pytest.approx((-0.17, 0.048)), pytest.approx(1))
    means = {"ours": [1.0] * 2, "paper": [2.0, 9.0], "quintic": [3.0] * 2, "sinc": [4.0, 10.0]}
    for power, holds in ((4, True), (3, False)):
        times = {
            "ours": [n**2 for n in sizes],
            "paper": [n**power for n in sizes],
            "products": sizes,
        }
        schemes = [{"angle_deg": 0.0, "n_model": sizes, **times}]
        *rest, last = findings(rows, schemes, [100, 200], means)
        assert [f.holds for f in rest] == [True, True]
        assert last.holds is holds


def test_a_log_goes_on_after_an_interruption(tmp_path):
    from bench.harness.options import BadOption
    from bench.harness.records import Log

    path = tmp_path / "run.jsonl"
    log = Log(path, {"device": "A"})
    log.append(("x", 1), [1.0, float("nan")])
    log.append(("x", 2), {"ms": 3})
    with path.open("ab") as file:
        file.write(b'[["x", 3], [1.')  # the power went
    log = Log(path, {"device": "A"})
    assert log.done == {("x", 1): [1.0, None], ("x", 2): {"ms": 3}}
    log.append(("x", 3), 4)
    assert Log(path, {"device": "A"}).done["x", 3] == 4
    with pytest.raises(BadOption, match="device A, not B"):
        Log(path, {"device": "B"})


@pytest.mark.parametrize(
    ("module", "options", "words"),
    [
        ("paper.accuracy", ("--printed", "--wide"), "leave --printed out"),
        ("paper.accuracy", ("--galaxies", "0"), "0 is not above 0"),
        ("paper.accuracy", ("--processes", "none"), "none"),
        ("paper.timing", ("--pairs", "RUBIN-HST"), "RUBIN-HST is not FROM-TO"),
        ("paper.timing", ("--sizes", "1", "--pairs", "EUCLID-RUBIN"), "no observed pixel"),
        ("paper.timing", ("--folder", "Makefile"), "--folder Makefile"),
        ("paper.report", ("--folder", "docs"), "no results"),
    ],
)
def test_bad_options_get_one_line(module, options, words):
    result = run_python("-m", f"bench.{module}", *options)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert words in result.stderr
