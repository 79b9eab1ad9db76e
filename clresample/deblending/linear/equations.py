"""Normal equations of all parameters of a group of scenes, from sums of the device."""

from __future__ import annotations

import numpy as np

from .spectra import RIDGE, add_diagonal, portions, solve_free
from .ties import without_level

# Largest number of parameters of a component; others are padded.
N_PARAMETERS = 4


def normal_equations(looking):
    """Normal matrices (k, P, P) and right sides (k, P) of Gauss-Newton steps; P = 4 n.

    Spectra and sky levels are eliminated. Call it after `render` with slopes and
    `compute_residuals`.
    """
    k, n, p, ties = len(looking.scenes), looking.n_most, N_PARAMETERS, looking.ties
    normal, right, tied = np.zeros((k, n, p, n, p)), np.zeros((k, n, p)), None
    levels = looking.of_level() if looking.fit_sky else None
    lit = looking.solution() > 0
    for sight, (table, on_device) in zip(looking.sights, looking.overlapping_pairs, strict=True):
        products = ImageProducts(looking, sight, table, on_device, p)
        products.add_parameters(normal, right)
        for part, channels in products.portions(k * (n + 1) * n * p * 8):
            own = None if levels is None else [x[:, channels] for x in levels]
            parts = products.with_spectra(part, own)
            if own is not None:
                parts = _without_levels(normal, right, *parts)
            parts = [*parts, lit[:, channels, :n]]
            if ties is None:
                _eliminate(normal, right, *parts)
                continue
            if tied is None:
                tied = [np.zeros((k, ties.n_bands, *x.shape[2:])) for x in parts]
            for total, x in zip(tied, parts, strict=True):
                np.add.at(total, (slice(None), ties.band[channels]), x)
    if tied is not None:
        _eliminate(normal, right, *tied[:3], tied[3] > 0)
    return normal.reshape(k, n * p, n * p), right.reshape(k, n * p)


class ImageProducts:
    """Products of the images of all components in one observation, a SlotObservation.

    table, on_device: of its overlapping pairs; p: number of slopes of each profile
    """

    def __init__(self, looking, sight, table, on_device, p=0):
        self._n, self._own, self._rows = looking.n_most, looking.index[looking.at], looking.rows
        self._k, self._p = len(looking.scenes), p
        self._gram, self._pull = sight.gram(on_device, 1 + p), sight.residual_products(1 + p)
        self._one, self._other = table[:, :2].T
        self._channels = sight.channels
        known = np.arange(p) < (looking.slots.n_images - 1)[:, None]  # (slots, p)
        a = looking.spectra[looking.at][:, sight.channels]
        self._slopes = a[..., None] * known[:, None]  # by which those of a profile are multiplied

    def portions(self, n_bytes):
        """Pairs of slices, of the observation's and of all channels, of `n_bytes` a channel."""
        start = self._channels.start
        for part in portions(self._gram.shape[1], n_bytes):
            yield part, slice(start + part.start, start + part.stop)

    def add_parameters(self, normal, right):
        """Adds the products of slopes to normal (k, n, p, n, p), with the residual to right."""
        (i, j), b = self._own[[self._one, self._other]], self._rows[self._one]
        given = self._slopes[self._one], self._slopes[self._other], self._gram[..., 1:, 1:]
        both, apart = np.einsum("xck,xcl,xckl->xkl", *given), self._one != self._other
        normal[b, i, :, j] += both
        normal[b[apart], j[apart], :, i[apart]] += both[apart].swapaxes(1, 2)
        right[self._rows, self._own] += (self._slopes * self._pull[:, :, 1:, 0]).sum(axis=1)

    def with_spectra(self, part, levels):
        """Products of the spectra of some of the observation's channels, a slice.

        With each other (k, c, n, n), with the parameters (k, c, n, n, p), with the residual
        (k, c, n). If levels (k, c) are given, their right sides and curvatures, a level is the last
        spectrum.
        """
        n, p, m = self._n, self._p, self._n + (levels is not None)
        gram, pull, slopes = self._gram[:, part], self._pull[:, part], self._slopes[:, part]
        size = self._k, gram.shape[1]
        inner, cross = np.zeros((*size, m, m)), np.zeros((*size, m, n, p))
        rest = np.zeros(inner.shape[:3])
        (i, j), c = self._own[[self._one, self._other]][..., None], np.arange(size[1])
        at = self._rows[self._one, None], c
        inner[*at, i, j] = inner[*at, j, i] = gram[..., 0, 0]
        cross[*at, i, j] = slopes[self._other] * gram[..., 0, 1:]
        cross[*at, j, i] = slopes[self._one] * gram[..., 1:, 0]
        at, own = (self._rows[:, None], c), self._own[:, None]
        rest[*at, own] = pull[:, :, 0, 0]
        if levels is not None:
            rest[..., n], inner[..., n, n] = levels
            inner[*at, own, n] = inner[*at, n, own] = pull[:, :, 0, 1]
            cross[*at, n, own] = slopes * pull[:, :, 1:, 1]
        return inner, cross, rest


def _without_levels(normal, right, inner, cross, rest):
    """The last three without the levels, the last spectra, which are eliminated from all.

    A level has thousands of times the curvature of a spectrum: a ridge relative to that would hold
    the spectra. The arguments are as in `_eliminate`; normal and right are changed.
    """
    gram, pull, share, value = without_level(inner, rest)
    k, c, m, n, p = cross.shape
    by_level, curvature = cross[:, :, -1].reshape(k, c, n * p), inner[..., -1:, -1]
    over = np.divide(by_level, curvature, where=curvature > 0, out=np.zeros_like(by_level))
    _subtract_product(normal, by_level, over)
    right -= np.einsum("kcip,kc->kip", cross[:, :, -1], value)
    return gram, cross[:, :, :-1] - share[..., None, None] * cross[:, :, -1:], pull


def _eliminate(normal, right, inner, cross, rest, lit):
    """Eliminates the spectra from the equations of the parameters, which are changed.

    normal (k, n, p, n, p), right (k, n, p): of the parameters; inner (k, C, m, m), rest (k, C, m):
    of the spectra, of which those `lit` (k, C, m) are free; cross (k, C, m, n, p): of both
    """
    k, n_channels, m, n, p = cross.shape
    cross, rest = cross.reshape(k, n_channels, m, n * p), rest * lit
    cross *= lit[..., None]
    power = np.einsum("kcii,kci->kc", inner, lit)
    solved = solve_free(add_diagonal(inner, RIDGE * power[..., None]), cross, lit)
    for c in range(n_channels):
        _subtract_product(normal, cross[:, c], solved[:, c])
    right -= np.einsum("kcmp,kcm->kp", solved, rest).reshape(right.shape)


def _subtract_product(normal, left, right):
    """Subtracts left^T right from normal (k, n, p, n, p); left, right (k, m, n p)."""
    size = left.shape[2]
    matrix = normal.reshape(len(normal), size, size)
    for rows in portions(size, 8 * len(normal) * size):
        matrix[:, rows] -= left[:, :, rows].swapaxes(1, 2) @ right
