"""Boxes that follow the light: inside the frame, around the same centre, state and all."""

import numpy as np
import pytest
from helpers.scenes import SHAPE
from helpers.solver import changed, posed
from helpers.start import point_of

from clresample.paper.resize import GROW_PX, resize_boxes
from clresample.paper.solver.scene import AmsgradMoments

NOISE = np.ones(3)
WIDE = (48, 48)  # a frame with padding beyond SHAPE


def one(device, low, size, image):
    """A scene of one source, whose box cuts `image` (Ny, Nx), and its state, with moments."""
    part = slice(low[0], low[0] + size[0]), slice(low[1], low[1] + size[1])
    rng = np.random.default_rng(0)
    pair = posed(device, boxes=[(*low, *size)])
    return changed(
        *pair,
        shape=WIDE,
        spectra=np.full((1, 3), 1e3),
        profile=[image[part]],
        morph=[image[part].copy()],
        center=np.array([[15, 18]]) - low,
        latent=[rng.normal(size=size)],
        memory=AmsgradMoments([[rng.normal(size=size)] for _ in range(3)], np.zeros((3, 1, 3))),
    )


def gauss(sigma):
    y, x = np.indices(SHAPE) - np.array([15, 18])[:, None, None]
    return np.exp(-(y**2 + x**2) / (2 * sigma**2))


def check_moved(old, new, profile):
    """The same pixels hold the same state; new ones the profile, and none of it else."""
    (before, was), (after, now) = old, new
    (low,), (n_y, n_x) = after.origin, now.morph[0].shape
    assert (low >= 0).all() and (low + now.morph[0].shape <= SHAPE).all()
    np.testing.assert_array_equal(low + after.center[0], before.origin[0] + before.center[0])

    def on_frame(array, fill):
        out = fill.copy()
        (y, x), (h, w) = before.origin[0], array.shape
        out[y : y + h, x : x + w] = array
        return out[low[0] : low[0] + n_y, low[1] : low[1] + n_x]

    dark = np.zeros(SHAPE)
    pairs = [
        (was.morph[0], now.morph[0], profile),
        (before.profile[0], after.profile[0], profile),
        (was.latent[0], now.latent[0], dark),
    ]
    moments = zip(was.memory.morph, now.memory.morph, strict=True)
    pairs += [(a[0], b[0], dark) for a, b in moments]
    for a, b, fill in pairs:
        np.testing.assert_allclose(b, on_frame(a, fill), rtol=1e-14)
    np.testing.assert_array_equal(now.memory.spectra, was.memory.spectra)


def test_a_box_grows_where_light_reaches_its_edge(device):
    profile = gauss(6.0)
    pair = one(device, (11, 14), (9, 9), profile)
    new = resize_boxes(*pair, point_of(profile[None], (15, 18)), NOISE)
    assert new[1].morph[0].shape == (9 + 2 * GROW_PX, 9 + 2 * GROW_PX)
    check_moved(pair, new, profile)
    for _ in range(4):  # up to the frame, not to its padding
        new = resize_boxes(*new, point_of(profile[None], (15, 18)), NOISE)
    assert new[1].morph[0].shape == SHAPE
    check_moved(pair, new, profile)


def test_a_box_shrinks_where_there_is_none(device):
    profile = gauss(1.0)
    pair = one(device, (0, 0), SHAPE, profile)
    small = resize_boxes(*pair, point_of(profile[None], (15, 18)), NOISE)
    (morph,) = small[1].morph
    assert np.prod(morph.shape) < np.prod(SHAPE) / 3
    assert morph.sum() > 0.999 * profile.sum()
    check_moved(pair, small, profile)
    again = resize_boxes(*small, point_of(profile[None], (15, 18)), NOISE)
    assert again[0] is small[0] and again[1] is small[1]


def test_a_first_state_has_no_memory_to_move(device):
    pair = changed(*one(device, (11, 14), (9, 9), gauss(6.0)), memory=None)
    _, state = resize_boxes(*pair, point_of(gauss(6.0)[None], (15, 18)), NOISE)
    assert state.memory is None and state.morph[0].shape != (9, 9)


@pytest.mark.parametrize("fixed", [True, False])
def test_what_fits_stays(device, fixed):
    profile = gauss(6.0)
    scene, state = one(device, (11, 14), (9, 9), profile)
    scene, state = changed(scene, state, fixed=np.array([fixed]))
    assert (
        resize_boxes(scene, state, point_of(profile[None], (15, 18)), NOISE)[0] is scene
    ) == fixed
