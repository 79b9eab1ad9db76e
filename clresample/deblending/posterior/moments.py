"""Sums from which light, centroids and second moments follow, and the derivatives of these."""

from __future__ import annotations

import numpy as np

from ..linear.mode_images import sums_with


def light_sums(images, origin):
    """Sums (6, k) of images (k, ny, nx), ModeImages or array, times 1, y, x, y y, y x, x x.

    origin (2,) [frame px]: of their box; y and x [frame px]
    """
    # about the middle of the box, for images in float32
    middle = (np.array(images.shape[1:]) - 1) / 2
    y, x = np.indices(images.shape[1:]) - middle[:, None, None]
    sums = sums_with(images, np.stack([np.ones(y.shape), y, x, y * y, y * x, x * x]))
    (one, y, x, yy, yx, xx), (a, b) = sums.astype(np.float64), origin + middle
    yy, yx, xx = yy + 2 * a * y + a * a * one, yx + a * x + b * y + a * b * one, xx + 2 * b * x
    return np.array([one, y + a * one, x + b * one, yy, yx, xx + b * b * one])


def moment_derivatives(sums):
    """Derivatives (5, 6) of the moments (y, x, yy, yx, xx) of light by its sums (6,)."""
    total, (y, x, yy, yx, xx) = sums[0], sums[1:] / sums[0]
    by_sums = [
        [-y, 1, 0, 0, 0, 0],
        [-x, 0, 1, 0, 0, 0],
        [2 * y * y - yy, -2 * y, 0, 1, 0, 0],
        [2 * y * x - yx, -x, -y, 0, 1, 0],
        [2 * x * x - xx, 0, -2 * x, 0, 0, 1],
    ]
    return np.array(by_sums) / total
