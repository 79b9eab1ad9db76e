"""Pixel values as compact text: quantised in growing steps, deflated, in base64.

    value = unit KNEE sinh(step n),     code = 0 for NaN, else 1 + (2 n if n >= 0, else -2 n - 1)

Codes are unsigned 16-bit, all low bytes before all high bytes; those of smooth images are replaced
by their differences from the row before. `page/pixels.js` reads them.
"""

from __future__ import annotations

import base64
import zlib

import numpy as np

KNEE = 5.0  # [unit] where steps begin to grow
# [1] Steps are KNEE step = 0.25 units wide near 0 and 5 % of bright residuals: finer ones store the
# noise's own digits. Those of models are 0.025 units and 0.5 %.
NOISY_STEP, SMOOTH_STEP = 0.05, 0.005
MAX_STEPS = 32766  # of either sign: beyond it codes have more than 16 bits
# Of zlib: noise does not get smaller with more, and 9 takes four times as long.
EFFORT = 6


def encode(image, unit, *, smooth=False) -> str:
    """Text of an image (Ny, Nx) [counts].

    unit [counts]: noise of a pixel; smooth: whether the image is a model, whose values vary slowly
    """
    codes = codes_of(np.asarray(image, np.float64) / unit, SMOOTH_STEP if smooth else NOISY_STEP)
    if smooth:
        codes[1:] -= codes[:-1].copy()
    low, high = (codes & 255).astype(np.uint8), (codes >> 8).astype(np.uint8)
    return as_text(zlib.compress(low.tobytes() + high.tobytes(), EFFORT))


def codes_of(values, step) -> np.ndarray:
    """Codes uint16 of values [unit]."""
    good = np.isfinite(values)
    n = np.rint(np.arcsinh(np.where(good, values, 0) / KNEE) / step)
    n = np.clip(n, -MAX_STEPS, MAX_STEPS).astype(np.int64)
    return np.where(good, 1 + np.where(n >= 0, 2 * n, -2 * n - 1), 0).astype(np.uint16)


def as_text(data) -> str:
    """Bytes as base64."""
    return base64.b64encode(data).decode("ascii")
