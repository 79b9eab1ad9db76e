"""`bench.field`: a small field end to end, and what its figures count."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from helpers.benches import bench_json

from bench import field
from bench.harness import judged, memory, photometry
from clresample import simulate_field


def test_a_row_and_a_true_source_are_each_matched_once():
    truth = np.array([(10.0, 10.0), (12.0, 10.0), (50.0, 50.0), (90.0, 90.0)])
    rows = np.array([(90.0, 91.0), (11.8, 10.0), (50.0, 55.0)])
    assert judged.matched(rows, truth).tolist() == [-1, 1, -1, 0]
    assert judged.matched(np.zeros((0, 2)), truth).tolist() == [-1] * 4


def test_figures_count_what_they_say():
    n = 40
    rng = np.random.default_rng(0)
    places = np.array([(20.0 + 20 * (i // 8), 20.0 + 20 * (i % 8)) for i in range(n)])
    truth = {"y": places[:, 0], "x": places[:, 1], "snr": np.full(n, 50.0)}
    truth["flux_VIS"] = np.full(n, 2.0)
    truth["snr"][:5] = 15.0
    found = places[2:]  # two of the five faint ones are lost
    # one row more beside nothing, one beside a source that has its own
    y, x = np.concatenate([found, [(150.0, 10.0), found[3] + 2.5]]).T
    table = QTable({"y": y * u.pix, "x": x * u.pix})
    flux = np.append(2.02 + 0.1 * rng.standard_normal(len(found)), [1.0, 1.0])
    table["flux_VIS"], table["flux_err_VIS"] = flux * u.uJy, np.full(len(flux), 0.1) * u.uJy
    row = field.compared([(table, truth, 200)], ("VIS",))
    assert row["completeness"] == 1 and row["faint"] == 0.6
    assert np.isnan(row["close"]) and np.isnan(row["bright"])
    assert row["spurious"] == pytest.approx(2 / 40)
    assert abs(row["flux_bias"] - 0.01) < 0.03 and 0.6 < row["pull_width"] < 1.4
    # fields together: counts are added, not shares
    both = field.compared([(table, truth, 200), (table[:30], truth, 200)], ("VIS",))
    assert both["spurious"] == pytest.approx(2 / 70)
    assert both["n_sources"] == 70 and both["faint"] == 0.6


def test_close_sources_are_those_with_a_neighbour_that_is_seen():
    truth = {"y": [50.0, 50.0, 120.0, 120.0], "x": [50.0, 57.0, 50.0, 57.0]}
    truth |= {"snr": [30.0, 30.0, 30.0, 4.0]}
    one = judged.Judged([(50.0, 50.0)], {k: np.array(v) for k, v in truth.items()}, 200)
    counts = one.found()
    assert counts["close"] == (1, 2) and counts["completeness"] == (0, 1)
    assert one.pairs().tolist() == [True, False, False, False]


def test_memory_counts_all_that_a_process_has_started():
    code = (
        "x = bytearray(80_000_000); x[::4096] = b'1' * len(x[::4096]); import time; time.sleep(30)"
    )
    inner = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {code!r}])"
    with subprocess.Popen([sys.executable, "-c", inner]) as process:
        watch, began = memory.TreeMemory(process.pid), time.monotonic()
        watch.start()
        while watch.peak < 80e6 and time.monotonic() < began + 25:
            time.sleep(0.1)
        children = memory.tree(process.pid)
        for pid in reversed(children):
            os.kill(pid, signal.SIGKILL)
    assert len(children) == 2
    assert 80e6 < watch.stop() < 200e6


def test_others_photometry_finds_the_flux_of_a_source_alone():
    """In the bands' own units, at the largest radii all of it, and by profiles within a tenth."""
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    sky = simulate_field(5, n_pixels=256, density=20, faintest=23.0, rubin_bands=("r", "i"))
    at = np.stack([sky.truth["y"], sky.truth["x"]], axis=1)
    one = judged.Judged(at, sky.truth, 256)
    chosen = np.flatnonzero(one.judged() & ((at > 60) & (at < 196)).all(axis=1))
    assert len(chosen)
    true = np.stack([sky.truth[f"flux_{c}"][chosen] for c in ("VIS", "r", "i")], axis=1)
    ratios = photometry.compared(sky.mosaics, at, one.own[chosen], true)
    np.testing.assert_allclose(np.median(ratios["aperture"][-1]), 1, atol=0.1)
    np.testing.assert_allclose(np.median(ratios["forced"]), 1, atol=0.2)
    # the bands agree, so one PSF it is that apertures see
    assert np.ptp(np.median(ratios["aperture"][2], axis=0)) < 0.05


def test_a_search_alone():
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    parser = field.parser()
    options = parser.parse_args(["--quick", "--search-only", "--fields", "2", "--seed", "3"])
    row = field.searched(160, options)
    assert row["n_sources"] > 3 and row["spurious"] < 0.2 and row["wall_s"] > 0


def test_a_small_field(tmp_path):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    given = ["--quick", "--sizes", "160", "--density", "90", "--seed", "3", "--workers", "1"]
    (row,) = bench_json(tmp_path, "field", *given)["rows"]
    assert row.keys() >= {name for name, *_ in field.COLUMNS} | {"stage"}
    assert row["n_sources"] > 3 and "converged" in row["status"]
    assert row["core_s_per_source"] > 0 and row["peak_gb"] > 0.1
    assert row["stage"].keys() == {"search", "link", "fit"}
