"""Bands with too little of a component's light to determine its flux, taken as unobserved.

Where a band's image ends beside a source, noise on the few pixels that its wings reach would set
the flux: up to 3e5 times that of other bands for 1e-8 of the light. Such a band would then dominate
strengths and curvature of the source's structure, which count each band as if all of it was seen.
"""

from __future__ import annotations

import numpy as np


def unseen_spectra(looking, spectra) -> np.ndarray:
    """Selects spectra (k, C, n) of a solution (k, C, n) of the scenes rendered last.

    Selected are those of less than ComponentProfile.min_light of the light on pixels with weight,
    if that light would be below one sigma with a spectrum that is flat in units of the noise, the
    mean of all bands. A threshold of 0.1 sigma leaves fits of 240 in place of 30 iterations.

    looking: LinearisedScenes with the normal equations of that solution
    """
    ties, own = looking.ties, (looking.rows, looking.index[looking.at])
    power = np.einsum("kcii->kci", looking.normal)[..., :-1]
    value = spectra if ties is None else spectra[:, ties.first]
    power = power if ties is None else ties.total(power, axis=1)
    snr2 = 1 + (power * value**2).sum(axis=1, keepdims=True)  # of an undetected source one sigma
    unseen = (power > 0) & (power * snr2 < power.sum(axis=1, keepdims=True))
    if unseen.any():
        light, least = np.zeros(spectra.shape), np.zeros((len(spectra), 1, spectra.shape[2]))
        for sight in looking.sights:
            light[own[0], sight.channels, own[1]] = sight.light_on_pixels()
        shapes = [looking.components[i].shape for i in looking.at]
        least[own[0], 0, own[1]] = [shape.min_light * shape.light for shape in shapes]
        unseen &= (light if ties is None else ties.total(light, axis=1)) < least
    return unseen if ties is None else ties.spread(unseen, axis=1)
