"""The benchmarks of deblending on a few scenes: rows, summaries, runs that go on."""

import json

import numpy as np
import pytest
from helpers.benches import run_bench

pytest.importorskip("galsim")

SHORT = ("--scenes", "1", "--max-iter", "10")
ROW = {
    "seed", "view", "angle_deg", "mirrored", "mode", "batch", "n_sources", "iterations",
    "ms_per_iteration", "galsim_ms", "ratio", "wall_s", "wall_again_s", "seconds", "sdr",
    "sdr_median", "chi2", "chi2_by_instrument", "converged",
}  # fmt: skip
BATCH_ROW = {
    "mode", "batch", "n_sources", "iterations", "ms_per_iteration", "galsim_ms", "ratio", "wall_s",
    "scenes_per_second", "sdr", "sdr_median", "chi2", "converged", "n_converged",
}  # fmt: skip


def test_deblend(tmp_path):
    file = tmp_path / "deblend.json"
    text = run_bench(
        "deblend", *SHORT, "--seed", "2", "--views", "upright", "turned", "--batches", "1", "2",
        "--json", str(file),
    )  # fmt: skip
    found = json.loads(file.read_text())
    singles = [row for row in found["rows"] if "view" in row]
    batches = [row for row in found["rows"] if "view" not in row]
    assert all(row.keys() == ROW for row in singles)
    assert all(row.keys() == BATCH_ROW for row in batches)
    assert [(r["view"], r["mode"]) for r in singles] == [
        (view, mode) for view in ("upright", "turned") for mode in ("rubin", "euclid", "joint")
    ]
    assert [(r["batch"], len(r["sdr"])) for r in batches] == [
        (n, n * singles[0]["n_sources"]) for n in (1, 2)
    ]
    for row in found["rows"]:
        assert row["ratio"] == pytest.approx(row["ms_per_iteration"] / row["galsim_ms"])
        assert 0 < row["iterations"] <= 10 * row["batch"]
        assert row["sdr_median"] == pytest.approx(np.median(row["sdr"]))
        assert 0.8 < row["chi2"] < 2
    joint = singles[2]
    assert joint["chi2_by_instrument"].keys() == {"Euclid", "Rubin"}
    summary = found["summary"]
    assert summary["upright"]["galaxies"] == joint["n_sources"]
    assert summary["upright"]["sdr joint [dB]"] == pytest.approx(joint["sdr_median"])
    assert summary["turned"]["sdr euclid against upright [dB]"] == pytest.approx(0, abs=1e-3)
    assert "joint over the better single [share]" in text


def test_joint_goes_on_where_it_ended(tmp_path):
    from bench.harness.records import read_json
    from bench.paper import joint_findings

    options = ("--processes", "1", "--folder", str(tmp_path))
    run_bench("paper.joint", "--scenes", "1", *options)
    one = (tmp_path / "joint.jsonl").read_text()
    text = run_bench("paper.joint", "--scenes", "2", *options)
    two = (tmp_path / "joint.jsonl").read_text()
    assert two.startswith(one)
    assert two.count("\n") == 3  # settings and two scenes
    found = json.loads((tmp_path / "joint.json").read_text())
    counts = [len(json.loads(line)[1]["euclid_mag"]) for line in two.splitlines()[1:]]
    assert found["n_galaxies"] == sum(counts) == np.sum(found["maps"]["number"])
    assert found["starts"].keys() == {"own", "sersic"}
    for start in found["starts"]:
        for finding in joint_findings.findings(start, read_json(tmp_path / "joint.json")):
            assert finding.found.endswith(".")
            assert finding.found in text
            assert finding.figure is None or (tmp_path / finding.figure).is_file()


def test_sersic_profiles_are_found():
    from bench.paper import sersic

    y, x = np.indices((61, 64)) - np.array([30.3, 33.8])[:, None, None]
    image = 5 * np.exp(-0.5 * ((y / 4) ** 2 + (x / 2) ** 2) ** (1 / 1.6))
    found = sersic.fit(image, np.array([30.0, 33.0]))
    assert np.abs(found / found.max() - image / image.max()).max() < 0.02
