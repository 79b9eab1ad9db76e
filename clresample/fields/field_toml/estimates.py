"""Estimates from pixels the sky, noise and correlation that a mosaic lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...sky.box import Box
from ...sky.correlation import NoiseCorrelation
from ...sky.filled import filled_pixels
from ...sky.noise import noise_sigma
from ..background import find_background
from ..mosaic import ConstantPlane

# [px] Side of the region in a mosaic's middle from which its noise is estimated. A million pixels
# give the noise to 0.1 % and its correlation to 1 %, and are read in a second.
SAMPLE_PX = 1024


def subtract_background(mosaic, table):
    """The mosaic with the background surfaces to subtract."""
    if table.get("background", "none") == "none":
        return mosaic
    channels = [
        replace(c, background=find_background(c.data.read, c.valid, mosaic.grid.shape))
        for c in mosaic.channels
    ]
    return replace(mosaic, channels=tuple(channels))


def sample_box(grid):
    """The Box in a mosaic's middle from which its noise is estimated. grid: of the mosaic"""
    whole = Box.of(grid.shape)
    y, x = ((n - SAMPLE_PX) // 2 for n in whole.shape)
    return Box(y, x, y + SAMPLE_PX, x + SAMPLE_PX).intersection(whole)


def estimate_weights(mosaic, notes):
    """The mosaic with estimated weights where it has none."""
    channels, box = [], sample_box(mosaic.grid)
    for c in mosaic.channels:
        if c.weight is None:
            try:
                valid = c.valid(box)
                if c.background is not None:  # filled pixels are not of one value without it
                    image = np.asarray(c.data.read(box))
                    valid &= ~filled_pixels(image, valid & np.isfinite(image))
                sigma = noise_sigma(c.read(box), ~valid)
            except ValueError as error:
                raise ValueError(
                    f"channel {c.name}: {error}; give weight, variance or rms"
                ) from None
            notes.append(
                f"{mosaic.name}: noise of channel {c.name} estimated from the mosaic's middle: "
                f"sigma = {sigma:.4g} counts"
            )
            c = replace(c, weight=ConstantPlane(sigma**-2))
        channels.append(c)
    return replace(mosaic, channels=tuple(channels))


def estimate_noise_correlation(mosaic, table, notes):
    """The mosaic with the correlation of its noise, estimated once from its middle."""
    if table.get("noise", "white") != "estimate":
        return mosaic
    box, found = sample_box(mosaic.grid), []
    for c in mosaic.channels:
        try:
            found.append(NoiseCorrelation.estimate(c.read(box), c.weights(box)))
        except ValueError as error:
            raise ValueError(f"channel {c.name}: {error}") from None
        notes.append(
            f"{mosaic.name}: noise of channel {c.name}: {found[-1]!r}; for white noise, errors of "
            f"a source of sigma 2 px would be too small by {found[-1].error_factor(2.0):.2f}"
        )
    return replace(mosaic, noise=tuple(found))
