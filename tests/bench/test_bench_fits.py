"""The benchmarks of accuracy, errors and cost on the smallest configurations: rows, failures."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.benches import bench_json

pytest.importorskip("galsim")

RECORD = {"date", "device", "platform", "machine", "python", "threads", "clresample", "numpy"}
COVERAGE = {
    "mode", "galaxies", "light", "quantity", "snr_low", "snr_high", "n", "coverage", "error",
    "width", "bias",
}  # fmt: skip
THROUGHPUT = {
    "what", "n_scenes", "n_sources", "n_model", "core_s_per_source", "wall_s", "galsim_ms",
    "host_ms_a_scene", "host_ms", "renders_per_source", "iterations", "chi2", "peak_gb",
    "base_gb", "stage", "status",
}  # fmt: skip
REAL = {
    "scene", "band", "chi2", "status", "seconds", "core_s", "iterations", "n_sources", "residual",
    "source", "flagged", "n_unflagged", "stages", "sources", "messages",
}  # fmt: skip
NOISE = {
    "recipe", "bands", "n", "median", "mean", "against", "coverage", "error", "width", "scatter",
    "bias", "seconds",
}  # fmt: skip
STARS = {
    "psf", "snr", "psf_error", "n", "sdr", "coverage", "typical", "worst", "stated", "star",
}  # fmt: skip
SETTINGS = {
    "settings", "mode", "n", "median", "mean", "worse", "below", "against", "error", "chi2",
    "converged", "iterations", "seconds", "moved", "redrawn",
}  # fmt: skip
MODES = "euclid", "joint-lanczos"  # images, and mosaics made of them
ONE = "--scenes", 1, "--seed", 6  # of two galaxies


def run(folder, module, *options):
    """Rows that a benchmark writes."""
    found = bench_json(folder, module, *options)
    assert found["record"].keys() >= RECORD
    return found["rows"]


def test_coverage(tmp_path):
    rows = run(
        tmp_path, "coverage", *ONE, "--modes", *MODES,
        "--galaxies", "parametric", "--processes", 1,
    )  # fmt: skip
    assert all(row.keys() == COVERAGE for row in rows)
    assert {row["light"] for row in rows} == {"even"}
    fluxes = [row for row in rows if row["quantity"] == "flux"]
    assert [(r["mode"], r["snr_low"]) for r in fluxes] == [
        (mode, low) for mode in MODES for low in (3, 10, 30, 100, 300, 3)
    ]
    for mode in MODES:
        *bins, whole = (row for row in fluxes if row["mode"] == mode)
        assert whole["snr_high"] is None
        assert whole["n"] == sum(row["n"] for row in bins)


def test_coverage_of_right_errors_is_that_of_a_normal_distribution():
    from bench.coverage import rows_of

    rng = np.random.default_rng(0)
    snr = rng.uniform(3, 30, (400, 20))
    true = rng.uniform(5, 10, snr.shape)
    error = true / snr
    estimate = 1.01 * true + error * rng.standard_normal(snr.shape)
    values = [{"flux": np.stack(one)} for one in zip(snr, estimate, true, error, strict=True)]
    found = rows_of("joint", "parametric", "even", values)
    rows = {(r["snr_low"], r["snr_high"]): r for r in found}
    whole = rows[3, np.inf]
    assert whole["n"] == 8000
    assert whole["coverage"] == pytest.approx(0.68, abs=0.02)
    assert whole["error"] == pytest.approx(np.sqrt(0.68 * 0.32 / 8000), rel=0.2)
    assert whole["width"] == pytest.approx(1, abs=0.04)
    assert whole["bias"] == pytest.approx(0.01, abs=0.004)
    assert rows[100, 300]["n"] == 0
    # galaxies of a scene that all err alike say as little as one of them
    alike = [{"flux": np.repeat(v["flux"][:, :1], 20, axis=1)} for v in values]
    *_, found = rows_of("joint", "parametric", "even", alike)
    assert found["error"] == pytest.approx(np.sqrt(0.68 * 0.32 / 400), rel=0.2)


def test_scenes_are_made_brighter_with_their_truth_and_the_same_noise():
    from bench.harness.brightness import BRIGHTEST_MAG, evened, signal_to_noise
    from clresample.simulation.scenes import simulate_scene

    scene = simulate_scene(0, n_sources=3, n_pixels=30)
    for mode, images in (("euclid", ["euclid"]), ("joint", ["euclid", "rubin"])):
        found = evened(scene, mode)
        snr = np.median(signal_to_noise(found, mode))
        factor = snr / np.median(signal_to_noise(scene, mode))
        brightest = min(getattr(found, name).magnitudes.min() for name in images)
        assert brightest == pytest.approx(BRIGHTEST_MAG) or (brightest > 18 and 3 < snr < 10000)
        for name in ("euclid", "rubin"):
            old, new = getattr(scene, name), getattr(found, name)
            noise = [image.data - image.contributions.sum(axis=0) for image in (old, new)]
            np.testing.assert_allclose(*noise, atol=1e-6 * new.survey.noise_sigma.min())
            np.testing.assert_allclose(new.counts, factor * old.counts)
            np.testing.assert_allclose(new.survey.counts(new.magnitudes), new.counts)
            np.testing.assert_allclose(new.contributions, factor * old.contributions)
            assert new.truth is old.truth
        assert evened(scene, mode).euclid.counts[0] == found.euclid.counts[0]  # by the seed


def test_components_are_scored_by_their_counts():
    """Of one source, with a right one of all light and a wrong one of a hundredth of it."""
    from bench.harness.scenes import scores

    truth, wrong = np.zeros((2, 1, 8, 8))
    truth[0, 2, 3], wrong[0, 6, 5] = 1, 1
    parts = [
        SimpleNamespace(source=0, origin=(0, 0), morphology=image[0], spectrum=np.array(spectrum))
        for image, spectrum in ((truth, [60.0, 40.0]), (wrong, [0.0, 1.0]))
    ]
    scene = SimpleNamespace(euclid=SimpleNamespace(truth=truth))
    (found,) = scores(SimpleNamespace(components=parts), scene)
    assert found == pytest.approx(10 * np.log10(101 / np.sqrt(2)))


def test_values_with_errors_are_found_by_their_columns(monkeypatch):
    from astropy import units as u
    from astropy.table import QTable

    from bench.harness import truth
    from clresample.simulation.scenes import simulate_scene

    scene = simulate_scene(0, n_sources=2, n_pixels=40)
    n_lit = 10 ** (-0.4 * (scene.euclid.magnitudes[:, 0] - 23.9))
    table = QTable({"flux_VIS": n_lit * 1.1 * u.uJy, "flux_err_VIS": n_lit / 10 * u.uJy})
    table["y_centroid"] = scene.euclid.positions_px[:, 0] * u.pix
    table["y_centroid_err"] = [0.5, np.nan] * u.pix
    table["e1"], table["e1_err"] = [0.1, 0.2], [0.3, 0.3]
    table["rms_size"] = [1, 1] * u.arcsec  # without errors
    monkeypatch.setattr(truth, "catalogue", lambda _, magnitudes: table)
    found = truth.compare(None, scene, "euclid")
    assert found.keys() == {"flux", "position", "ellipticity"}
    np.testing.assert_allclose(found["flux"][0], 10)
    np.testing.assert_allclose(found["flux"][1] - found["flux"][2], found["flux"][3])
    np.testing.assert_allclose(found["ellipticity"][3], 0.3)
    assert found["position"].shape == (4, 1)  # the one that has an error
    assert abs(found["position"][1] - found["position"][2]) < 3  # px: knots move the centroid
    kept = truth.compare(None, scene, "euclid", keep=np.array([True, False]))
    assert kept["flux"].shape == (4, 1)


def test_real(data, tmp_path):
    rows = run(tmp_path, "real", "--only", "hsc_blend", "cosmos", "--galaxies", 1)
    assert all(row.keys() == REAL for row in rows)
    assert [row["band"] for row in rows] == ["g", "r", "i", "z", "y", "F814W"]
    assert [row["n_sources"] for row in rows] == [7] * 5 + [1]
    assert min(row["chi2"] for row in rows) > 0.5
    for row in rows:
        assert row["residual"] > 0
        assert 0 <= row["source"] < row["n_sources"]


def test_real_scene_files_hold_nothing_but_defaults(data, tmp_path):
    from bench.real import scene_files
    from clresample import Settings
    from clresample.fields.field_toml.scene_file import read_scene

    paths = scene_files(data, tmp_path)
    assert paths.keys() == {"hst_hsc", "hst", "hsc"}
    joint = read_scene(paths["hst_hsc"])
    assert [o.name for o in joint.observations] == ["HST", "HSC"]
    assert joint.settings.fit_shifts is True
    assert str(replace(joint.settings, fit_shifts="auto", fit_sky="auto")) == str(Settings())
    assert joint.sources is None
    assert read_scene(paths["hst"]).settings.fit_shifts == "auto"


def test_throughput(tmp_path):
    rows = run(tmp_path, "throughput", *ONE, "--blends", 20, "--limit", 0.1)
    assert all(row.keys() == THROUGHPUT for row in rows)
    assert [row["what"] for row in rows] == ["shared", "own", "blend"]
    for row in rows[:2]:
        assert row["core_s_per_source"] > 0
        assert row["renders_per_source"] == pytest.approx(
            row["core_s_per_source"] / row["galsim_ms"] * 1e3
        )
        assert row["stage"].keys() >= {"setup", "fit", "result", "catalogue"}
        assert sum(row["stage"].values()) <= 1.01 * row["wall_s"]
        assert 0 < row["base_gb"] <= row["peak_gb"]
        assert row["host_ms"].keys() >= {"start", "iterate", "learn", "errors", "catalogue"}
        stages = sum(row["host_ms"].values()) - row["host_ms"]["learning round"]
        assert 0 < row["host_ms_a_scene"] == pytest.approx(stages)
    assert rows[2]["status"] == "over 0.1 s"
    assert rows[2]["core_s_per_source"] is None


def test_a_blend_without_memory_is_a_row():
    from bench import throughput

    options = throughput.parser().parse_args(["--memory", "0.02"])
    row = throughput.blend_apart(20, options, limit_s=100)
    assert row["status"].startswith("failed: ")
    assert row["n_model"] == 256


def test_crowded_blend_holds_its_light():
    from bench.harness.crowded import crowded_blend

    blend = crowded_blend(1, 4, 100)
    assert [o.shape for o in blend.observations] == [(1, 100, 100), (6, 50, 50)]
    assert blend.frame.contains(blend.frame.positions_of(blend.sources)).all()
    for o in blend.observations:
        level = np.median(o.data, axis=(1, 2)) * np.sqrt(o.weights[:, 0, 0])
        assert np.abs(level).max() < 1
        assert (o.data.max(axis=(1, 2)) * np.sqrt(o.weights[:, 0, 0])).max() > 10


def test_settings(tmp_path):
    rows = run(
        tmp_path, "settings", *ONE, "--processes", 1, "--settings", "default", "paper"
    )  # fmt: skip
    assert all(row.keys() == SETTINGS for row in rows)
    assert [(r["settings"], r["mode"]) for r in rows] == [
        (name, mode) for name in ("default", "paper") for mode in ("rubin", "euclid", "joint")
    ]
    for row in rows[:3]:
        assert row["against"] == 0
    for row in rows:
        assert 0 <= row["worse"] <= 1


def test_noise(tmp_path):
    rows = run(tmp_path, "noise", *ONE, "--processes", 1)
    assert [(row["recipe"], row["bands"]) for row in rows] == [
        (recipe, bands)
        for recipe in ("native", "correlated", "white")
        for bands in ("Euclid", "Rubin")
    ]
    assert all(row.keys() == NOISE for row in rows)
    assert rows[0]["against"] == 0
    assert len({row["n"] for row in rows if row["bands"] == "Rubin"}) == 1  # the same fluxes


def test_stars(tmp_path):
    rows = run(tmp_path, "stars", "--quick", "--scenes", 1, "--processes", 1)
    assert all(row.keys() == STARS for row in rows)
    assert [(row["psf"], row["psf_error"]) for row in rows] == [
        (psf, error) for psf in ("right", "wider 3 %") for error in (0, 0.03)
    ]
    wrong, allowed = rows[2:]
    assert allowed["worst"] < 0.5 * wrong["worst"]
