"""Sources whose fluxes are wrong because of peaks that no source is listed for."""

from __future__ import annotations

import numpy as np

from ..inspection.image import InspectedImage, typical_sigma
from .misfit import MISFIT_FRACTION

# Smallest part of a peak's light in the model of a source that holds it.
HELD_PART = 0.25


def beside_unlisted_light(result) -> np.ndarray:
    """Selects sources (S,) whose models hold the light of a peak in `Result.unlisted`.

    They have grown towards it: it is over HELD_PART of the light there and over MISFIT_FRACTION of
    their own. Sources on their way may have lost light to them, and are selected too: those at
    whose places they have over MISFIT_FRACTION of the light. Compared is that within an FWHM of the
    PSF, of all channels of an observation.
    """
    found = np.zeros(len(result.sources), bool)
    positions = result.frame.positions_of(result.sources) if result.unlisted else None
    for i in sorted({peak[0] for peak in result.unlisted}):
        light, whole = _light_at(result, i, [peak[1:] for peak in result.unlisted if peak[0] == i])
        part = light / np.maximum(light.sum(axis=1, keepdims=True), 1e-300)
        holding = ((part > HELD_PART) & (light > MISFIT_FRACTION * whole)).any(axis=0)
        image = InspectedImage.of(result.observations[i], result.frame, positions, result.shifts[i])
        light, _ = _light_at(result, i, image.places[image.inside])
        found[image.inside] |= light[:, holding].sum(axis=1) > MISFIT_FRACTION * light.sum(axis=1)
        found |= holding
    return found


def _light_at(result, i, places):
    """Light (n, S) of the sources' models at places (n, 2) [px] of an image, and in all (S,).

    [sigma of a typical pixel], the sum of the image's channels.
    """
    observation, channels = result.observations[i], result.channel_slices()[i]
    pixels = np.indices(observation.data.shape[1:])[:, None]
    away = np.hypot(*(pixels - np.asarray(places).T[..., None, None]))
    near = away <= observation.psf.fwhm_px.max()
    at, whole = np.zeros((len(places), len(result.sources))), np.zeros(len(result.sources))
    for image, c in zip(result.rendered[i], result.components, strict=True):
        spectrum = c.spectrum[channels] / typical_sigma(observation.weights)
        at[:, c.source] += np.einsum("c,cyx,nyx->n", spectrum, image, near)
        whole[c.source] += spectrum.sum() * c.morphology.sum()
    return at, whole
