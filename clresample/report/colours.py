"""Initial display of the sky's light: channels as colours, and the limits of the stretch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

KNEE_SIGMAS = 2.5  # [sigma] where the stretch turns from linear to logarithmic
BRIGHT_QUANTILE = 0.9995  # [1] quantile of the model's pixels that is shown as white
MIN_WHITE = 8.0  # [knees] white of a field in which nothing is bright
EMPTY = (52, 56, 66)  # colour of pixels without data


@dataclass(frozen=True, eq=False)
class Stretch:
    """Display stretch of an instrument: asinh, linear in the noise, logarithmic above.

    sigma (C,) [counts]: noise of a pixel of each channel
    chosen: channels shown together, one in grey, or three as blue, green, red
    balance (K,): factors of these that make the whole model white; white [balanced counts]
    whites (C,) [counts]: white of each channel by itself
    """

    sigma: np.ndarray
    chosen: tuple[int, ...]
    balance: np.ndarray
    white: float
    whites: np.ndarray

    @property
    def knee(self) -> float:
        """[balanced counts] where logarithms begin."""
        noise = self.balance * self.sigma[list(self.chosen)]
        return KNEE_SIGMAS * float(np.sqrt(np.mean(noise**2) / len(noise)))


def stretch_of(models, sigma) -> Stretch:
    """The Stretch of an instrument by a sample of its model.

    models (C, L) [counts]: pixels of the model; sigma (C,) [counts]: noise of a pixel
    """
    light = np.maximum(np.nan_to_num(models), 0)
    total = light.sum(axis=1) / np.maximum(sigma, np.finfo(float).tiny)
    chosen: tuple[int, ...] = (int(np.argmax(total)),)
    if len(total) >= 3:  # three neighbours, those of the most signal
        first = int(np.argmax(np.convolve(total, np.ones(3), "valid")))
        chosen = first, first + 1, first + 2
    sums = light[list(chosen)].sum(axis=1)
    balance = np.where(sums > 0, sums.mean() / np.where(sums > 0, sums, 1), 1.0)
    mean = (light[list(chosen)] * balance[:, None]).mean(axis=0)
    white, whites = 0.0, np.zeros(len(sigma))
    if mean.size:
        white = float(np.quantile(mean, BRIGHT_QUANTILE))
        whites = np.quantile(light, BRIGHT_QUANTILE, axis=1)
    whites = np.maximum(whites, MIN_WHITE * KNEE_SIGMAS * sigma)
    found = Stretch(sigma, chosen, balance, white, whites)
    return replace(found, white=max(white, MIN_WHITE * found.knee))
