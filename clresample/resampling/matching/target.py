"""Chooses the grid and PSF of matched images: those of the image with the widest PSF."""

from __future__ import annotations

import math

import numpy as np

from ...sky.grid import Grid
from ...sky.psf import PSF
from ...sky.wcs import local_axes


def widest(observations):
    """Numbers of the observation and band whose PSF has the largest area 1 / sum P^2."""
    widths = [
        o.psf.spacing * o.grid.pixel_scale_arcsec / np.sqrt((o.psf.images**2).sum(axis=(1, 2)))
        for o in observations
    ]
    i = int(np.argmax([w.max() for w in widths]))
    return i, int(np.argmax(widths[i]))


def local_matrix(grid_from: Grid, grid_to: Grid) -> np.ndarray:
    """Jacobian (2, 2) from pixels of one grid to those of another, in the middle of the first."""
    y, x = (np.array(grid_from.shape) - 1) / 2
    if grid_from.is_flat:
        steps = [[y - 0.5, x], [y + 0.5, x], [y, x - 0.5], [y, x + 0.5]]
        at = grid_from.positions_in(grid_to, *np.transpose(steps))
        return np.stack([at[1] - at[0], at[3] - at[2]], axis=1)
    # by the sky's axes, since the middle may lie where the other grid's projection has no place
    middle_to = grid_to.pixel(*grid_from.sky(y, x))
    if not np.isfinite(middle_to).all():
        middle_to = (np.array(grid_to.shape) - 1) / 2
    return np.linalg.solve(local_axes(grid_to, middle_to), local_axes(grid_from, (y, x)))


def psf_on(psf: PSF, grid_from: Grid, grid_to: Grid) -> PSF:
    """Resamples a PSF from one grid's pixels to another's by sinc interpolation.

    The samples lie along the other grid's axes, finely enough for all frequencies of the original:
    `spacing` is then not 1.
    """
    matrix = local_matrix(grid_to, grid_from)  # from pixels of grid_to to those of grid_from
    scale = math.sqrt(abs(np.linalg.det(matrix)))
    aligned = np.isclose(np.abs(matrix).min(axis=1), 0, atol=1e-9 * scale).all()
    spacing = psf.spacing / scale / (1 if aligned else math.sqrt(2))
    n_y, n_x = psf.images.shape[1:]
    reach = math.hypot(n_y, n_x) / 2 * psf.spacing / scale
    half = int(math.ceil(reach / spacing))
    offsets = np.arange(-half, half + 1) * spacing
    u = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1) @ matrix.T / psf.spacing
    found = []
    for image, center in zip(psf.images, psf.center, strict=True):
        at = u + center
        along_y = np.sinc(at[..., 0, None] - np.arange(n_y))
        along_x = np.sinc(at[..., 1, None] - np.arange(n_x))
        found.append(((along_y @ image) * along_x).sum(axis=-1))
    images = np.array(found)
    images /= images.sum(axis=(1, 2), keepdims=True)
    return PSF.restore(images, spacing=spacing, center=np.full((len(images), 2), float(half)))
