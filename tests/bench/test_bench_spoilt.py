"""The benchmark of spoilt input: rows, ways of spoiling, words that name them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.benches import bench_json

pytest.importorskip("galsim")

SPOILT = {
    "scene", "spoilt", "moved", "ratio", "own", "neighbour", "n_ratio", "n_own", "chi2", "status",
    "flags", "named", "good", "texts",
}  # fmt: skip


def test_spoilt(tmp_path):
    found = bench_json(
        tmp_path, "spoilt", "--scenes", "sim", "--only", "nothing", "listed twice",
        "a band without weight", "--clean", 1, "--processes", 1,
    )  # fmt: skip
    rows = {row["spoilt"]: row for row in found["rows"]}
    assert all(row.keys() == SPOILT for row in rows.values())
    assert list(rows) == ["nothing", "listed twice", "a band without weight"]
    assert rows["nothing"]["moved"] == 0
    assert rows["nothing"]["good"]
    assert rows["a band without weight"]["named"]
    assert abs(rows["listed twice"]["moved"]) < 3  # the two fluxes together
    assert found["clean"].keys() == {"sim", "sim 30000"}


def fitted(flux, *, error=1.0, texts=(), flags=None, listed=None):
    """A fit of three sources in one band, as `bench.spoilt.Fitted` has it."""
    from bench.spoilt import Fitted

    one = object.__new__(Fitted)
    one.flux, one.error = {"r": np.array(flux, float)}, {"r": np.full(3, error)}
    one.texts, one.status, one.chi2 = list(texts), "converged", 1.0
    one.flags = np.zeros(3, int) if flags is None else np.array(flags)
    one.listed = np.ones(3, bool) if listed is None else np.array(listed)
    return one


@pytest.mark.parametrize(
    ("flux", "texts", "named", "good"),
    [
        ((100, 50, 20), (), False, True),
        ((100, 50, 23.5), (), False, False),
        ((96, 50, 20), (), False, False),
        ((96, 50, 20), ("HSC r: sky of 0.5 sigma is left",), True, True),
        ((96, 50, 20), ("said of the unspoilt sky too",), False, False),
    ],
)
def test_a_spoilt_scene_is_good_within_three_sigma_or_with_a_word(flux, texts, named, good):
    from bench.spoilt import row_of

    reference = fitted((100, 50, 20), texts=["said of the unspoilt sky too"])
    spoilt = fitted(flux, error=2.0, texts=texts)
    row = row_of("sim", "sky + 0.5 sigma", spoilt, reference, 0)
    assert (row["named"], row["good"]) == (named, good)
    assert row["moved"] == flux[0] - 100
    assert row["own"] == (flux[0] - 100) / 2
    assert row["neighbour"] == flux[2] - 20


def test_a_source_that_is_not_listed_has_not_moved():
    from bench.spoilt import row_of

    reference = fitted((100, 50, 20))
    spoilt = fitted((0, 51, 20), listed=[False, True, True])
    row = row_of("sim", "brightest not listed", spoilt, reference, 0)
    assert np.isnan(row["moved"])
    assert row["neighbour"] == 1
    assert row["good"]
    flagged = fitted((0, 90, 20), listed=[False, True, True], flags=[0, 128, 0])
    assert row_of("sim", "core clipped", flagged, reference, 0)["named"]


def test_ways_of_spoiling_do_what_they_say():
    from bench.harness import spoiling
    from bench.harness.spoilt_scenes import simulated

    scene = simulated(3, 3)
    made = {way: change(scene, 0) for way, (change, _) in spoiling.SPOILT.items()}
    last = scene.observations[-1]
    sky = made["sky + 0.5 sigma"].observations[-1]
    sigma = last.weights[:, :1, :1] ** -0.5
    np.testing.assert_allclose(sky.data - last.data, 0.5 * sigma * np.ones(last.shape), rtol=1e-4)
    wide = made["PSF 5 % wider"].observations[-1].psf.images
    assert wide.max() / last.psf.images.max() < 0.95
    moved = made["0.3 px between bands"].observations
    assert [len(o.channels) for o in moved] == [1, 3, 3]
    place = [o.grid.pixel(*scene.places[0]) for o in moved[1:]]
    np.testing.assert_allclose(place[1] - place[0], [0.3, 0], atol=1e-6)
    assert len(made["brightest not listed"].places) == 2
    assert made["brightest not listed"].owners.tolist() == [1, 2]
    assert made["twice, 0.7 px apart"].owners.tolist() == [0, 1, 2, 0]
    grid = scene.observations[0].grid
    apart = grid.pixel(*made["positions 1 px off"].places.T) - grid.pixel(*scene.places.T)
    np.testing.assert_allclose(np.hypot(*apart.T), 1, atol=1e-6)
    ray = made["cosmic ray"].observations[0].data - scene.observations[0].data
    assert (ray != 0).sum() == 6
    small = made["units of 1e-19"].observations[0]
    np.testing.assert_allclose(
        small.data * small.weights**0.5,
        scene.observations[0].data * scene.observations[0].weights ** 0.5,
        rtol=1e-5,
    )


@pytest.mark.parametrize(("apart_px", "said"), [(0.9, False), (1.1, True)])
def test_a_warning_of_two_close_sources_is_false_where_they_are_apart(apart_px, said):
    from bench.harness.spoilt_scenes import simulated
    from bench.spoilt import DOUBLES, false_texts

    scene = simulated(3, 1)
    grid = scene.observations[-1].grid
    y, x = grid.pixel(*scene.places[0])
    scene = replace(scene, places=np.array([scene.places[0], grid.sky(y, x + apart_px)]))
    texts = [f"sources lie within 1 pixel of each other: 0 and 1; {DOUBLES}", "sky is left in"]
    assert false_texts(texts, "sim", scene) == texts[1 - said :]
    assert false_texts(["light that no source is listed for"], "hsc_blend", scene) == []
