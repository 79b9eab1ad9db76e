"""Rules of reach and lines: how far light is followed, how pixels along a line are interpolated."""

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, psfs

from clresample.resampling.gridding import transpose_taps
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.transfer import light_reach, wrap_radius
from clresample.sky.psf import PSF

pytestmark = pytest.mark.filterwarnings("ignore::clresample.sky.psf_checks.PSFWarning")
WINDOWS = [Precision.of(dtype).window for dtype in (np.float32, np.float64)]
WINDOW_ERRORS = 6e-7, 4e-14


def small_psf(shape=(3, 5)):
    """A PSF that is its whole image."""
    return PSF(np.ones(shape) / np.prod(shape))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_reach_of_a_gaussians_light(tolerance):
    psf = PSF.gaussian(1.5, n_pixels=41, pixel=False)
    reach = 1.5 * np.sqrt(2 * np.log(1 / tolerance))
    for matrix, factor in ((np.diag([2.0, 0.5]), 2), (np.array([[0.0, 1.0], [3.0, 0.0]]), 3)):
        assert light_reach(psf, matrix, tolerance) == pytest.approx(factor * reach, abs=1.1)
    # of the brighter and the wider of two bands the wider counts
    both = PSF.gaussian([1.5, 1.0], n_pixels=41, pixel=False)
    assert light_reach(both, np.eye(2), tolerance) == light_reach(psf, np.eye(2), tolerance)


def test_reach_ends_with_a_small_image():
    """Half a sample beyond the last ones along an axis, or where its corner lies, if nearer."""
    psf = small_psf()
    corner = np.hypot(1, 2)
    assert light_reach(psf, np.eye(2), 1e-5) == pytest.approx(corner)
    assert light_reach(psf, np.diag([1.0, 3.0]), 1e-5) == pytest.approx(3 * corner)
    assert light_reach(psf, np.diag([3.0, 1.0]), 1e-5) == pytest.approx(4.5)
    assert wrap_radius(psf, np.diag([3.0, 1.0])) == pytest.approx((4.5, 2.5))
    half = PSF(psf.images, spacing=0.5)
    assert light_reach(half, np.eye(2), 1e-5) == pytest.approx(corner / 2)
    assert wrap_radius(half, np.eye(2)) == pytest.approx((0.75, 1.25))


def test_the_wrap_radius_is_half_as_far_again_as_the_light():
    psf = PSF.gaussian(2.0, n_pixels=81, spacing=0.5, pixel=False)
    for radius in wrap_radius(psf, np.eye(2)):
        assert radius == pytest.approx(1.5 * light_reach(psf, np.eye(2), 1e-5) + 0.5)


@pytest.mark.parametrize("window", WINDOWS, ids=["float32", "float64"])
def test_taps_are_the_window_and_its_transform_is_the_integral(window):
    half = window.n_taps / 2
    fraction = np.array([1e-9, 0.1, 0.5, 0.77, 1 - 1e-9])
    wanted = window(fraction[:, None] + half - 1 - np.arange(window.n_taps))
    np.testing.assert_allclose(window.taps(fraction), wanted, atol=3e-14)
    assert window(0.0) == 1
    np.testing.assert_array_equal(window(np.array([-half, half, half + 0.1])), 0)
    u = (np.arange(4000) + 0.5) / 4000 * window.n_taps - half
    for f in np.array([0.0, 0.1, 1 / (2 * window.oversampling)]):
        integral = (window(u) * np.cos(2 * np.pi * f * u)).mean() * window.n_taps
        assert window.transform(f) == pytest.approx(integral, rel=1e-5)


@pytest.mark.parametrize("window", WINDOWS, ids=["float32", "float64"])
def test_waves_are_interpolated_as_well_as_is_said(window):
    """At the band's end, and better inside; beyond it the error is many times larger."""
    b = np.pi * window.n_taps * np.sqrt(1 - 1 / window.oversampling)
    said, rounding = 2 * b * np.exp(-b), 4e-14
    assert 0.5 < said / WINDOW_ERRORS[WINDOWS.index(window)] < 1
    n_taps, place = window.n_taps, np.random.default_rng(0).uniform(20, 30, 200)
    first = np.floor(place - n_taps / 2).astype(int) + 1
    column = first[:, None] + np.arange(n_taps)
    weight = window(place[:, None] - column)
    errors = []
    for share in (0.5, 1.0, 1.5):
        f = np.float64(share / (2 * window.oversampling))
        found = (weight * np.exp(2j * np.pi * f * column)).sum(axis=1) / window.transform(f)
        errors.append(np.abs(found - np.exp(2j * np.pi * f * place)).max())
    assert errors[0] < 0.1 * said + rounding
    assert 0.5 * said < errors[1] < 1.5 * said + rounding
    assert errors[2] > 30 * said


def test_columns_are_as_far_apart_as_the_band_allows():
    """Along a line the waves have frequencies nu_x + r nu_y, of which the corners hold nothing."""
    for name in ("30 degrees", "60 degrees", "shear along y"):
        mapping, precision = GEOMETRIES[name](), Precision.of(np.float32)
        plan = make_resampling_plan(mapping, *psfs(), precision=precision)
        r = np.divide(*mapping.matrix[:, 1 if plan.lines.by_row else 0])
        along = [r * plan.nu[0][:, None] + sign * plan.nu[1] for sign in (1, -1)]
        lit = [np.abs(d).any(axis=0) for d in (plan.d_plus, plan.d_minus)]
        most = max(np.abs(f[on]).max() for f, on in zip(along, lit, strict=True))
        assert most < 0.6 * np.abs(along).max()
        turned = plan.out_x[2] + 1j * plan.out_x[3]  # the first frequency over 0
        step = np.angle(turned[1:] / turned[:-1]) / (2 * np.pi * plan.nu[1][1])
        np.testing.assert_allclose(step, 1 / (2 * most * precision.window.oversampling), rtol=1e-9)


def test_lines_read_the_other_way_are_the_transpose():
    """Of any coverage: lines without a pixel, a pixel alone, columns that none feeds."""
    rng, n_columns, n_taps = np.random.default_rng(1), 23, 4
    for n_lines, n_steps, share in ((5, 7, 0.6), (3, 1, 1.0), (1, 9, 1.0), (4, 6, 0.1)):
        start = np.sort(rng.integers(0, n_columns - n_taps + 1, (n_lines, n_steps)), axis=1)
        covered = rng.uniform(size=start.shape) <= share
        covered[0, 0] = True
        weight = rng.normal(size=(*start.shape, n_taps)) * covered[..., None]
        first, back = transpose_taps(start, weight, covered, n_columns)
        n_back = back.shape[1]
        assert first.min() >= 0 and first.max() + n_back <= n_steps
        for line in range(n_lines):
            forward, backward = np.zeros((n_steps, n_columns)), np.zeros((n_columns, n_steps))
            for q, t in np.ndindex(n_steps, n_taps):
                forward[q, start[line, q] + t] += weight[line, q, t]
            for j, t in np.ndindex(n_columns, n_back):
                backward[j, first[line, j] + t] += back[line, t, j]
            np.testing.assert_array_equal(backward.T, forward)
        # as few taps as the busiest column needs
        used = [np.flatnonzero(column) for line in back.swapaxes(1, 2) for column in line]
        assert max((ends[-1] for ends in used if len(ends)), default=0) == n_back - 1
