"""Simulated scenes made brighter or fainter as a whole, to fill bins of signal to noise evenly.

Magnitudes that are uniform leave few fluxes above a signal to noise of 300: of a hundred fluxes 6
in joint fits, 7 in Euclid's. How often these errors hold the truth would take thousands of scenes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .scenes import MODES

# Of all sources in all channels of a scene, each alone and with its shape known. Errors of a fit
# are larger: by up to a half for faint sources, twice to five times for bright ones.
MEDIAN_SNR = 3.0, 10000.0
BRIGHTEST_MAG = 18.0  # [mag] about where such exposures saturate


def evened(scene, mode):
    """The scene with all its light times one factor, the same noise, and the truth of that.

    The median of `signal_to_noise` is then log-uniform in MEDIAN_SNR, drawn by the scene's seed,
    but no source is brighter than BRIGHTEST_MAG in a band of the mode.
    """
    wanted = np.exp(np.random.default_rng((scene.seed, 1)).uniform(*np.log(MEDIAN_SNR)))
    brightest = min(getattr(scene, name).magnitudes.min() for name in MODES[mode])
    most = 10 ** (0.4 * (brightest - BRIGHTEST_MAG))
    return brightened(scene, min(wanted / np.median(signal_to_noise(scene, mode)), most))


def signal_to_noise(scene, mode):
    """Of every source alone, its shape known, in every channel of a mode: (S, C)."""
    images = [getattr(scene, name) for name in MODES[mode]]
    light = [np.linalg.norm(image.contributions, axis=(2, 3)) for image in images]
    sigma = [image.survey.noise_sigma for image in images]
    return np.concatenate([a / s for a, s in zip(light, sigma, strict=True)], axis=1)


def brightened(scene, factor):
    """The scene with all its light times a factor, the same noise, and the truth of that."""

    def scaled(image):
        return replace(
            image,
            data=image.data + (factor - 1) * image.contributions.sum(axis=0),
            contributions=factor * image.contributions,
            magnitudes=image.magnitudes - 2.5 * np.log10(factor),
            counts=factor * image.counts,
        )

    return replace(scene, euclid=scaled(scene.euclid), rubin=scaled(scene.rubin))
