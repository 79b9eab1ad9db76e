"""Single formulas of the search beside bright sources, on images and spectra made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.measurement import companions, detection
from clresample.measurement.companions import (
    brightest_peak_near,
    is_a_source,
    local_level,
    parabolic_peak,
    residual_scatter,
    symmetric_residual,
)
from clresample.measurement.signal_to_noise import SignalToNoise


def cone(shape, centre, height):
    """height - distance, down to 0."""
    y, x = np.indices(shape)
    return np.maximum(height - np.hypot(y - centre[0], x - centre[1]), 0)


def test_a_cone_is_all_of_one_source_and_its_light_ends_under_half_a_sigma():
    image = cone((41, 43), (20, 22), 9.4)
    rest, model, _ = symmetric_residual(image, np.ones(image.shape, bool), np.array([[20.0, 22.0]]))
    np.testing.assert_allclose(model + rest, image, atol=1e-6)
    # rings at whole pixels between which cones are straight; a ring of 9 px has 0.4
    radius = np.hypot(*(np.indices(image.shape) - np.array([20, 22])[:, None, None]))
    np.testing.assert_allclose(model[radius <= 8], image[radius <= 8], atol=0.15)
    assert not model[radius > 9].any() and model[20, 22 + 9] == pytest.approx(0.4, abs=1e-5)
    assert not symmetric_residual(0.05 * image, image > -1, np.array([[20.0, 22.0]]))[1].any()


def test_the_level_of_a_residual_is_that_of_wings_and_not_of_a_peak():
    rest = cone((41, 43), (20, 22), 9.0)
    assert local_level(rest, (20, 22), 14) == 0
    assert local_level(rest + 4, (20, 22), 14) == local_level(rest + 4, (3, 40), 14) == 4
    assert local_level(rest - 4, (20, 22), 14) == 0


def test_a_turned_ellipse_is_all_of_one_source():
    """Each ring keeps its direction: it is not mirrored."""
    y, x = np.indices((91, 91)) - 45
    u, v = 0.8 * y + 0.6 * x, -0.6 * y + 0.8 * x
    image = 100 * np.exp(-0.5 * ((u / 9) ** 2 + (v / 4) ** 2))
    rest, model, _ = symmetric_residual(image, image > -1, np.array([[45.0, 45.0]]))
    assert np.abs(rest).max() < 3 and model[53, 51] == pytest.approx(image[53, 51], rel=0.05)
    assert model[53, 39] < 0.5 * model[53, 51]


@pytest.mark.parametrize("centre", [(65, 66), (65, 3), (128, 70)])
def test_light_is_followed_for_sixty_pixels(centre):
    """On all sides, as far as there are pixels; what lies behind an edge is told by the other."""
    image = np.full((131, 133), 3.0)
    _, model, _ = symmetric_residual(image, np.ones(image.shape, bool), np.array([centre], float))
    radius = np.hypot(*(np.indices(image.shape) - np.array(centre)[:, None, None]))
    np.testing.assert_allclose(model[radius < 59.9], 3, rtol=1e-6)
    assert not model[radius > 60.1].any()
    on_axes = [(centre[0] + s, centre[1] + t) for s, t in ((60, 0), (-60, 0), (0, 60), (0, -60))]
    for y, x in on_axes:
        if 0 <= y < 131 and 0 <= x < 133:
            assert model[y, x] == pytest.approx(3)


def test_models_of_two_sources_add_up():
    image = np.full((40, 40), 2.0)
    rest, model, _ = symmetric_residual(
        image, np.ones((40, 40), bool), np.array([[20.0, 20.0]] * 2)
    )
    np.testing.assert_allclose(model, 4, rtol=1e-6)
    np.testing.assert_allclose(rest, -2, rtol=1e-6)


def test_noise_of_what_is_left():
    """The noise of two sides where there is light, and 5 % of that."""
    np.testing.assert_allclose(
        residual_scatter(np.array([0.0, 1.0, 2.0, 100.0])),
        np.sqrt([1, 1 + 0.05**2, 2 + 0.1**2, 2 + 5**2]),
    )


@pytest.mark.parametrize("place", [(1, 1), (5, 6), (1, 5), (5, 1), (3, 3)])
def test_tops_of_parabolas_beside_an_edge(place):
    """Of an image of 7 x 8 pixels: all but the outermost are refined, exactly on a parabola."""
    y, x = np.indices((7, 8))
    top = np.add(place, (0.3, -0.2))
    image = 50 - 2 * (y - top[0]) ** 2 - 3 * (x - top[1]) ** 2
    np.testing.assert_allclose(parabolic_peak(image, place), top, atol=1e-12)


@pytest.mark.parametrize("place", [(0, 4), (6, 4), (3, 0), (3, 7)])
def test_a_peak_on_an_edge_stays(place):
    image = np.random.default_rng(0).random((7, 8))
    np.testing.assert_array_equal(parabolic_peak(image, place), place)


def test_a_top_lies_within_half_a_pixel():
    assert companions._top(0.0, 1.0, 1.0) == 0.5 and companions._top(1.0, 1.0, 0.0) == -0.5
    assert companions._top(0.0, 1.0, 1.5) == 0.5 and companions._top(1.5, 1.0, 0.0) == -0.5
    assert companions._top(0.0, 1.0, 0.0) == 0.0
    assert companions._top(1.0, 1.0, 1.0) == 0.0 and companions._top(2.0, 1.0, 3.0) == 0.0


def test_the_top_is_looked_for_within_the_radius_and_no_further():
    for away in ((0, 2), (2, 0), (-2, 0), (0, -2), (2, -2)):
        image = np.zeros((15, 17))
        image[7, 8], image[7 + away[0], 8 + away[1]] = 1.0, 5.0
        near, height = brightest_peak_near(image, (7, 8), 2)
        assert height == 5 and tuple(near) == (7 + away[0], 8 + away[1])
        near, height = brightest_peak_near(image, (7, 8), 1)
        assert height == 1 and np.hypot(*(near - (7, 8))) <= 0.5


def spectra_signal(spectra):
    """A stand-in for a SignalToNoise: `spectra` {pixel.

    Signal to noise of its channels}, else 0.
    """
    n = len(next(iter(spectra.values())))

    def at(places):
        return np.array([spectra.get(tuple(map(int, p)), np.zeros(n)) for p in places], float)

    return SimpleNamespace(channels=range(n), spectra=at)


@pytest.mark.parametrize("light, clump", [(0.0, 10.0), (3.0, 20.0)])
def test_clumps_grow_with_the_root_of_peak_and_light(light, clump):
    """Of a galaxy of 100 sigma: CLUMP and COLOURED times sqrt(100 (light + 1)), where pixels are so
    large that the peak is 0.8 arcsec from its centre; further away more, up to MAX_CLUMP."""
    image, model = np.zeros((2, 40, 40))
    image[20, 8], model[20, 30] = 100.0, light
    centres = np.array([[20.2, 7.9]])
    other = [spectra_signal({(20, 30): (90.0, 0.0), (20, 8): (0.0, 100.0)})]
    same = [spectra_signal({(20, 30): (9.0, 9.0), (20, 8): (90.0, 90.0)})]

    def judged(height, signals, far=1.0):
        scale = far * 0.8 / np.hypot(0.2, 22.1)
        given = model, np.full(len(centres), np.inf), image, signals, centres, 4.0, scale
        return is_a_source(np.array([20, 30]), height * clump, *given)

    assert [judged(h, same) for h in (0.449, 0.451)] == [False, True]
    assert [judged(h, same, 1.5) for h in (0.674, 0.676)] == [False, True]
    assert [judged(h, same, 3.0) for h in (0.749, 0.751)] == [False, True]
    assert [judged(h, same, 0.1) for h in (0.149, 0.151)] == [False, True]
    assert [judged(h, other) for h in (0.149, 0.151)] == [False, True]
    assert not judged(0.3, [spectra_signal({(20, 30): (90.0,), (20, 8): (100.0,)})])


@pytest.mark.parametrize("beyond, is_one", [(7.8, False), (8.2, True)])
def test_a_colour_is_another_from_eight_beyond_its_mean_on(beyond, is_one):
    """chi2 of what is left in one channel, of a host seen in the other alone: v^2 / 2 - 1."""
    image, model = np.zeros((2, 40, 40))
    image[20, 8] = 100.0
    signal = spectra_signal({(20, 30): (np.sqrt(2 * (beyond + 1)), 0), (20, 8): (0.0, 100.0)})
    given = 3.0, model, [np.inf], image, [signal], np.array([[20.0, 8.0]]), 4.0, 0.1
    assert is_a_source(np.array([20, 30]), *given) == is_one


def test_the_host_is_the_brightest_where_light_falls_by_e_a_fwhm():
    """Of 1000 sigma at 30 px and of 50 at 8 px, FWHM 5: the nearer one; at 20 px the brighter.

    Centres beyond the edges count as on them."""
    signals = []
    for place, host in (((20, 12), 50.0), ((20, 22), 1000.0)):
        image, model = np.zeros((2, 41, 43))
        image[20, 42], image[20, 4] = 1000.0, 50.0
        centres = np.array([[20.0, 42.9], [20.0, 4.0]])
        for part, is_one in ((0.74, False), (0.76, True)):
            height = part * np.sqrt(host)
            given = model, np.full(len(centres), np.inf), image, signals, centres, 5.0, 1.0
            assert is_a_source(np.array(place), height, *given) == is_one


def test_a_host_fainter_than_the_noise_counts_as_the_noise():
    image, model = np.zeros((2, 20, 20))
    given = model, [np.inf], image, [], np.array([[10.0, 5.0]]), 4.0, 0.16
    assert is_a_source(np.array([10, 10]), 0.46, *given)
    assert not is_a_source(np.array([10, 10]), 0.44, *given)


def test_spectra_differ_by_chi2_beyond_its_mean():
    """Noise of two sides, sqrt(2); what is like the host's spectrum does not count."""
    for here, wanted in (
        ((6.0, 8.0, 0.0), -2.0),
        ((0.0, 0.0, 10.0), 48.0),
        ((3.0, 4.0, 6.0), 16.0),
    ):
        signal = spectra_signal({(5, 30): here, (5, 5): (30.0, 40.0, 0.0)})
        found = companions._other_colour((5, 30), signal.spectra, [], (5, 5))
        assert found == pytest.approx(wanted)
    faint = spectra_signal({(5, 30): (6.0, 8.0, 0.0), (5, 5): (0.3, 0.4, 0.0)})
    assert companions._other_colour((5, 30), faint.spectra, [], (5, 5)) == pytest.approx(-2)
    dark = spectra_signal({(5, 30): (0.0, 6.0)})
    assert companions._other_colour((5, 30), dark.spectra, [], (5, 5)) == pytest.approx(17)


def test_the_galaxys_own_light_is_taken_off_with_a_tenth_of_it_as_error():
    """Along the line to the peak and behind the centre it has (100, 0)."""
    flat = {(5, x): (100.0, 0.0) for x in range(61)}
    flat[5, 40] = (100.0, 12.0)
    signal = spectra_signal(flat)
    found = companions._other_colour((5, 40), signal.spectra, [np.array([5.0, 25.0])], (5, 25))
    assert found == pytest.approx(12**2 / 2 - 1)
    flat[5, 40] = (130.0, 0.0)  # as a host of the other colour would see it
    flat[5, 2] = (0.0, 50.0)
    found = companions._other_colour((5, 40), signal.spectra, [np.array([5.0, 25.0])], (5, 2))
    assert found == pytest.approx(30**2 / (2 + 10**2) - 1)


def test_a_sources_light_is_the_least_on_the_way_and_on_its_mirror_image():
    line = {(5, x): (50.0, 50.0) for x in range(41)}
    line[5, 24], line[5, 13] = (20.0, 60.0), (40.0, 10.0)
    line[5, 31], line[5, 9] = (1.0, 1.0), (2.0, -3.0)
    signal = spectra_signal(line)
    centre = np.array([5.0, 20.0])
    np.testing.assert_allclose(companions._light_at((5, 23), signal.spectra, centre), (50, 50))
    np.testing.assert_allclose(companions._light_at((5, 24), signal.spectra, centre), (20, 50))
    np.testing.assert_allclose(companions._light_at((5, 30), signal.spectra, centre), (20, 10))
    np.testing.assert_allclose(companions._light_at((5, 31), signal.spectra, centre), (1, 0))
    np.testing.assert_allclose(companions._light_at((5, 20), signal.spectra, centre), (50, 50))


def test_a_neighbour_on_a_flank_is_found_in_one_channel():
    """At its own place and height, where the sharpest observation alone has seen the sky."""
    sep = pytest.importorskip("sep")
    y, x = np.indices((81, 83))

    def spot(place, height, sigma):
        away = (y - place[0]) ** 2 + (x - place[1]) ** 2
        return (height * np.exp(-0.5 * away / sigma**2)).astype(np.float32)

    image = spot((40, 38), 300, 4) + spot((40, 48), 60, 1.7)
    places = np.moveaxis(np.indices(image.shape), 0, -1).astype(float)
    both = np.stack([image, image])  # under both filters that are asked
    signal = SignalToNoise(
        both, both**2, np.ones(image.shape, int), image[None], places, np.ones(image.shape, bool)
    )
    given = sep, [signal], 0, image, np.array([[40.0, 38.0]])
    ((place, height),) = detection._companions(*given, 5.0, 4.0, 0.1)
    assert np.hypot(*(place - (40, 48))) < 0.7 and height == pytest.approx(60, rel=0.15)
    assert detection._companions(*given, 100.0, 4.0, 0.1) == []
    assert detection._companions(*given, 5.0, 15.0, 0.1) == []  # the same source, in so wide a PSF


def test_what_no_channel_has_seen_is_told_by_the_other_side(monkeypatch):
    given = []

    def left(image, seen, centres):
        given.append(seen)
        return np.zeros(image.shape), np.zeros(image.shape), np.zeros(len(centres))

    monkeypatch.setattr(detection, "symmetric_residual", left)
    monkeypatch.setattr(detection, "new_peaks", lambda *_, **__: [])
    n_seen = np.array([[0, 1, 2]] * 3)
    image = np.zeros((3, 3), np.float32)
    both = np.stack([image, image])  # under both filters that are asked
    signal = SignalToNoise(both, both, n_seen, image[None], np.zeros((3, 3, 2)), n_seen > 0)
    detection._companions(None, [signal], 0, image, np.array([[1.0, 1.0]]), 5.0, 4.0, 0.1)
    assert given[0].tolist() == [[False, True, True]] * 3


def test_companions_have_five_sigma_however_low_the_threshold(monkeypatch):
    given = []

    def searched(_sep, _image, threshold, area, _fwhm, known, apart, own):
        given.append((threshold, area, len(known), apart, own))
        return []

    monkeypatch.setattr(detection, "new_peaks", searched)
    image = np.zeros((20, 20), np.float32)
    places = np.moveaxis(np.indices(image.shape), 0, -1).astype(float)
    both = np.stack([image, image])  # under both filters that are asked
    signal = SignalToNoise(
        both, both, np.ones(image.shape, int), image[None], places, image < np.inf
    )
    for threshold in (2.0, 8.0):
        where = np.array([[10.0, 10.0]])
        detection._companions(None, [signal], 0, image, where, threshold, 4.0, 0.1)
    assert given == [(5, 2, 1, 0.7 * 4, False), (8, 2, 1, 0.7 * 4, False)]
