"""Elliptical Sersic profiles fitted to images of galaxies, the paper's starting morphologies.

    S(x) = exp(-q^(1 / 2n) / 2),   q = (x - c)^T C^-1 (x - c)

n is the index; C is scaled so that n = 1/2 is a Gaussian of covariance C.  The PSF is part of the
image and so of the profile.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

# [px] half-width of the pixels around the centre that are fitted: five times a galaxy's usual size
REACH_PX = 30
# Gaussian sigma [px] and index where each fit starts
START_SIGMA_PX, START_INDEX = 3.5, 0.7
# Bounds of the index, from flatter than a Gaussian to steeper than an elliptical galaxy, and of the
# Gaussian sigma [px], from the model's PSF to two thirds of the pixels fitted
INDICES = (0.3, 6.0)
SIGMAS_PX = (0.8, 20.0)
# Bound of each shear component; with both there, 1 - g1^2 - g2^2 is negative and replaced
MAX_SHEAR, MIN_DETERMINANT = 0.9, 1e-3
# [px] how far the profile's centre may lie from the given one
SHIFT_PX = 5.0


def fit(image, position):
    """The Sersic profile (Ny, Nx) that is nearest to an image in least squares, its amplitude too.

    image (Ny, Nx): the galaxy alone; position (2,) [px]: its (y, x)
    """
    middle = np.round(position).astype(int)
    low = np.maximum(middle - REACH_PX, 0)
    high = np.minimum(middle + REACH_PX + 1, image.shape)
    target = image[low[0] : high[0], low[1] : high[1]]
    scale = np.linalg.norm(target)

    def residual(parameters):
        model = _profile(parameters, position - low, target.shape)
        amplitude = (model * target).sum() / (model**2).sum()
        return ((amplitude * model - target) / scale).ravel()

    start = [0, 0, np.log(START_SIGMA_PX), 0, 0, np.log(START_INDEX)]
    widest = [SHIFT_PX, SHIFT_PX, np.log(SIGMAS_PX[1]), MAX_SHEAR, MAX_SHEAR, np.log(INDICES[1])]
    least = [-SHIFT_PX, -SHIFT_PX, np.log(SIGMAS_PX[0]), -MAX_SHEAR, -MAX_SHEAR, np.log(INDICES[0])]
    found = least_squares(residual, start, bounds=(least, widest), xtol=1e-4, ftol=1e-6)
    return _profile(found.x, position, image.shape)


def _profile(parameters, position, shape):
    """Profile (Ny, Nx) for (y, x offset [px], ln sigma [px], shear 1, shear 2, ln index)."""
    y, x, log_sigma, g1, g2, log_index = parameters
    dy, dx = np.arange(shape[0]) - position[0] - y, np.arange(shape[1]) - position[1] - x
    # the square root of C^-1 is symmetric, of determinant 1 / sigma^2
    root = np.array([[1 + g1, g2], [g2, 1 - g1]]) / np.exp(log_sigma)
    root /= np.sqrt(max(1 - g1**2 - g2**2, MIN_DETERMINANT))
    u = root[0, 0] * dy[:, None] + root[0, 1] * dx
    v = root[1, 0] * dy[:, None] + root[1, 1] * dx
    return np.exp(-0.5 * (u**2 + v**2) ** (0.5 * np.exp(-log_index)))
