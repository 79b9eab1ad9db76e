"""Spectra of known morphologies: non-negative least squares of many problems at once."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgesv

# Relative error of a smooth profile's light in a pixel, because of galaxies' structure such as
# spiral arms or clumps. With larger values faint neighbours absorb less of that structure, and
# bright sources have less weight.
MODEL_ERROR = 0.15
# Added to the diagonal of the normal matrix, which is scaled to a diagonal of 1. Without it the
# matrix of two sources with equal profiles, such as two stars at one position, is singular; with it
# each gets half of their light. It changes the flux of an isolated source by this fraction; a
# larger value would share light between neighbours that the data can separate.
RIDGE = 1e-8
# [bytes] Matrices that are solved, or made, at a time, of one problem at least: those of a scene of
# 1000 components take 32 MB in four channels. Smaller portions take longer where there are many
# small scenes.
PORTION_BYTES = 1 << 25
# Largest number of exchanges of whole sets: problems of separable sources take 2 to 5. Those that
# still change are solved one by one, in some ms for each of 200 unknowns.
SPECTRUM_ITERATIONS = 10


def unit_diagonal(normal):
    """Scales normal matrices (..., n, n) to a unit diagonal and adds RIDGE.

    Returns them, their scales (..., n), and a mask (..., n): bool, not 0 beside the others.
    """
    size = np.sqrt(np.maximum(np.diagonal(normal, axis1=-2, axis2=-1), 0))
    seen = size > 1e-12 * size.max(axis=-1, keepdims=True, initial=0)
    scale = np.where(seen, size, 1)
    out = normal / scale[..., None] / scale[..., None, :]
    out *= (seen[..., None] & seen[..., None, :]) | np.eye(normal.shape[-1], dtype=bool)
    return add_diagonal(out, RIDGE + ~seen), scale, seen


def add_diagonal(matrix, values):
    """Adds values (..., n) to the diagonals of matrices (..., n, n), which are returned."""
    np.einsum("...ii->...i", matrix)[...] += values
    return matrix


def solve_in_place(matrix, right):
    """x (n,) of a symmetric matrix (n, n), which is overwritten. Raises LinAlgError without one."""
    _, _, x, info = dgesv(matrix.T, right, overwrite_a=True)
    if info:
        raise np.linalg.LinAlgError("the matrix is singular")
    return x


def solve_free(matrix, right, free):
    """x (..., n, r) of matrices (..., n, n) with the unknowns that are not free (..., n) at 0.

    right (..., n, r): 0 for these
    """
    both = free[..., :, None] & free[..., None, :]
    return np.linalg.solve(add_diagonal(np.where(both, matrix, 0), ~free), right)


def portions(n, n_bytes):
    """Slices of n items of `n_bytes` each that have PORTION_BYTES together, or one item."""
    step = max(1, PORTION_BYTES // max(n_bytes, 1))
    return [slice(first, min(first + step, n)) for first in range(0, n, step)]


def nnls_batch(normal, right):
    """x (M, n) >= 0 that minimises 1/2 x N x - x r; 0 where N is 0.

    normal N (M, n, n), right r (M, n)

    Block principal pivoting (Kim and Park 2011): sets of unknowns at 0 and off it are exchanged
    until both have the right signs, for all problems side by side. With many sources at one
    position this may cycle, in particular if rounding leaves N with negative eigenvalues.
    """
    out = np.empty(right.shape)
    for at in portions(len(normal), 8 * normal.shape[-1] ** 2):
        out[at] = _nnls(normal[at], right[at])
    return out


def _nnls(normal, right):
    """`nnls_batch` of all problems at once."""
    matrix, scale, seen = unit_diagonal(normal)
    right = np.where(seen, right / scale, 0)
    n_problems, n = right.shape
    off, x = np.ones((n_problems, n), bool), np.zeros((n_problems, n))
    rounding = 1e-10 * np.abs(right).max(axis=1, initial=0)[:, None]
    going = np.arange(n_problems)
    for _ in range(SPECTRUM_ITERATIONS):
        on = off[going]
        found = solve_free(matrix[going], (right[going] * on)[..., None], on)[..., 0]
        slope = np.einsum("mij,mj->mi", matrix[going], found) - right[going]
        wrong = np.where(on, found < 0, slope < -rounding[going])
        x[going] = np.where(on, found, 0)
        off[going] ^= wrong
        going = going[wrong.any(axis=1)]
        if not len(going):
            break
    for i in going:
        x[i] = _by_active_sets(matrix[i], right[i])
    return np.where(seen, np.maximum(x, 0) / scale, 0)


def _by_active_sets(matrix, right):
    """x (n,) of one problem with a unit diagonal, by Lawson and Hanson's method, which ends.

    Eigenvalues are at least RIDGE, as in `spectrum_covariance`.
    """
    from scipy.optimize import nnls

    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, RIDGE))
    images, data = root[:, None] * vectors.T, vectors.T @ right / root
    return nnls(images, data, maxiter=30 * len(right))[0]


def spectrum_covariance(normal):
    """Covariances (M, n, n); undetermined values have infinite variance and no covariance.

    With many sources at one position, rounding can leave `normal` with negative eigenvalues, and
    its inverse with negative or too small variances, below those with all other unknowns fixed. In
    that case eigenvalues are set to RIDGE at least.
    """
    out = np.empty(normal.shape)
    for at in portions(len(normal), 8 * normal.shape[-1] ** 2):
        out[at] = _inverses(normal[at])
    return out


def _inverses(normal):
    """`spectrum_covariance` of all matrices at once."""
    matrix, scale, seen = unit_diagonal(normal)
    out = np.linalg.inv(matrix)
    variance = np.diagonal(out, axis1=-2, axis2=-1)
    wrong = ~(variance > 0.99).all(axis=-1)  # they are at least 1 / (1 + RIDGE)
    if wrong.any():
        values, vectors = np.linalg.eigh(matrix[wrong])
        part = vectors / np.sqrt(np.maximum(values, RIDGE))[:, None, :]
        out[wrong] = part @ part.swapaxes(1, 2)
    out = out / scale[..., None] / scale[..., None, :]
    out *= seen[..., None] & seen[..., None, :]
    return add_diagonal(out, np.where(seen, 0, np.inf))
