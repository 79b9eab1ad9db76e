"""Single formulas of detection: slips in them leave most detections as they are."""

import numpy as np
import pytest
from helpers.blends import blend, in_frame, observe, round_component
from scipy.special import erf

from clresample.measurement import detection as module, peaks
from clresample.measurement.detection import ALL, detect, detect_more
from clresample.measurement.signal_to_noise import signal_of
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

pytest.importorskip("sep")
GRID = Grid.flat((60, 60), 0.1)


def point_source(psf, peak=30.0):
    image = np.zeros(GRID.shape)
    image[20:41, 25:46] = peak * PSF.gaussian(1.5, n_pixels=21).images[0]
    rng = np.random.default_rng(5)
    return Observation(image + rng.normal(0, 1, GRID.shape), psf, GRID, weights=1.0)


def test_signal_to_noise_does_not_depend_on_the_psfs_sampling():
    found = []
    for spacing, n in ((1.0, 31), (0.5, 61)):
        o = point_source(PSF.gaussian(1.5, n_pixels=n, spacing=spacing))
        found.append(signal_of(o, model_frame([o])).sums)
    np.testing.assert_allclose(found[1], found[0], atol=0.02 * np.abs(found[0]).max())


def test_width_of_a_gaussian_on_coarser_pixels():
    """In pixels of the frame, half as large: a Gaussian's FWHM is 2.355 sigma, to one sample."""
    coarse = Observation(
        np.zeros((30, 30)), PSF.gaussian(2.0, n_pixels=41), Grid.flat((30, 30), 0.2), weights=1.0
    )
    frame = model_frame([coarse], grid=GRID)
    assert module._fwhm_px(coarse, frame) == pytest.approx(2.355 * 2 * 2, abs=1.2)


def test_a_constant_sky_is_no_bright_model():
    """Residual peaks have the same signal to noise whether a sky was fitted under them or not."""
    component = round_component(0, (30, 30), (40.0, 20.0))
    shape = (60, 70)
    model = np.array([s * in_frame(component, shape) for s in component.spectrum])
    extra = np.zeros(shape)
    extra[10:31, 45:66] = 40 * PSF.gaussian(1.3, n_pixels=21).images[0]
    noise = np.random.default_rng(1).normal(0, 1, (2, *shape))
    found = []
    for sky in (0.0, 1000.0):
        seen = observe(Grid.flat(shape, 0.1), ("g", "r"), data=model + extra + noise + sky)
        result = blend([component], observations=(seen,), sky=np.full(2, sky))
        found.append(detect_more(result))
    assert len(found[0].peaks)
    np.testing.assert_allclose(found[1].peaks, found[0].peaks, rtol=1e-3)


def two_widths():
    sharp = Observation(
        np.zeros(GRID.shape), PSF.gaussian(1.5, n_pixels=31), GRID, weights=1.0, name="sharp"
    )
    grid = Grid.flat((30, 30), 0.2)
    wide = Observation(
        np.zeros(grid.shape), PSF.gaussian(1.7, n_pixels=31), grid, weights=1.0, name="wide"
    )
    return [sharp, wide]


@pytest.mark.parametrize("away, n", [(4.0, 1), (9.0, 2)])
def test_a_peak_of_all_images_within_the_wider_psf_is_the_same_source(monkeypatch, away, n):
    """FWHM 3.5 and 8 px: 4 px away counts as the source of the sharp image, 9 px do not."""
    found = [(np.array([30.0, 30.0]), 20.0)], [], [(np.array([30.0, 30.0 + away]), 9.0)], [], []
    each = iter(found)
    monkeypatch.setattr(peaks, "_objects", lambda *_: (next(each), np.zeros(GRID.shape, int)))
    found = detect(two_widths(), model_frame(two_widths(), grid=GRID))
    assert len(found.sources) == n
    assert found.found_in == ("sharp", ALL)[:n]


def test_a_star_between_pixels_as_large_as_its_psf_is_one_source():
    """They show it uneven: what symmetry leaves beside its maximum is the star itself."""
    edges, psf = np.arange(42) - 20.5, PSF.gaussian(0.45, n_pixels=81, spacing=0.25)
    for n, place in enumerate([(0.3, -0.3), (-0.27, 0.2), (0.5, 0.5), (0.2, 0.35)]):
        light = [np.diff(erf((edges - c) / (np.sqrt(2) * 0.45))) / 2 for c in place]
        data = 1000 * np.outer(*light) + np.random.default_rng(n).normal(size=(41, 41))
        star = Observation(data, psf, Grid.flat((41, 41), 0.1), weights=1.0)
        assert len(detect([star]).sources) == 1


def test_beyond_the_border_of_an_image_nothing_is_seen():
    """If less than a tenth of a PSF's light lies on pixels, a hot pixel near by is no source."""
    half = Grid.flat((60, 30), 0.1, center_arcsec=(0, -1.5))
    data = np.zeros(half.shape)
    data[30, 29] = 1e4
    o = Observation(data, PSF.gaussian(2.0, n_pixels=31), half, weights=1.0)
    image = signal_of(o, model_frame([o], grid=GRID)).flat()
    assert image[30, 29] > 100
    assert not image[:, 29 + 6 :].any()  # 3 sigma: a thousandth of its light is inside


def signal_to_noise(observation, frame=None):
    """Of all channels together, under the narrowest filter."""
    return signal_of(observation, frame or model_frame([observation])).flat()


@pytest.mark.parametrize("unit", [1e15, 1e-15])
def test_signal_to_noise_does_not_depend_on_the_unit_of_the_data(unit):
    """Though its weights, and data times weights, are beyond float32."""
    o = point_source(PSF.gaussian(1.5, n_pixels=31))
    scaled = Observation(o.data * unit, o.psf, GRID, weights=o.weights / unit**2)
    np.testing.assert_allclose(signal_to_noise(scaled), signal_to_noise(o), atol=1e-4)


def test_sources_are_seen_in_pixels_much_larger_than_the_models():
    """Each model pixel then has a hundredth of an observed pixel's weight."""
    coarse = Grid.flat((12, 12), 1.0)
    data = np.zeros(coarse.shape)
    data[6, 6] = 100.0
    o = Observation(data, PSF.gaussian(0.6, n_pixels=11), coarse, weights=1.0)
    frame = model_frame([o], grid=Grid.flat((120, 120), 0.1))
    assert signal_to_noise(o, frame).max() > 50


def test_channels_of_pure_noise_add_up_to_unit_scatter():
    rng = np.random.default_rng(2)
    data = rng.normal(size=(4, 60, 60))
    o = Observation(data, PSF.gaussian(1.5, n_pixels=31), GRID, weights=1.0, channels=list("abcd"))
    assert np.std(signal_to_noise(o)[10:-10, 10:-10]) == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("area, n", [(0.5, 1), (2.0, 0)])
def test_an_object_has_as_many_pixels_as_it_has_to(area, n):
    import sep

    image = np.zeros((20, 20), np.float32)
    image[10, 12] = 9
    found = peaks.new_peaks(sep, image, 5.0, area, 3.0, [], 1.0)
    assert [(tuple(place), peak) for place, peak in found] == [((10, 12), 9)][:n]


def test_the_brightest_peak_comes_first():
    import sep

    image = np.zeros((30, 30), np.float32)
    for place, peak in (((5, 5), 9), ((20, 8), 30), ((12, 24), 15)):
        image[place] = peak
    assert [peak for _, peak in peaks.new_peaks(sep, image, 5.0, 1, 3.0, [], 1.0)] == [30, 15, 9]


@pytest.mark.parametrize("width, first, n", [(3.5, True, 2), (3.5, False, 1), (0.9, True, 1)])
def test_a_wide_object_of_little_light_on_a_galaxy_is_found_by_the_first_search(width, first, n):
    import sep

    y, x = np.indices((160, 160)) - 80.0
    galaxy = 3000 / (1 + (y**2 + x**2) / 60)
    other = 30 * np.exp(-((y - 50) ** 2 + (x - 50) ** 2) / (2 * width**2))
    image = (galaxy + other).astype(np.float32)
    assert len(peaks.new_peaks(sep, image, 5.0, 1, 2.0, [], 1.0, first=first)) == n


def test_an_image_below_the_threshold_is_not_searched(monkeypatch):
    class NotAsked:
        def extract(self, *_args, **_given):
            raise AssertionError("sep was asked")

    import sep

    image = np.zeros((9, 12), np.float32)
    image[4, 5:8] = 5.0
    objects, segments = peaks._objects(NotAsked(), image, 5.0, 1, 3.0)
    assert objects == [] and segments.shape == image.shape and not segments.any()
    image[4, 6] = np.float32(5.0001)
    (found,), segments = peaks._objects(sep, image, 5.0, 1, 3.0)
    assert found[0].tolist() == [4, 6] and segments.sum() == 1
