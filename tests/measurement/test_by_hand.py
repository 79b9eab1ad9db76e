"""Single formulas of what is measured on a fit: slips in them leave most catalogues as they are."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.blends import MIDDLE, SCALE, blend, gaussian, observe, round_component, two_sources

from clresample.deblending.component_images import ComponentImages
from clresample.deblending.posterior.residuals import max_filtered_residuals
from clresample.deblending.result import Component
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.quality import box_chi2
from clresample.measurement.shapes import moments
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import PointSource

GRID = Grid.flat((60, 70), SCALE)


def sums_of(image):
    """Errors.outside_box_moments of an image (ny, nx): sums of it, and of it times y, x, ..."""
    y, x = np.indices(image.shape)
    return np.array([(image * part).sum() for part in (1, y, x, y * y, y * x, x * x)])


def test_moments_have_what_lies_beyond_the_box():
    """As of the whole image; its light is 0.7 in the box and 0.3 beyond."""
    image = gaussian((40, 44), (18, 23), [[30, 8], [8, 20]])
    image[:3] = 0  # pixels without light are no reason to leave the component out
    image /= image.sum()
    box = (slice(10, 27), slice(14, 31))
    rest = image.copy()
    rest[box] = 0
    assert 0.1 < rest.sum() < 0.6
    parts = [Component(0, (0, 0), image, np.ones(1))]
    whole = moments(parts, np.ones(1))
    parts = [Component(0, (10, 14), image[box], np.ones(1))]
    found = moments(parts, np.ones(1), sums_of(rest)[None])
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


def test_light_beyond_the_box_counts_wherever_it_lies():
    """In row 0 of the frame, where its sum times y is 0."""
    image, rest = np.zeros((3, 9)), np.zeros((6, 9))
    image[1, 4], rest[0, 2] = 3.0, 1.0
    parts = [Component(0, (2, 0), image, np.ones(1))]
    centroid, second = moments(parts, np.ones(1), sums_of(rest)[None])
    np.testing.assert_allclose(centroid, [3 * 3 / 4, (3 * 4 + 2) / 4])
    np.testing.assert_allclose(second[0, 0], 3 / 4 * 1 / 4 * 9)


def test_channels_whose_error_is_infinite_do_not_weigh_in_moments():
    """The first component shines in g, the second in r, whose fluxes nothing determines."""
    parts = [round_component(0, (30, x), a) for x, a in ((32, (1.0, 0.0)), (38, (0.0, 1.0)))]
    covariance = np.stack([np.eye(2), np.diag([np.inf, np.inf])])
    row = catalogue(blend(parts, covariance=covariance))[0]
    assert row["x_centroid"].value == pytest.approx(32, abs=1e-9)


def test_chi2_is_of_the_boxes_of_all_components():
    """Components of one source in boxes that do not meet."""
    data = np.full((1, *GRID.shape), 5.0)
    data[:, 5:16, 5:16], data[:, 40:51, 40:51] = 1.0, 3.0
    parts = [round_component(0, (c, c), (0,), n=11) for c in (10, 45)]
    result = blend(parts, observations=(observe(GRID, ("g",), data=data, weights=2.0),))
    found = box_chi2(result, 0, result.footprints[0])
    assert found[0] == pytest.approx(2.0 * (1 + 9) / 2)


def test_colours_of_fluxes_under_one_unit():
    seen = observe(GRID, ("g", "r"), weights=1e-12, zero_points=23.9)
    parts = [round_component(0, MIDDLE, (0.02, 0.01))]
    small = catalogue(blend(parts, observations=(seen,)), magnitudes=True)
    assert 0 < small["flux_r"][0].value < 1
    assert small["colour_g_r"][0].value == pytest.approx(-2.5 * np.log10(2))
    assert np.isfinite(small["colour_err_g_r"][0].value)


@pytest.mark.parametrize("away, flagged", [((0.6, 0.3), True), ((1.0, 0.0), False)])
def test_a_core_is_no_less_than_the_pixel_that_holds_it(away, flagged):
    """A PSF of 0.9 px: pixels within 0.71 px are the core."""
    weights = np.ones((1, *GRID.shape))
    weights[0, 30, 35] = 0
    psf = PSF.gaussian(0.4, n_pixels=15)
    seen = Observation(
        np.zeros((1, *GRID.shape)), psf, GRID, weights=1e-12 * weights, channels=("g",)
    )
    where = (30 + away[0], 35 + away[1])
    result = blend(
        [round_component(0, where, (1,))],
        observations=(seen,),
        sources=(PointSource(position_px=where),),
    )
    assert bool(catalogue(result)["flags"][0] & Flag.SATURATED) == flagged


def seen_alone(data, weights, grid=None):
    """A faint source in data that hold much else."""
    grid = Grid.flat(data.shape, SCALE) if grid is None else grid
    psf = PSF.gaussian(1.2, n_pixels=9)
    o = Observation(data[None], psf, grid, weights=weights[None], channels=("g",))
    shape = tuple(min(n, 20) for n in data.shape)
    part = Component(0, (0, 0), np.ones(shape), np.array([1e-9]))
    return blend([part], observations=(o,), grid=Grid.flat(shape, SCALE))


@pytest.mark.parametrize("n_masked, scaled", [(0, True), (1, False)])
def test_four_hundred_pixels_of_sky_say_how_large_the_noise_is(n_masked, scaled):
    rng = np.random.default_rng(4)
    weights = np.ones(400)
    weights[:n_masked] = 0
    noise = rng.normal(0, 5, (20, 20))
    worst = max_filtered_residuals(seen_alone(noise, weights.reshape(20, 20)), 0)[0, 0]
    assert (worst < 6) == scaled and worst > 1


@pytest.mark.parametrize("light, scaled", [(0.9, True), (1.1, False)])
def test_sky_is_where_the_model_has_less_than_one_sigma(light, scaled):
    noise = np.random.default_rng(4).normal(0, 5, (20, 20))
    weights = np.full((20, 20), 0.25)  # 2 counts of noise
    result = seen_alone(noise + 2 * light, weights)
    part = replace(result.components[0], spectrum=np.array([2 * light]))
    worst = max_filtered_residuals(replace(result, components=(part,)), 0)[0, 0]
    assert (worst < 5) == scaled


def test_residuals_beyond_the_frame_count_for_no_source():
    """Data of 24 x 24 pixels about a frame of 20 x 20."""
    data = np.full((24, 24), 1e6)
    data[2:-2, 2:-2] = 0
    assert max_filtered_residuals(seen_alone(data, np.ones((24, 24))), 0)[0, 0] < 1e-3


def test_a_flux_is_that_of_the_sources_own_components():
    result = two_sources()
    alone = replace(result, components=result.components[:2], covariance=np.ones((2, 2, 2)))
    alone = replace(alone, rendered=tuple(r[:2] for r in result.rendered))
    np.testing.assert_allclose(
        catalogue(alone)["flux_g"][0].value, catalogue(result)["flux_g"][0].value
    )
    assert np.isnan(catalogue(alone)["flux_g"][1].value)


def test_residuals_are_filtered_with_the_psf_as_it_lies():
    """Of a PSF with a wing on one side, what looks like it counts more than its mirror image."""
    image = np.zeros((9, 9))
    image[4, 4], image[2, 7], image[3, 5] = 1, 0.6, 0.5
    psf = PSF(image, center=(4, 4))
    found = []
    for seen in (psf.images[0], psf.images[0][::-1, ::-1]):
        data = np.zeros((20, 20))
        data[6:15, 6:15] = 30 * seen
        o = Observation(data[None], psf, Grid.flat((20, 20), SCALE), weights=1.0, channels=("g",))
        part = Component(0, (0, 0), np.ones((20, 20)), np.array([1e-9]))
        result = blend([part], observations=(o,), grid=Grid.flat((20, 20), SCALE))
        found.append(max_filtered_residuals(result, 0)[0, 0])
    power = np.sqrt((psf.images[0] ** 2).sum())
    assert found[0] == pytest.approx(30 * power, rel=1e-6) and found[1] < 0.8 * found[0]


def test_chi2_counts_the_first_rows_and_columns():
    """A box in the corner of the frame, where all of the misfit is in row 0 and column 0."""
    data = np.zeros((1, *GRID.shape))
    data[:, 0, :5], data[:, 1:5, 0] = 3.0, 3.0
    part = Component(0, (0, 0), np.ones((5, 5)), np.array([0.0]))
    result = blend([part], observations=(observe(GRID, ("g",), data=data),))
    assert box_chi2(result, 0, result.footprints[0])[0] == pytest.approx(9 * 9 / 25)


def test_moments_of_nothing_are_no_numbers():
    dark = Component(0, (0, 0), np.zeros((3, 3)), np.ones(1))
    centroid, second = moments([dark], np.ones(1))
    assert centroid.shape == (2,) and second.shape == (2, 2)
    assert np.isnan(centroid).all() and np.isnan(second).all()


def test_a_window_holds_the_light_of_all_components():
    """Of a source whose components shine apart from each other: the window spans them both."""
    rendered = ComponentImages.cropped(
        (2, 1, 40, 40), np.array([[3, 4], [20, 25]]), [np.ones((1, 6, 7)), np.ones((1, 8, 9))]
    )
    assert rendered.window(0, 1) == (slice(3, 28), slice(4, 34))
    assert rendered.window(1) == (slice(20, 28), slice(25, 34))
    assert ComponentImages.of(np.ones((2, 1, 40, 41))).window(0, 1) == (slice(0, 40), slice(0, 41))
