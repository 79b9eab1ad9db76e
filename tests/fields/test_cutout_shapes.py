"""Cutouts that fits are given: the pixels on their frame, of one shape wherever they lie."""

import numpy as np
import pytest

from clresample import PSF, Grid, NoiseCorrelation
from clresample.fields.blends.cutouts import SIDE_PX, fit_box
from clresample.fields.mosaic import ArrayPlane, Channel, Mosaic
from clresample.sky.box import Box, box_within

REFERENCE = Grid.flat((400, 400), 0.1)


def mosaic_of(grid, noise=None):
    psf = PSF.gaussian(1.5)
    zeros, ones = np.zeros(grid.shape), np.ones(grid.shape)
    return Mosaic.of_arrays("m", zeros, psf, grid, weights=ones, noise=noise)


def on_frame(mosaic, frame):
    """Pixels (n, 2) of a mosaic whose centres lie on a frame."""
    n, m = np.indices(mosaic.grid.shape)
    return np.argwhere(Box.of(frame.shape).contains(mosaic.grid.positions_in(frame, n, m)))


@pytest.mark.parametrize("angle", [0.0, 12.0, 45.0])
@pytest.mark.parametrize("scale", [0.1, 0.2, 0.137])
def test_boxes_hold_all_that_lies_on_the_frame_and_have_one_shape(angle, scale):
    side = round(90 / scale)
    mosaic = mosaic_of(Grid.flat((side, side), scale, angle_deg=angle, center_arcsec=(0.01, 0.03)))
    shapes = set()
    for corner in [(100, 100), (101, 133), (57, 220), (240, 31), (163, 164)]:
        frame = REFERENCE.cutout(*corner, (64, 96))
        box, inside = fit_box(mosaic, frame), on_frame(mosaic, frame)
        assert len(inside) and box.contains(inside).all()
        tight = inside.max(axis=0) - inside.min(axis=0) + 1
        assert (np.array(box.shape) - tight <= SIDE_PX + 1).all()
        shapes.add(box.shape)
    assert len(shapes) == 1 and not (np.array(shapes.pop()) % SIDE_PX).any()


def test_equal_pixels_are_cut_to_the_frame():
    mosaic = mosaic_of(REFERENCE)
    assert fit_box(mosaic, REFERENCE.cutout(30, 50, (64, 32))) == Box(30, 50, 94, 82)


def test_at_the_edge_boxes_take_more_on_the_other_side():
    mosaic = mosaic_of(REFERENCE)
    assert fit_box(mosaic, REFERENCE.cutout(-20, 380, (64, 32))) == Box(0, 368, 64, 400)
    assert fit_box(mosaic, REFERENCE.cutout(500, 0, (64, 32))).area == 0
    few = mosaic_of(Grid.flat((10, 400), 0.1))
    assert fit_box(few, REFERENCE.cutout(180, 0, (64, 32))).shape == (10, 32)


def test_correlated_noise_has_a_pixel_more():
    taps = np.outer([0.3, 1, 0.3], [0.3, 1, 0.3])
    mosaic = mosaic_of(REFERENCE, NoiseCorrelation(taps))
    assert fit_box(mosaic, REFERENCE.cutout(30, 50, (62, 30))) == Box(29, 49, 93, 81)


def test_what_has_no_centre_between_the_points_is_empty():
    whole = Box(0, 0, 50, 50)
    between = np.array([(3.2, 3.2), (3.8, 9.0)])
    assert box_within(between, 0, 4, whole).area == 0
    assert box_within(between + (0.5, 0), 0, 4, whole).shape == (4, 8)


def test_a_mask_that_channels_share_is_read_once():
    class Counted(ArrayPlane):
        n_reads = 0

        def read(self, box):
            Counted.n_reads += 1
            return super().read(box)

    grid, rng = Grid.flat((20, 30), 0.2), np.random.default_rng(0)
    shared, own = (Counted(rng.integers(0, 4, grid.shape)) for _ in range(2))
    ones = ArrayPlane(np.ones(grid.shape))
    given = [(shared, 1), (shared, 1), (shared, 2), (own, None), (None, None)]
    channels = tuple(
        Channel(f"c{i}", ones, ones, mask=mask, mask_value=value)
        for i, (mask, value) in enumerate(given)
    )
    box = Box(2, 3, 18, 30)
    seen = Mosaic("m", grid, channels, PSF.gaussian(1.0)).observation(box)
    assert Counted.n_reads == 3
    for weights, channel in zip(seen.weights, channels, strict=True):
        np.testing.assert_array_equal(weights, channel.weights(box))
