"""`bench.field`: a small field end to end, and what its figures count."""

import json

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from helpers.checkout import run_python

from bench import field


def test_a_row_and_a_true_source_are_each_matched_once():
    truth = np.array([(10.0, 10.0), (12.0, 10.0), (50.0, 50.0), (90.0, 90.0)])
    rows = np.array([(90.0, 91.0), (11.8, 10.0), (50.0, 55.0)])
    assert field.matched(rows, truth).tolist() == [-1, 1, -1, 0]
    assert field.matched(np.zeros((0, 2)), truth).tolist() == [-1] * 4


def test_figures_count_what_they_say():
    n = 40
    rng = np.random.default_rng(0)
    places = np.array([(20.0 + 20 * (i // 8), 20.0 + 20 * (i % 8)) for i in range(n)])
    truth = {"y": places[:, 0], "x": places[:, 1], "snr": np.full(n, 50.0)}
    truth["flux_VIS"] = np.full(n, 2.0)
    truth["snr"][:5] = 15.0
    found = places[2:]  # two of the five faint ones are lost
    table = QTable({"y": [*found[:, 0], 150.0] * u.pix, "x": [*found[:, 1], 10.0] * u.pix})
    flux = np.append(2.02 + 0.1 * rng.standard_normal(len(found)), 1.0)
    table["flux_VIS"], table["flux_err_VIS"] = flux * u.uJy, np.full(len(flux), 0.1) * u.uJy
    row = field.compared(table, truth, ("VIS",), 200)
    assert row["completeness"] == 1 and row["faint"] == 0.6
    assert np.isnan(row["close"]) and np.isnan(row["bright"])
    assert row["spurious"] == pytest.approx(1 / 39)
    assert abs(row["flux_bias"] - 0.01) < 0.03 and 0.6 < row["pull_width"] < 1.4


def test_a_small_field(tmp_path):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    given = ["--quick", "--sizes", "160", "--density", "90", "--seed", "3", "--workers", "1"]
    # in a process of its own: a bench starts itself anew with its threads set
    result = run_python("-m", "bench.field", *given, "--json", str(tmp_path / "rows.json"))
    assert result.returncode == 0, result.stderr
    (row,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert row.keys() >= {name for name, *_ in field.COLUMNS} | {"stage"}
    assert row["n_sources"] > 3 and "converged" in row["status"]
    assert row["core_s_per_source"] > 0 and row["peak_gb"] > 0.1
    assert row["stage"].keys() == {"search", "link", "fit"}
