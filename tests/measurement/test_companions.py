"""Neighbours on the flanks of brighter sources, and clumps that are none."""

import numpy as np
import pytest

from clresample.measurement import detection
from clresample.measurement.companions import (
    CLUMP,
    CLUMP_ARCSEC,
    MAX_CLUMP,
    MIN_CLUMP,
    MIN_WIDE,
    brightest_peak_near,
    is_a_source,
    parabolic_peak,
    residual_scatter,
    symmetric_residual,
)
from clresample.measurement.signal_to_noise import SignalToNoise

SHAPE = (121, 121)
FWHM = 5.0  # [px] of a point in these images
SCALE = 0.1  # [arcsec] of their pixels
SEEN = np.ones(SHAPE, bool)


def spot(place, height, sigma=FWHM / 2.355, ratio=1.0):
    y, x = np.indices(SHAPE)
    radius = (y - place[0]) ** 2 + ((x - place[1]) / ratio) ** 2
    return (height * np.exp(-0.5 * radius / sigma**2)).astype(np.float32)


def rest_of(image, *places, seen=SEEN):
    return symmetric_residual(image, seen, np.array(places, float))


def test_a_symmetric_source_leaves_little_and_its_model_is_its_light():
    image = spot((60.3, 58.6), 500, sigma=6, ratio=1.6)
    rest, model, light = rest_of(image, (60.3, 58.6))
    assert np.abs(rest).max() < 0.02 * 500
    assert (rest / residual_scatter(model)).max() < 5
    np.testing.assert_allclose(model.sum(), image.sum(), rtol=0.05)
    assert light == pytest.approx(model.sum())


def test_a_neighbour_on_the_flank_is_left_with_its_height():
    host, other = spot((60, 60), 300, sigma=4), spot((60, 68), 40)
    rest, model, _ = rest_of(host + other, (60, 60))
    peak = np.unravel_index(rest.argmax(), SHAPE)
    assert np.hypot(peak[0] - 60, peak[1] - 68) < 1.5
    assert rest.max() == pytest.approx(40, rel=0.15)
    np.testing.assert_allclose(model[60, 40:60], host[60, 40:60], atol=8)


def test_a_side_that_was_not_seen_is_told_by_the_other():
    image = spot((60, 60), 300, sigma=4)
    seen = SEEN.copy()
    seen[:, 63:] = False
    rest, model, _ = rest_of(np.where(seen, image, 0), (60, 60), seen=seen)
    assert not rest[~seen].any()
    assert rest[seen].max() < 6 and model[60, 56] == pytest.approx(image[60, 56], rel=0.05)
    assert not rest_of(np.zeros(SHAPE), (60, 80), seen=seen)[1].any()


def judge(image, channels, place, centre=(60.0, 60.0), scale=SCALE, light=np.inf):
    """light: of the galaxy, by default too much for a neighbour to be told by its part of it."""
    rest, model, _ = rest_of(image, centre)
    places = np.moveaxis(np.indices(SHAPE), 0, -1).astype(float)
    signals = [
        SignalToNoise(
            channels[None, 0], channels[None, 0], SEEN.astype(int), channels, places, SEEN
        )
    ]
    height = rest[tuple(place)]
    lights, centres = np.array([light]), np.array([centre])
    given = model, lights, image, signals, centres, FWHM, scale
    return is_a_source(np.array(place), height, *given)


def test_a_clump_of_the_galaxys_colours_is_no_source_and_one_of_others_is():
    galaxy, clump = spot((60, 60), 1000, sigma=5), spot((60, 71), 70)
    same = np.stack([0.5 * (galaxy + clump), 0.5 * (galaxy + clump), 0.2 * (galaxy + clump)])
    other = np.stack([0.5 * galaxy + 1.0 * clump, 0.5 * galaxy, 0.2 * galaxy])
    assert not judge(galaxy + clump, same, (60, 71))
    assert judge(galaxy + clump, other, (60, 71))


@pytest.mark.parametrize(
    "away_arcsec, part",
    ((0.1, MIN_CLUMP), (CLUMP_ARCSEC, CLUMP), (1.1 * CLUMP_ARCSEC, 1.1 * CLUMP), (3, MAX_CLUMP)),
)
def test_what_is_bright_beside_the_light_about_it_is_a_source_in_any_colour(away_arcsec, part):
    galaxy = spot((60, 60), 100, sigma=4)
    for height, is_one in ((0.9 * part * 10, False), (1.1 * part * 10, True)):
        image = galaxy + spot((60, 76), height)  # where there is next to no light: H = 100, m = 0
        both = np.stack([image, image])
        assert judge(image, both, (60, 76), scale=away_arcsec / 16) == is_one


@pytest.mark.parametrize("away_arcsec, more", ((0.5, 0.1 / (0.025 * np.pi * 0.25)), (1.5, 1.0)))
def test_what_has_a_part_of_all_light_is_a_source_where_clumps_are_rarer(away_arcsec, more):
    """On light that would hide it otherwise; all of the galaxy's is at least that of its peak."""
    galaxy, part = spot((60, 60), 1000, sigma=8), 0.03 * more
    for points in (0.0, 1200.0):
        limit = part * max(points, 1000.0)
        for height, is_one in ((0.95 * limit, False), (1.05 * limit, True)):
            image = galaxy + spot((60, 68), height)
            one = image[None]  # of no colour
            given = {"scale": away_arcsec / 8, "light": points * 2.27 * FWHM**2}
            assert judge(image, one, (60, 68), **given) == is_one
            assert not judge(image, one, (60, 68), scale=away_arcsec / 8)


def test_centres_are_found_to_part_of_a_pixel():
    image = spot((60.3, 58.8), 100)
    np.testing.assert_allclose(parabolic_peak(image, (60, 59)), (60.3, 58.8), atol=0.05)
    np.testing.assert_array_equal(parabolic_peak(image, (0, 59)), (0, 59))


def test_the_top_of_what_is_left_is_nearer_than_its_peak_in_units_of_the_noise():
    image = spot((60, 60), 400, sigma=4) + spot((60.4, 67.2), 90)
    rest, model, _ = rest_of(image, (60, 60))
    peak = np.unravel_index((rest / residual_scatter(model)).argmax(), SHAPE)
    place, height = brightest_peak_near(rest, peak, 2)
    away, before = (np.hypot(*(np.array(p) - (60.4, 67.2))) for p in (place, peak))
    assert away <= before and away < 1.2
    assert height == rest.max() or height >= rest[peak]
    corner = np.zeros(SHAPE)
    corner[0, 1] = 3.0
    assert brightest_peak_near(corner, (1, 0), 2) == (pytest.approx((0, 1)), 3.0)


def beside(narrow, wide, monkeypatch):
    """Places of neighbours of the source at (60, 60), where two peaks are seen about (60, 72)."""
    sums = np.stack([narrow, wide])
    places = np.moveaxis(np.indices(SHAPE), 0, -1).astype(float)
    signals = [SignalToNoise(sums, sums**2, SEEN.astype(int), narrow[None], places, SEEN)]
    peaks = [(np.array([60.0, x]), 9.0) for x in (71, 73)]
    monkeypatch.setattr(detection, "new_peaks", lambda *args, **more: peaks)
    at = np.array([[60.0, 60.0]])
    found = detection._companions(None, signals, 0, narrow, at, 5.0, FWHM, SCALE)
    return [place for place, _ in found]


def test_two_peaks_about_one_top_are_one_neighbour(monkeypatch):
    image = spot((60, 60), 300, sigma=4) + spot((60, 72), 90)
    (place,) = beside(image, image, monkeypatch)
    assert np.hypot(*(place - (60, 72))) < 1


def test_a_neighbour_is_seen_under_the_filter_of_small_galaxies_too(monkeypatch):
    host = spot((60, 60), 300, sigma=4)
    for height, n in ((0.9 * MIN_WIDE, 0), (1.3 * MIN_WIDE, 1)):
        wide = host + spot((60, 72), height)
        assert len(beside(host + spot((60, 72), 90), wide, monkeypatch)) == n


def test_a_centre_beside_unseen_pixels_has_at_most_the_light_that_was_seen():
    image, seen = spot((60.3, 58.6), 500, sigma=6), SEEN.copy()
    seen[61:, :60] = False
    rest, model, _ = rest_of(image, (60.3, 58.6), seen=seen)
    assert model.max() <= image.max() and np.abs(rest[seen]).max() < 0.02 * 500
