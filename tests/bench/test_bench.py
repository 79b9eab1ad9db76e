"""The benchmarks on a tiny configuration: rows and record."""

import json

import pytest
from helpers.benches import run_bench

ROW = {
    "from", "to", "n_model", "n_obs", "angle_deg", "batch", "ours_ms", "ours_both_ms",
    "ours_device_ms", "galsim_ms", "galsim_sinc_ms", "ratio", "ours_sdr", "galsim_sdr",
    "galsim_sinc_sdr", "galsim_formula_sdr", "setup_ms", "gflop",
}  # fmt: skip
RECORD = {"date", "device", "platform", "machine", "python", "threads", "clresample", "numpy"}


def test_render(tmp_path):
    pytest.importorskip("galsim")
    file = tmp_path / "render.json"
    text = run_bench(
        "render", "--sizes", "20", "--pairs", "EUCLID-RUBIN", "hst-hst",
        "--galaxies", "1", "--seconds", "0.01", "--json", str(file),
    )  # fmt: skip
    found = json.loads(file.read_text())
    rows = found["rows"]
    assert all(row.keys() == ROW for row in rows)
    assert found["record"].keys() >= RECORD
    assert "OMP_NUM_THREADS=1" in found["record"]["threads"]
    cases = {(r["from"], r["to"], r["n_model"], r["angle_deg"], r["batch"]) for r in rows}
    assert len(cases) == len(rows) == 2 * 2 * 2  # pairs, angles, batches
    for row in rows:
        assert row["ratio"] == pytest.approx(row["galsim_ms"] / row["ours_ms"])
        assert row["n_obs"] == row["n_model"] // (2 if row["to"] == "RUBIN" else 1)
        assert row["ours_sdr"] > row["galsim_sdr"] - 0.5  # dB: stamps this small cut the galaxies
        if row["to"] == "HST" and row["angle_deg"] == 0:
            assert row["ours_sdr"] > 70  # dB: the identity, as the truth rounded to float32
    assert set(found["summary"]) == {
        "ratio", "ratio in batches of 64", "forward + adjoint over forward",
        "30 degrees over aligned",
    }  # fmt: skip
    assert "EUCLID-RUBIN:\nratio:\n" in text
    assert list(tmp_path.iterdir()) == [file]  # no half-written file is left


def test_quick_has_every_pair_and_the_main_sizes():
    from bench import render
    from bench.harness.options import survey_pairs

    options = render.parser().parse_args(["--quick"])
    planned = {
        (pair, n, angle, batch)
        for pair, n, angles, batches in render.plan(options)
        for angle in angles
        for batch in batches
    }
    assert {case[0] for case in planned} == set(survey_pairs())
    assert len(survey_pairs()) == 15
    for n_model in (50, 100, 200, 400):
        assert (("EUCLID", "RUBIN"), n_model, 0.0, 1) in planned


def test_contract(tmp_path):
    file = tmp_path / "contract.json"
    run_bench("contract", "--seconds", "0.001", "--json", str(file))
    found = json.loads(file.read_text())
    assert found["record"].keys() >= RECORD
    for row in found["rows"]:
        assert row.keys() == {"shape", "batch", "dtype", "ours_gflops", "numpy_gflops", "ratio"}
        assert row["ratio"] == pytest.approx(row["ours_gflops"] / row["numpy_gflops"])
    assert ([256, 256, 256], 8, "float32") in [
        (row["shape"], row["batch"], row["dtype"]) for row in found["rows"]
    ]


def test_stages(tmp_path):
    pytest.importorskip("galsim")
    file = tmp_path / "stages.json"
    run_bench("stages", "--quick", "--seconds", "0.001", "--json", str(file))
    found = json.loads(file.read_text())
    assert found["record"].keys() >= RECORD
    assert [(r["survey"], r["n_sources"]) for r in found["rows"]] == [
        (survey, n) for n in (2, 9) for survey in ("Euclid", "Rubin")
    ]
    for row in found["rows"]:
        assert len(row["ms"]) == len(row["mf"]) == 3
        assert row["mf"][row["chosen"]] == min(row["mf"])
