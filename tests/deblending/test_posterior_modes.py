"""Modes of a morphology: bumps, slopes of profiles, moments; compared with their definitions."""

import numpy as np
import pytest
from helpers import scenes
from scipy.signal import fftconvolve

from clresample.deblending.posterior import smooth_modes as room
from clresample.deblending.posterior.moments import light_sums, moment_derivatives
from clresample.deblending.posterior.profile_modes import profile_modes
from clresample.deblending.posterior.smooth_modes import MAX_MODES, SmoothModes, whitening_transform
from clresample.deblending.profiles import FixedProfile, GalaxyProfile, StarProfile
from clresample.deblending.result import Component
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.measurement.shapes import moments


def gaussians(origin, shape, h):
    """Every h pixels of the frame, of width h / 2, on a box (ny, nx) that starts at `origin`."""
    y, x = np.indices(shape)
    low = [o // h * h - h for o in origin]
    rows, columns = (
        np.arange(a, o + n + 2 * h, h) - o for a, o, n in zip(low, origin, shape, strict=True)
    )
    away = [((y - a) ** 2 + (x - b) ** 2) / (h / 2) ** 2 for a in rows for b in columns]
    return np.exp(-0.5 * np.array(away))


@pytest.mark.parametrize("least_light", [1e-4, 1e-6])
def test_bumps_are_convolutions_by_definition(least_light):
    prior, shape, origin = MultiscalePrior(), (23, 27), (13, 22)
    y, x = np.indices(shape)
    profile = np.exp(-0.5 * ((y - 10) ** 2 + (x - 14) ** 2) / 3.0**2)
    shared = (np.abs(y - 11) < 4) & (x > 9) & (x < 18)
    strengths = np.array([0.02, 0.06, 0.03])
    bumps = SmoothModes(
        origin, profile, strengths, prior.kernels(), shared, least_light=least_light
    )
    coarse, fine = (gaussians(origin, shape, h) for h in (8, 4))
    light = [(bump * profile).max((1, 2)) > least_light for bump in (coarse, fine)]
    wanted = np.concatenate(
        [coarse[light[0]], fine[light[1] & ((fine * shared).max((1, 2)) > 0.8)]]
    )
    assert len(wanted) > light[0].sum() > 9
    seen = np.zeros_like(wanted)
    for a, k in zip(strengths, prior.kernels(), strict=True):
        twice = np.convolve(k, k)
        for out, bump in zip(seen, wanted, strict=True):
            full, r = fftconvolve(bump, np.outer(twice, twice)), len(twice) // 2
            out += a**2 * full[r : r + shape[0], r : r + shape[1]]
    gram = np.tensordot(wanted, seen, ((1, 2), (1, 2)))
    scale = 1 / np.sqrt(np.diag(gram))
    np.testing.assert_allclose(
        bumps.images(), np.sqrt(profile) * seen * scale[:, None, None], atol=1e-7
    )
    expected = gram * scale[:, None] * scale
    np.testing.assert_allclose(bumps.precision, expected, atol=1e-9)
    # one number each: the same covariance of the pixels
    images = bumps.images().reshape(len(bumps), -1)
    pixels = [images, whitening_transform(bumps.precision) @ images]
    covariance = pixels[0].T @ np.linalg.pinv(bumps.precision, rcond=1e-8) @ pixels[0]
    largest = np.abs(covariance).max()
    np.testing.assert_allclose(pixels[1].T @ pixels[1], covariance, atol=1e-4 * largest)


@pytest.mark.parametrize("kind", ["galaxy", "given", "star"])
def test_slopes_are_finite_differences(kind):
    home, e = scenes.frame(), 1e-4
    position, box = np.array([13.3, 15.8]), (slice(3, 25), slice(4, 30))
    shape = {"galaxy": GalaxyProfile(home), "star": StarProfile(home, free=True)}.get(kind)
    theta = np.array([0.6, 0.2, -0.1, 1.4]) if kind == "galaxy" else np.zeros(2)
    if kind == "given":
        shape, theta = (
            FixedProfile(GalaxyProfile(home).draw(np.array([0.6, 0.2, -0.1, 1.4]), position)[0]),
            np.zeros(0),
        )
    drawn = shape.draw(theta, position)[0]
    profile = (drawn / drawn.max())[box]
    low = np.array([part.start for part in box])
    images, scatter, far = profile_modes(shape, theta, position, profile, low)
    assert len(images) == len(scatter) == {"galaxy": 8, "given": 4, "star": 2}[kind]
    for i, d in enumerate(e * np.eye(len(theta))):
        change = shape.draw(theta + d, position)[0] - shape.draw(theta - d, position)[0]
        np.testing.assert_allclose(images[i], change[box] / (2 * e) / drawn.max(), atol=1e-6)
    if kind == "galaxy":
        for i, d in enumerate(e * np.eye(2)):
            change = shape.draw(theta, position + d)[0] - shape.draw(theta, position - d)[0]
            np.testing.assert_allclose(
                images[4 + i], change[box] / (2 * e) / drawn.max(), atol=1e-6
            )
    if kind != "galaxy":
        assert not far.any()
    if kind != "star":
        np.testing.assert_allclose(images[-2:], [profile**2, profile**0.5])
        assert images[-4][5].sum() < 0 < images[-4][16].sum()  # moved to larger y: less light below


def test_slopes_of_moments_are_finite_differences():
    rng, light = np.random.default_rng(0), np.array([2.0, 3.0])
    origins = np.array([[3, 4], [5, 1]])
    morphs = [rng.random((7, 9)), rng.random((6, 8))]
    change = [rng.normal(size=m.shape) for m in morphs]

    sums = np.abs(rng.random((2, 6))) * [2, 10, 10, 100, 30, 100]
    more = rng.normal(size=(2, 6))

    def at(e):
        moved = [m + e * d for m, d in zip(morphs, change, strict=True)]
        parts = [Component(0, tuple(o), m, np.ones(1)) for o, m in zip(origins, moved, strict=True)]
        inside = [a * m.sum() for a, m in zip(light, moved, strict=True)]
        c, q = moments(parts, inside, sums + e * more)
        return np.array([*c, q[0, 0], q[1, 0], q[1, 1]])

    at_zero, by_change = (
        light @ [light_sums(m[None], o)[:, 0] + far for m, o, far in zip(images, origins, beyond)]
        for images, beyond in ((morphs, sums), (change, more))
    )
    found = moment_derivatives(at_zero) @ by_change
    np.testing.assert_allclose(found, (at(1e-5) - at(-1e-5)) / 2e-5, rtol=1e-6)


def test_what_lies_beyond_a_box():
    """Sums are those of the whole profile, wherever the box ends."""
    home, position = scenes.frame(), np.array([13.3, 15.8])
    shape, theta = GalaxyProfile(home), np.array([0.9, 0.2, -0.1, 0.5])
    whole = shape.draw(theta, position + 60, (150, 156))[0]
    whole /= whole.max()
    low = np.array([4, 6])
    box = whole[64:84, 66:86]
    _, _, far = profile_modes(shape, theta, position, box, low)
    y, x = (np.arange(n) - 60.0 for n in whole.shape)
    for k, (a, b) in enumerate(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
        wanted = (y**a @ whole @ x**b) - (y[64:84] ** a @ box @ x[66:86] ** b)
        if a + b < 2:
            assert far[k, 0] == pytest.approx(wanted, rel=0.25)
    assert far[0, 0] > 0.01 * box.sum()


def test_bumps_may_be_only_where_light_is_shared():
    y, x = np.indices((40, 30))
    profile = np.exp(-0.5 * ((y - 20) ** 2 + (x - 15) ** 2) / 6.0**2)
    given, (row, column) = (
        ((0, 0), profile, np.full(3, 0.05), MultiscalePrior().kernels()),
        (24, 16),
    )
    shared = (np.abs(y - row) < 5) & (np.abs(x - column) < 3)
    bumps = SmoothModes(*given, shared, all_over=False)
    rows, columns = bumps.sides
    at = np.column_stack([side.argmax(1) for side in (rows, columns)]) - (row, column)
    wide = (columns / columns.max(1, keepdims=True) > 0.1).sum(1) > 11
    assert 0 < wide.sum() < len(at) < len(SmoothModes(*given, shared)) / 2
    assert (np.abs(at) < (5 + 2, 3 + 2)).all()
    between = (y == 18) & (x == 14)
    assert not len(SmoothModes(*given, between, all_over=False))


def test_bumps_of_large_galaxies_are_wider():
    y, x = np.indices((400, 300))
    profile = np.exp(-0.5 * ((y - 200) ** 2 + (x - 150) ** 2) / 60.0**2)
    shared = np.ones(profile.shape, bool)
    bumps = SmoothModes((0, 0), profile, np.full(3, 0.05), MultiscalePrior().kernels(), shared)
    assert MAX_MODES / 8 < len(bumps) <= MAX_MODES


@pytest.mark.parametrize("more", [0, 1])
def test_bumps_are_no_more_than_they_may_be(more, monkeypatch):
    y, x = np.indices((40, 30))
    profile = np.exp(-0.5 * ((y - 20) ** 2 + (x - 15) ** 2) / 6.0**2)
    given = (0, 0), profile, np.full(3, 0.05), MultiscalePrior().kernels(), np.ones((40, 30), bool)
    n = len(SmoothModes(*given))
    monkeypatch.setattr(room, "MAX_MODES", n - more)
    assert (len(SmoothModes(*given)) == n) == (not more)
