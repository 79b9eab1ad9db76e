"""From counts to colours: the sky's light, and residuals in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

KNEE_SIGMAS = 2.5  # [sigma] where the stretch turns from linear to logarithmic
BRIGHT_QUANTILE = 0.9995  # of the model's pixels: shown as white
LEAST_WHITE = 8.0  # [knees] white of a field in which nothing is bright
# Shades of an image with noise: more would store the noise's own digits, which take space and are
# not seen. The noise of a pixel is some three of them wide.
NOISY_SHADES = 48
RESIDUAL_SIGMAS = 6.0  # at which a residual's colours end
RESIDUAL_SHADES = 41  # an odd number: the middle one is no residual
NO_DATA = 0  # number of the palettes' first colour
# Dark in the middle, so that the page does not flash when a layer is changed.
NEGATIVE, MIDDLE, POSITIVE = (88, 174, 255), (18, 20, 26), (255, 150, 64)
EMPTY = (52, 56, 66)


@dataclass(frozen=True, eq=False)
class Stretch:
    """How an instrument's light is shown: asinh, linear in the noise, logarithmic above.

    sigma (C,) [counts]: noise of a pixel of each channel
    chosen: channels shown, one in grey, or three as blue, green, red
    balance (K,): factors of these that make the whole model white; white [balanced counts]
    """

    sigma: np.ndarray
    chosen: tuple[int, ...]
    balance: np.ndarray
    white: float

    @property
    def knee(self) -> float:
        """[balanced counts] where logarithms begin."""
        noise = self.balance * self.sigma[list(self.chosen)]
        return KNEE_SIGMAS * float(np.sqrt(np.mean(noise**2) / len(noise)))

    def shown(self, image, noisy=True):
        """(Ny, Nx) or (Ny, Nx, 3) uint8 of an image (C, Ny, Nx) [counts]; NaN is EMPTY."""
        image = image[list(self.chosen)] * self.balance[:, None, None]
        empty = ~np.isfinite(image).all(axis=0)
        image = np.where(empty, 0, image)
        light, knee = image.mean(axis=0), self.knee
        level = np.arcsinh((light + knee) / knee) / np.arcsinh((self.white + knee) / knee)
        if len(image) == 1:
            grey = _shades(np.clip(level, 0, 1), noisy)
            grey[empty] = EMPTY[1]
            return grey
        # colours only where there is light: those of the noise are no colours of anything
        image = light + (image - light) * np.maximum(light, 0) / (np.maximum(light, 0) + knee)
        # one factor for all channels: colours survive
        colour = (image + knee) * (np.maximum(level, 0) / np.maximum(light + knee, knee / 4))
        colour = colour / np.maximum(1, colour.max(axis=0))
        out = _shades(np.moveaxis(np.clip(colour, 0, 1), 0, -1)[..., ::-1], noisy)
        out[empty] = EMPTY
        return out


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
    white = float(np.quantile(mean, BRIGHT_QUANTILE)) if mean.size else 0.0
    found = Stretch(sigma, chosen, balance, white)
    return Stretch(sigma, chosen, balance, max(white, LEAST_WHITE * found.knee))


def _shades(level, noisy):
    """0 ... 255 of 0 ... 1, of noisy images in NOISY_SHADES steps."""
    if not noisy:
        return np.rint(255 * level).astype(np.uint8)
    steps = np.rint((NOISY_SHADES - 1) * level)
    return np.rint(steps * (255 / (NOISY_SHADES - 1))).astype(np.uint8)


def residual_numbers(sigmas):
    """Numbers uint8 in the residuals' palette of an image [sigma]; NaN is NO_DATA."""
    half = (RESIDUAL_SHADES - 1) // 2
    steps = np.rint(np.clip(np.nan_to_num(sigmas) / RESIDUAL_SIGMAS, -1, 1) * half)
    return np.where(np.isfinite(sigmas), steps + half + 1, NO_DATA).astype(np.uint8)


def residual_palette():
    """(1 + RESIDUAL_SHADES, 3) uint8: no data, then from the most negative to the most positive."""
    at = np.linspace(-1, 1, RESIDUAL_SHADES)[:, None]
    end = np.where(at < 0, NEGATIVE, POSITIVE)
    colours = MIDDLE + abs(at) ** 0.8 * (end - np.array(MIDDLE))
    return np.rint(np.vstack([[EMPTY], colours])).astype(np.uint8)
