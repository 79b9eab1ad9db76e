"""Angles and cos/sin tables of plane waves, as PSFs and operators need them."""

from __future__ import annotations

import math

import numpy as np

# Largest error of a wave, of amplitude 1, that is made in float64.
ROUNDING = 1e-12


def phases(frequencies, positions):
    """2 pi f u (F, U) [rad] for f (F,) [cycles/px], u (U,) [px], whole cycles taken off.

    Whole cycles are taken off before the product with 2 pi: with them, that product would round
    away as many digits as they have.
    """
    cycles = np.multiply.outer(frequencies, positions)
    cycles -= np.rint(cycles)
    return 2 * np.pi * cycles


def even_waves(frequencies, first, step, n):
    """exp(2 pi i f u) (n, F) at equal distances, u = first + step k [px], f (F,) [cycles/px].

    Products of the waves at every b-th position with those of the b positions from 0 on: 2 sqrt(n)
    cosines and sines of each frequency instead of n, rounded once more.
    """
    block = math.isqrt(max(n - 1, 0)) + 1
    fine, coarse = np.arange(block), block * np.arange(-(-n // block))
    positions = np.concatenate([step * fine, first + step * coarse])
    few = np.exp(1j * phases(positions, frequencies))
    return (few[block:, None] * few[:block]).reshape(-1, len(frequencies))[:n]


def is_mirrored(table) -> bool:
    """Whether cosines, the rows 2i of a table of waves (2 H, n), are even about the middle of its n
    positions, and sines, the rows 2i + 1, odd; up to rounding in float64."""
    sign = np.where(np.arange(len(table)) % 2, -1.0, 1.0)
    mirrored = sign[:, None] * table[:, ::-1]
    return bool(np.abs(table - mirrored).max(initial=0) <= ROUNDING)


def cos_sin_columns(angle):
    """Tables of waves: cos and sin of the angles (..., H) [rad] in columns 2i, 2i+1: (..., 2H)."""
    table = np.empty((*angle.shape, 2), angle.dtype)
    np.cos(angle, out=table[..., 0])
    np.sin(angle, out=table[..., 1])
    return table.reshape(*angle.shape[:-1], -1)
