"""Recognises weights that leave out the photon noise of the sources' own light."""

from __future__ import annotations

import numpy as np

from ..inspection.pixel_noise import lag_correlation

# Channels that a message names. Then the rounds of weighted least squares for 1 / gain, from a
# variance without photon noise.
MAX_CHANNELS, N_ROUNDS = 6, 6
# Photon noise over the weights' own from which pixels are bright, and the smallest number of them.
MIN_PHOTON_NOISE, MIN_BRIGHT_PIXELS = 0.5, 100
# chi2 per bright pixel and correlation of neighbours, photon noise included, of noise: 0.97 to 1.07
# and -0.06 to 0.02 in Rubin's bands of simulated blends. Errors of a model are alike in neighbours,
# and grow with the square of its light.
CHI2_RANGE, MAX_CORRELATION = (0.8, 1.25), 0.15


def photon_noise_lines(result) -> list[str]:
    """A message if residuals are noise once the variance has the model's light over a gain."""
    pairs = zip(result.misfit.gains, result.channels, strict=True)
    named = [f"{gain:.2g} ({name})" for gain, name in pairs if np.isfinite(gain)]
    if not named:
        return []
    return [
        "but the noise grows with the sources' light as that of photons does, of which the weights "
        "have too little: the variance must have light / gain, with gains near "
        f"{', '.join(named[:MAX_CHANNELS])}"
    ]


def photon_gains(result, remainders):
    """Gains (C,) [1] of light whose photon noise the weights lack; NaN of channels without any.

    remainders: the Remainder of each observation
    """
    gains = []
    for i, (o, left) in enumerate(zip(result.observations, remainders, strict=True)):
        weights = o.whitened.weights
        sky = result.sky[result.channel_slices()[i], None, None]
        light = np.maximum(o.whiten(result.model(i) - sky), 0.0) * weights
        for c in range(len(light)):
            part = _missing_variance(left.residual[c] ** 2 / left.noise[c], light[c], left, c)
            stated = _stated_variance(weights[c], light[c]) if part > 0 else 0.0
            gains.append(1 / (part * left.noise[c] + stated) if part > 0 else np.nan)
    return np.array(gains)


def _stated_variance(weights, light):
    """1 / gain that weights (My, Mx) have already, by the rise of their variance with the light."""
    used = weights > 0
    variance, counts = 1 / weights[used], light[used] / weights[used]
    dark = np.median(variance[counts <= np.median(counts)])
    return max((counts * (variance - dark)).sum() / max((counts**2).sum(), 1e-300), 0.0)


def _missing_variance(squares, light, left, c):
    """1 / gain of a channel, 0 if its residuals are not those of photons.

    squares (My, Mx) [1]: of the residuals, in units of the noise; light (My, Mx) [1 / counts]:
        model over the weights' variance; left: its Remainder
    """
    used = left.used[c] & (left.owner[c] >= 0)
    x, y, part = light[used], squares[used] - 1, 0.0
    for _ in range(N_ROUNDS):
        q = x / (1 + part * x) ** 2
        part = max((q * y).sum() / max((q * x).sum(), 1e-300), 0.0)
    bright = used & (part * light > MIN_PHOTON_NOISE)
    if bright.sum() < MIN_BRIGHT_PIXELS:
        return 0.0
    residual = left.residual[c] / np.sqrt(left.noise[c] * (1 + part * light))
    chi2 = np.square(residual[bright]).mean()
    is_white = abs(lag_correlation(residual, bright, 1)) < MAX_CORRELATION
    return part if CHI2_RANGE[0] < chi2 < CHI2_RANGE[1] and is_white else 0.0
