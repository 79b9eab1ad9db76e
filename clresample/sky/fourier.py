"""Angles and cos/sin tables of plane waves, as PSFs and operators need them."""

from __future__ import annotations

import math

import numpy as np

# Largest error of a wave of amplitude 1: at 3500 px it is 2e-12.
ROUNDING = 1e-10


def phases(frequencies, positions):
    """2 pi f u (F, U) [rad] for f (F,) [cycles/px], u (U,) [px], without whole cycles.

    Whole cycles are subtracted before the product with 2 pi, which would otherwise lose as many
    digits as they have.
    """
    cycles = np.multiply.outer(frequencies, positions)
    cycles -= np.rint(cycles)
    return 2 * np.pi * cycles


def uniform_waves(frequencies, first, step, n):
    """exp(2 pi i f u) (n, F) at equal distances, u = first + step k [px], f (F,) [cycles/px].

    They are products of the waves at every b-th position with those at the first b positions. This
    takes 2 sqrt(n) cosines and sines of each frequency instead of n, and rounds once more.
    """
    block = math.isqrt(max(n - 1, 0)) + 1
    fine, coarse = np.arange(block), block * np.arange(-(-n // block))
    positions = np.concatenate([step * fine, first + step * coarse])
    few = np.exp(1j * phases(positions, frequencies))
    return (few[block:, None] * few[:block]).reshape(-1, len(frequencies))[:n]


def is_mirror_symmetric(table) -> bool:
    """Returns True if a table of waves (2 H, n) is even in its cosines and odd in its sines.

    Cosines are the rows 2i, sines 2i + 1, about the middle of n positions; up to rounding in
    float64.
    """
    half = slice((table.shape[1] + 1) // 2)
    here, there = table[:, half], table[:, ::-1][:, half]
    even = np.abs(here[0::2] - there[0::2]).max(initial=0)
    odd = np.abs(here[1::2] + there[1::2]).max(initial=0)
    return bool(max(even, odd) <= ROUNDING)


def cos_sin_columns(angle):
    """Tables of waves: cos and sin of the angles (..., H) [rad] in columns 2i, 2i+1: (..., 2H)."""
    table = np.empty((*angle.shape, 2), angle.dtype)
    np.cos(angle, out=table[..., 0])
    np.sin(angle, out=table[..., 1])
    return table.reshape(*angle.shape[:-1], -1)
