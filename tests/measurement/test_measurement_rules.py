"""Rules of detection and residuals at their limits, each alone: what is just inside counts."""

import numpy as np
import pytest
from helpers.blends import blend, observe, round_component
from scipy.signal import fftconvolve

from clresample.deblending.assessment.misfit import Misfit
from clresample.deblending.linear.spectra import MODEL_ERROR
from clresample.deblending.posterior.residuals import _filtered, _kernels, convolved
from clresample.measurement import detection, peaks, searched as searched_module
from clresample.measurement.detection import detect, detect_more
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

GRID = Grid.flat((60, 60), 0.1)


def test_five_sigma_and_three_percent_in_any_channel_are_a_misfit():
    residuals = np.array([[4.99, np.nan], [5.01, 0], [1, 5.01], [np.nan, np.nan], [9, 1], [9, 9]])
    light = np.array([[9, 9], [3.01, 0], [9, 3.01], [9, 9], [2.99, 9], [2.99, 3.01]])
    whole, wide = np.zeros((2, 2)), np.zeros(len(light))
    rest = np.full(light.shape, 100.0), whole, whole, np.ones(2), np.full(2, np.nan), wide, wide
    none = np.full(residuals.shape, np.nan)
    found = Misfit(residuals, none, none, light, *rest)
    assert found.sources().tolist() == [False, True, True, False, False, True]
    excess = np.where(residuals > 5, residuals, np.nan)  # as well
    found = Misfit(none, excess, none, light, *rest)
    assert found.sources().tolist() == [False, True, True, False, False, True]
    around = np.array([3.99, 4.01, 9, 9, 0, 0]), np.array([9, 0.0301, 0.0299, 9, 9, 9])
    found = Misfit(none, none, none, light, *rest[:5], *around)
    assert found.sources().tolist() == [False, True, False, True, False, False]


@pytest.mark.parametrize(
    "shape, psf_shape", [((12, 15), (5, 7)), ((9, 8), (4, 6)), ((3, 4), (7, 9))]
)
def test_convolved_is_scipys_with_zeros_beyond_the_edges(shape, psf_shape):
    rng = np.random.default_rng(3)
    image, psf = rng.normal(size=shape), rng.normal(size=psf_shape)
    np.testing.assert_allclose(
        convolved(image, psf), _centred(image, psf), rtol=0, atol=1e-12 * np.abs(image).max()
    )


def _centred(image, psf):
    """The middle of the full convolution, of the image's shape."""
    full = fftconvolve(image, psf)
    y, x = ((k - 1) // 2 for k in psf.shape)
    return full[y : y + image.shape[0], x : x + image.shape[1]]


def test_residuals_are_known_where_pixels_have_a_weight():
    """Whatever its unit; not on masked pixels, nor on those of a millionth of the others'."""
    kernel = np.outer(*[[0.25, 0.5, 0.25]] * 2)
    weights = np.ones((1, 20, 22))
    weights[0, 10, 10], weights[0, :, 18:] = 0, 0
    weights[0, 5, 20] = 1e-7
    seen = weights > 0.1
    for unit in (1.0, 1e-9, 1e9):
        found, _ = _filtered(np.full(weights.shape, unit**-0.5), unit * weights, kernel[None])
        np.testing.assert_array_equal(np.isfinite(found), seen)
        assert found[0, 4, 4] == pytest.approx(1 / np.sqrt((kernel**2).sum()))


def test_residuals_are_filtered_with_a_gaussian_as_wide_as_an_oversampled_psf():
    (fine,) = _kernels(PSF.gaussian(2.0, n_pixels=81, spacing=0.5))
    (plain,) = _kernels(PSF.gaussian(2.0, n_pixels=41))
    for kernel, atol in ((fine, 0.15), (plain, 1e-2)):
        y, x = (np.arange(n) - n // 2 for n in kernel.shape)
        assert kernel.sum() == pytest.approx(1, abs=1e-3)
        assert (y**2) @ kernel.sum(1) == pytest.approx(4 + 1 / 12, rel=atol)
        assert (x**2) @ kernel.sum(0) == pytest.approx(4 + 1 / 12, rel=atol)


@pytest.mark.parametrize("threshold", [0, -1.0, np.inf, np.nan, "5"])
def test_a_threshold_is_a_positive_number(threshold):
    o = Observation(np.zeros(GRID.shape), PSF.gaussian(1.5), GRID, weights=1.0)
    with pytest.raises(ValueError, match=f"threshold is {threshold!r}, must be a positive"):
        detect([o], threshold=threshold)


def two_widths():
    """FWHM of 3.5 and 8 px of the frame, the wider one first."""
    coarse = Grid.flat((30, 30), 0.2)
    wide = Observation(
        np.zeros(coarse.shape), PSF.gaussian(1.7, n_pixels=31), coarse, weights=1.0, name="wide"
    )
    sharp = Observation(
        np.zeros(GRID.shape), PSF.gaussian(1.5, n_pixels=31), GRID, weights=1.0, name="sharp"
    )
    return [wide, sharp]


def test_objects_have_a_quarter_of_the_square_of_their_images_fwhm(monkeypatch):
    """The sharpest first; of all together that of the sharpest.

    A peak counts as a known source within 0.7 FWHM of the image, of the widest for all together.
    """
    pytest.importorskip("sep")
    given = []

    def searched(_sep, _image, threshold, area, _fwhm, _known, apart, **_more):
        given.append((threshold, area, apart))
        return []

    monkeypatch.setattr(searched_module, "new_peaks", searched)
    seen = two_widths()
    frame = model_frame(seen, grid=GRID)
    assert not detect(seen, frame).sources
    narrow, wide = (detection._fwhm_px(o, frame) for o in reversed(seen))
    assert narrow == pytest.approx(3.5, abs=0.5) and wide == pytest.approx(8, abs=1)
    expected = [
        (5, narrow**2 / 4, 0.7 * narrow),
        (5, wide**2 / 4, 0.7 * wide),
        (5, narrow**2 / 4, 0.7 * wide),
    ]
    np.testing.assert_allclose(given, expected)


def test_the_width_of_an_observation_is_that_of_its_sharpest_channel():
    o = Observation(
        np.zeros((2, *GRID.shape)), PSF.gaussian([3.0, 1.5]), GRID, weights=1.0, channels=("g", "r")
    )
    frame = model_frame([o], grid=Grid.flat((120, 120), 0.05))
    assert detection._fwhm_px(o, frame) == pytest.approx(2 * 2.355 * 1.5, rel=0.1)


def test_the_models_error_is_added_to_the_noise_of_residuals(monkeypatch):
    """1 / w + (0.15 model)^2, the sky left out; no known source is searched beside."""
    given = []

    def searched(*arguments, **more):
        given.append((arguments, more))
        nothing = np.zeros(0)
        return detection.Detection((), arguments[1], nothing, (), np.zeros((60, 60)), nothing)

    monkeypatch.setattr(detection, "_search", searched)
    component = round_component(0, (30, 30), (40.0, 20.0))
    seen = observe(GRID, ("g", "r"), data=7.0, weights=0.25, zero_points=25.0, name="cam")
    result = blend([component], observations=(seen,), grid=GRID, sky=np.array([5.0, 3.0]))
    detect_more(result, threshold=4.0)
    ((left,), frame, threshold, known), more = given[0]
    assert (frame, threshold, more["beside"]) == (result.frame, 4.0, False)
    (places,) = more["places"]
    np.testing.assert_allclose(places, np.moveaxis(np.indices((60, 60)), 0, 2), atol=1e-9)
    np.testing.assert_array_equal(known, [[30, 30]])
    light = result.model(0) - result.sky[:, None, None]
    assert MODEL_ERROR == 0.15
    np.testing.assert_allclose(1 / left.weights, 4 + (0.15 * light) ** 2)
    np.testing.assert_allclose(left.data, 7 - result.model(0))
    assert (left.name, left.channels) == ("cam", ("g", "r"))
    np.testing.assert_array_equal(left.zero_points, seen.zero_points)


def test_what_an_object_is_and_what_a_known_source_hides():
    sep = pytest.importorskip("sep")
    image = np.zeros((30, 40), np.float32)
    for place, peak in (((5, 5), 9.0), ((5, 30), 12.0), ((20, 10), 5.5), ((29, 39), 4.5)):
        image[place] = peak

    def found(known, apart=0.0, own=True, area=1):
        new = peaks.new_peaks(sep, image, 5.0, area, 3.0, known, apart, own=own)
        return [tuple(map(int, place)) for place, _ in new]

    assert found([]) == [(5, 30), (5, 5), (20, 10)]
    assert found([], area=1.9) == found([])  # whole pixels
    assert found([], area=2) == []
    assert found([np.array([5.4, 29.6])]) == [(5, 5), (20, 10)]  # the object holds it
    assert found([np.array([5.4, 29.6])], own=False) == found([])
    near = [np.array([8.0, 9.0])]  # 5 px from one
    assert found(near, apart=5.0) == [(5, 30), (20, 10)]
    assert found(near, apart=4.9) == found([])
    assert found([*near, np.array([25.0, 35.0])], apart=5.0) == [(5, 30), (20, 10)]
    assert found([np.array([-3.0, 50.0])]) == found([])  # beyond the edges


def test_a_faint_neighbour_of_a_bright_object_is_an_object_of_its_own():
    """With half a percent of the light, beside a peak of thirty times its height; a shoulder of
    0.05 % is none."""
    sep = pytest.importorskip("sep")
    y, x = np.indices((60, 60))

    def spot(at, height, sigma):
        return height * np.exp(-0.5 * ((y - at[0]) ** 2 + (x - at[1]) ** 2) / sigma**2)

    bright = spot((30, 20), 3000, 5)
    for height, n in ((100.0, 2), (9.0, 1)):
        image = (bright + spot((30, 41), height, 1.8)).astype(np.float32)
        objects, segments = peaks._objects(sep, image, 5.0, 3, 4.0)
        assert len(objects) == n == segments.max()
        assert tuple(objects[0][0]) == (30, 20) or tuple(objects[-1][0]) == (30, 20)
