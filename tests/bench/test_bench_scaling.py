"""`bench.scaling`, `bench.kills` and `bench.on_paper`: what their figures count."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from helpers.benches import bench_json

from bench import on_paper, scaling
from bench.kills import fields


def turn(n_round, seat, began, ended):
    return SimpleNamespace(
        task=SimpleNamespace(round=n_round), worker=seat, start_s=began, end_s=ended
    )


def test_the_tail_is_what_the_last_worker_did_alone():
    turns = [turn(0, 0, 0, 5), turn(0, 1, 0, 3), turn(0, 0, 5, 9), turn(1, 0, 9, 12)]
    turns += [turn(1, 1, 9, 10)]
    assert scaling.tail_of(turns, 2) == (9 - 3) + (12 - 10)


def test_speed_ups_are_those_over_the_fewest_workers(monkeypatch):
    monkeypatch.setattr(scaling, "written", lambda *_: (None, None))
    monkeypatch.setattr(
        scaling, "row_of", lambda toml, out, size, n, own: {"wall_s": 8 / n, "fit_s": 6 / n**2}
    )
    options = SimpleNamespace(quick=True, giant=False, repeats=1, workers=(4, 2))
    rows = list(scaling.rows_of(160, options, ()))
    assert [(row["speed_up"], row["fit_speed"]) for row in rows] == [(1, 1), (2, 4)]


def test_a_halo_has_one_surface_brightness_in_all_instruments():
    from clresample.simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY

    for survey, n in ((EUCLID_VIS, 100), (RUBIN_UGRIZY, 50)):
        mosaic = SimpleNamespace(survey=survey, grid=survey.grid(n))
        light = scaling.halo_of(mosaic, 100, EUCLID_VIS)
        corner = light[0, 0, 0] / survey.pixel_scale_arcsec**2
        mag = np.array(survey.zero_points_mag)[0] - 2.5 * np.log10(corner)
        if survey is EUCLID_VIS:
            first = mag
            sigma = light[0, 0, 0] / survey.noise_sigma[0]
            assert sigma == pytest.approx(scaling.HALO_SIGMA, rel=0.02)
        assert mag == pytest.approx(first, abs=0.1)
        assert light[0, n // 2, n // 2] == light[0].max() > light[0, 0, 0]


def test_one_tile_of_a_compressed_image_is_damaged_and_no_other(tmp_path):
    path, image = tmp_path / "a.fits", np.arange(200 * 90, dtype=np.float32).reshape(1, 200, 90)
    given = {"compression_type": "GZIP_2", "quantize_level": 0, "tile_shape": (1, 64, 90)}
    hdus = [fits.PrimaryHDU(), fits.CompImageHDU(image, name="SCI", **given)]
    fits.HDUList(hdus).writeto(path)
    assert fields.damage(path) == (192, 8)
    with fits.open(path) as hdus:
        np.testing.assert_array_equal(hdus["SCI"].section[0, :192], image[0, :192])
        with pytest.raises((OSError, ValueError, RuntimeError)):
            hdus["SCI"].section[0, 190:200]


def test_differences_are_counted_in_errors():
    clean = QTable({"id": [1, 2, 3], "flux_i": [1.0, 2.0, 3.0] * u.uJy})
    clean["flux_err_i"] = [0.1, 0.1, 0.1] * u.uJy
    rows = clean[:2].copy()
    rows["flux_i"][1] = 2.03 * u.uJy
    missing, worst = fields.compared(rows, clean)
    assert missing == 1 and worst == pytest.approx(0.3)


def test_the_page_holds_what_follows_from_its_figures():
    text = on_paper.PAGE.read_text()
    figures = on_paper.measured(text)
    assert on_paper.between(text, "arithmetic") == on_paper.arithmetic(figures)
    round_ones = {"core-seconds a source": 1.0, "sources a square arcminute": 36.0}
    other = on_paper.arithmetic(figures | round_ones)
    assert "| Rubin patch, 10' x 10' | 3,600 | 1 | 3,600 |" in other


def test_a_small_field_by_a_worker(tmp_path, monkeypatch):
    pytest.importorskip("galsim")
    pytest.importorskip("sep")
    given = ["--quick", "--sizes", "160", "--density", "90", "--seed", "3", "--workers", "1"]
    for name in ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"):  # set for the workers
        monkeypatch.setenv(name, "1")
    (row,) = bench_json(tmp_path, "scaling", *given)["rows"]
    assert row.keys() >= {name for name, *_ in scaling.COLUMNS}
    assert row["n_sources"] == row["measured"] > 3
    assert row["speed_up"] == 1 and 0 < row["own_cost"] < 1 and row["peak_gb"] > 0.1
