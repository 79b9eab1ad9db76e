"""Angles and cos/sin tables of plane waves, as PSFs and operators need them."""

from __future__ import annotations

import numpy as np


def phases(frequencies, positions):
    """2 pi f u (F, U) [rad] for f (F,) [cycles/px], u (U,) [px], whole cycles taken off.

    Whole cycles are taken off before the product with 2 pi: with them, that product would round
    away as many digits as they have.
    """
    cycles = np.multiply.outer(frequencies, positions)
    cycles -= np.rint(cycles)
    return 2 * np.pi * cycles


def cos_sin_columns(angle):
    """Tables of waves: cos and sin of the angles (..., H) [rad] in columns 2i, 2i+1: (..., 2H)."""
    table = np.empty((*angle.shape, 2), angle.dtype)
    np.cos(angle, out=table[..., 0])
    np.sin(angle, out=table[..., 1])
    return table.reshape(*angle.shape[:-1], -1)
