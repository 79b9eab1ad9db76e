"""Boxes that follow the light: inside the frame, around the same centre, state and all."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import SHAPE, problem

from clresample.deblending.resize import GROW_PX, resized

NOISE = np.ones(3)
WIDE = (48, 48)  # a frame with padding beyond SHAPE


def one(device, low, size, image, **given):
    """A problem of one source, whose box cuts `image` (Ny, Nx), with moments."""
    part = slice(low[0], low[0] + size[0]), slice(low[1], low[1] + size[1])
    rng = np.random.default_rng(0)
    p = problem(device, boxes=[(*low, *size)], **given)
    return replace(
        p,
        shape=WIDE,
        spectra=np.full((1, 3), 1e3),
        base=[image[part]],
        morph=[image[part].copy()],
        center=np.array([[15, 18]]) - low,
        field=[rng.normal(size=size)],
        moments_morph=[[rng.normal(size=size)] for _ in range(3)],
    )


def gauss(sigma):
    y, x = np.indices(SHAPE) - np.array([15, 18])[:, None, None]
    return np.exp(-(y**2 + x**2) / (2 * sigma**2))


def check_moved(old, new, base):
    """The same pixels hold the same state; new ones the profile, and none of it else."""
    (low,), (n_y, n_x) = new.origin, new.morph[0].shape
    assert (low >= 0).all() and (low + new.morph[0].shape <= SHAPE).all()
    np.testing.assert_array_equal(low + new.center[0], old.origin[0] + old.center[0])

    def on_frame(p, array, fill):
        out = fill.copy()
        (y, x), (h, w) = p.origin[0], array.shape
        out[y : y + h, x : x + w] = array
        return out[low[0] : low[0] + n_y, low[1] : low[1] + n_x]

    dark = np.zeros(SHAPE)
    pairs = [
        (old.morph[0], new.morph[0], base),
        (old.base[0], new.base[0], base),
        (old.field[0], new.field[0], dark),
    ]
    pairs += [(a[0], b[0], dark) for a, b in zip(old.moments_morph, new.moments_morph, strict=True)]
    for before, after, fill in pairs:
        np.testing.assert_array_equal(after, on_frame(old, before, fill))


def test_a_box_grows_where_light_reaches_its_edge(device):
    base = gauss(6.0)
    p = one(device, (11, 14), (9, 9), base)
    first = resized(p, base[None], NOISE)
    assert first.morph[0].shape == (9 + 2 * GROW_PX, 9 + 2 * GROW_PX)
    check_moved(p, first, base)
    for _ in range(4):  # up to the frame, not to its padding
        first = resized(first, base[None], NOISE)
    assert first.morph[0].shape == SHAPE
    check_moved(p, first, base)


def test_a_box_shrinks_where_there_is_none(device):
    base = gauss(1.0)
    p = one(device, (0, 0), SHAPE, base)
    small = resized(p, base[None], NOISE)
    assert np.prod(small.morph[0].shape) < np.prod(SHAPE) / 3
    assert small.morph[0].sum() > 0.999 * base.sum()
    check_moved(p, small, base)
    again = resized(small, base[None], NOISE)
    assert again is small


@pytest.mark.parametrize("fixed", [True, False])
def test_what_fits_stays(device, fixed):
    base = gauss(6.0)
    p = one(device, (11, 14), (9, 9), base)
    p = replace(p, fixed=np.array([fixed]))
    assert (resized(p, base[None], NOISE) is p) == fixed
