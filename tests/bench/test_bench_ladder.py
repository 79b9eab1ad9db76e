"""The benchmark of galaxies of all sizes: rows, truth, what counts as silently wrong."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from helpers.benches import bench_json

pytest.importorskip("galsim")

LADDER = {
    "case", "mode", "scene", "source", "role", "n", "re_px", "q", "snr", "ratio", "pull", "chi2",
    "status", "flags", "silent", "seconds", "ratios", "pulls", "total_pulls", "snrs", "position_px",
}  # fmt: skip


def test_ladder(tmp_path):
    found = bench_json(
        tmp_path, "ladder", "--only", "single,star_as_galaxy", "--modes", "one", "--scenes", 1,
        "--n", 1, "--re", 2, 3, "--snr", 100, "--processes", 1,
    )  # fmt: skip
    rows = found["rows"]
    assert all(row.keys() == LADDER for row in rows)
    assert [(row["case"], row["scene"]) for row in rows] == [
        (case, scene) for case in ("single", "star_as_galaxy") for scene in (0, 1)
    ]
    assert [row["re_px"] for row in rows] == [2, 3, None, None]
    for row in rows:
        assert not row["silent"]
        assert row["snr"] == 100
        assert row["ratio"] in row["ratios"]
        assert abs(row["pull"]) == pytest.approx(max(map(abs, row["pulls"])))
    assert found["summary"]["single, one"]["sources"] == 2
    assert found["summary"]["single, one"]["fluxes"] == 6


def test_fluxes_between_the_bounds_are_right():
    from bench.ladder import compare

    flux = np.array([0.85, 0.8, 0.9, 1.0, 1.3])
    ratio, pull = compare(flux, np.full(5, 0.1), np.full(5, 0.8), np.full(5, 1.0))
    np.testing.assert_allclose(ratio, [1, 1, 1, 1, 1.3])
    np.testing.assert_allclose(pull, [0, 0, 0, 0, 3])
    # negative light beyond the frame: the whole has less than the frame
    ratio, pull = compare(np.array([0.9]), np.array([0.1]), np.array([1.0]), np.array([0.95]))
    np.testing.assert_allclose([*ratio, *pull], [0.9 / 0.95, -0.5])
    ratio, pull = compare(np.array([0.97]), np.array([0.1]), np.array([1.0]), np.array([0.95]))
    np.testing.assert_allclose([*ratio, *pull], [1, 0])


@pytest.mark.parametrize(
    ("error", "flags", "silent"),
    [
        (0.01, 0, True),
        (0.01, 1, True),  # EDGE
        (0.01, 64, False),  # MISFIT
        (0.01, 2, False),  # NOT_CONVERGED
        (0.05, 0, False),  # 4 sigma
        (np.nan, 0, True),  # an error that is no number excuses nothing
    ],
)
def test_silently_wrong_is_over_five_percent_and_sigma_and_no_flag(
    monkeypatch, error, flags, silent
):
    from bench import ladder
    from bench.harness.ladder_scenes import Item

    monkeypatch.setattr(ladder, "catalogue", lambda _: Table({"flags": [flags]}))
    covariance = np.diag([error**2, 1.0])[None]
    monkeypatch.setattr(ladder, "fluxes", lambda _: (np.array([[1.2, 5.0]]), covariance))
    monkeypatch.setattr(ladder.scenes, "chi2_of_all", lambda _: 1.0)
    total = np.array([[1.0, 5.0]])
    scene = SimpleNamespace(items=[Item((), 100.0)], inside=0.9 * total, total=total)
    result = SimpleNamespace(status="converged")
    (row,) = ladder.rows_of("single", "one", 0, scene, result, 1.0)
    assert row["silent"] is silent
    assert row["ratio"] == pytest.approx(1.2)


def test_a_scene_that_cannot_be_fitted_is_rows_and_never_right(monkeypatch):
    from bench import ladder
    from bench.harness.ladder_cases import Limits

    def fails(*_):
        raise ValueError("singular")

    monkeypatch.setattr(ladder, "deblend", fails)
    rows = ladder.measure("pair", "one", 0, 0, Limits(1.0, 4.0, 100.0))
    assert [row["status"] for row in rows] == ["failed: singular"] * 2
    assert all(row.keys() == LADDER for row in rows)
    figures = ladder.summarise(rows)["pair, one"]
    assert figures["fluxes within 3 % or 3 sigma"] == 0
    assert figures["chi2 <= 1.1"] == 0


def test_a_neighbour_lost_is_counted_unless_a_flag_names_it():
    from bench.ladder import is_lost

    row = {"ratios": [1.0, 2.1], "pulls": [0.0, 4.5], "flags": "EDGE"}
    assert is_lost(row)
    assert not is_lost(row | {"flags": "EDGE AMBIGUOUS"})
    assert not is_lost(row | {"pulls": [0.0, 3.9]})
    assert is_lost({"ratios": [0.4], "pulls": [-5.0], "flags": ""})


@pytest.mark.parametrize("mode", ["one", "joint"])
def test_scenes_have_the_signal_to_noise_and_the_flux_of_their_truth(mode):
    """Fluxes of two spectra and images; the light beyond the frame is in the total alone."""
    from bench.harness.ladder_cases import Limits, scene_of

    faint, bright = (scene_of("single", mode, 0, 0, Limits(4.0, 8.0, snr)) for snr in (1e3, 1e5))
    np.testing.assert_allclose(bright.total, 100 * faint.total, rtol=1e-6)
    assert (faint.inside < 0.97 * faint.total).all()  # of n = 4, 4 r_e from the centre
    assert (faint.inside > 0.7 * faint.total).all()
    power, sums = 0.0, []
    for o, less in zip(bright.observations, faint.observations, strict=True):
        light = (o.data - less.data) / 0.99  # without the noise, which is the same
        power += (light**2 * o.weights).sum()
        sums.extend(light.sum(axis=(1, 2)))
    assert np.sqrt(power) == pytest.approx(1e5, rel=1e-4)
    np.testing.assert_allclose(sums, bright.inside[0], rtol=1e-4)


def test_every_case_draws_its_sources_in_the_frame():
    from bench.harness.ladder_cases import CASES, Limits, cosmos_catalogue, scene_of

    counts = {"neighbour": 2, "pair": 2, "close": 2, "giant": 9}
    for case in CASES:
        if case == "cosmos" and cosmos_catalogue() is None:
            continue
        scene = scene_of(case, "one", 5, 0, Limits(largest_re_px=4.0))
        (image,) = scene.observations
        assert len(scene.sources) == counts.get(case, 1)
        assert {type(s).__name__ for s in scene.sources} == {
            "PointSource" if case == "galaxy_as_point" else "ExtendedSource"
        }
        for source in scene.sources:
            place = source.pixel(image.grid)
            assert (place > 10).all()
            assert (place < np.array(image.grid.shape) - 11).all()
