"""Channels that are exposures of one band: one spectrum value for all of them.

Every array over channels keeps all C of them. The units of tied channels are one flux density, so
that tied spectra are equal: x_c = y_b for all channels c of a band b. Equal values stay equal in
every solver if gradients of tied channels are replaced by their mean,

    (dL/dx)_c = 1/k_b sum_(c' in b) dL/dx_c',        k_b: channels of the band,

and curvatures likewise: inner products over the C values are then those of the B values y, and so
is each step. Linear equations are summed over the band and solved for y.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Ties:
    """Assignment of channels to bands.

    bands (C,): the number of each channel's band, counted by their first channels
    """

    bands: tuple[int, ...]

    @classmethod
    def of(cls, names) -> Ties | None:
        """The Ties of channels with these bands' names (C,); None where no two share one."""
        numbers = {name: i for i, name in enumerate(dict.fromkeys(names))}
        return None if len(numbers) == len(names) else cls(tuple(numbers[name] for name in names))

    @cached_property
    def band(self) -> np.ndarray:
        """`bands` as an array (C,)."""
        return np.array(self.bands)

    @property
    def n_bands(self) -> int:
        """B."""
        return max(self.bands) + 1

    @cached_property
    def first(self) -> np.ndarray:
        """The first channel (B,) of each band."""
        return np.array([self.bands.index(b) for b in range(self.n_bands)])

    @cached_property
    def count(self) -> np.ndarray:
        """The number (C,) of channels in each channel's band."""
        return np.bincount(self.band)[self.band]

    @cached_property
    def matrix(self) -> np.ndarray:
        """(C, B): 1 where a channel belongs to a band, else 0."""
        return (self.band[:, None] == np.arange(self.n_bands)).astype(float)

    def total(self, values, axis=-1) -> np.ndarray:
        """Sums over the channels of each band: `axis` has length C, and B in the result."""
        return np.moveaxis(np.moveaxis(np.asarray(values), axis, -1) @ self.matrix, -1, axis)

    def spread(self, values, axis=-1) -> np.ndarray:
        """Values of bands, of length B along `axis`, for all channels of each: C of them."""
        return np.take(values, self.band, axis=axis)

    def mean(self, values, axis=-1) -> np.ndarray:
        """For each channel the mean over its band."""
        summed = np.moveaxis(self.spread(self.total(values, axis), axis), axis, -1)
        return np.moveaxis(summed / self.count, -1, axis)


def band_equations(ties, normal, right, fit_sky):
    """Normal equations of spectra by band, the sky level of each channel eliminated.

    ties: Ties of the C channels, None if each has its own band

    normal (..., C, n + 1, n + 1), right (..., C, n + 1): of n spectra and the level, the last
    fit_sky: whether levels are unknown; else they are 0
    returns normal (..., B, n, n), right (..., B, n), and the levels' own: their coupling to the
        spectra (..., C, n) and right sides (..., C), both divided by their curvature
    """
    gram, pull, own, value = without_level(normal, right, fit_sky)
    if ties is None:
        return gram, pull, own, value
    return ties.total(gram, axis=-3), ties.total(pull, axis=-2), own, value


def without_level(normal, right, fit_sky=True):
    """Normal equations of spectra in each channel, its sky level eliminated.

    Arguments and results are those of `band_equations`, with C channels in place of bands. A level
    of no curvature is 0.
    """
    level, side = normal[..., -1, -1], normal[..., :-1, -1]
    free = (level > 0) & bool(fit_sky)
    over = np.divide(1, level, where=free, out=np.zeros_like(level))
    own, value = side * over[..., None], right[..., -1] * over
    gram = normal[..., :-1, :-1].copy()
    for c in range(gram.shape[-3]):  # the products of all channels would be as large as `normal`
        gram[..., c, :, :] -= own[..., c, :, None] * side[..., c, None, :]
    return gram, right[..., :-1] - side * value[..., None], own, value
