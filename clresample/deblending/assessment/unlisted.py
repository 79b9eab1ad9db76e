"""Sources whose fluxes are wrong because of peaks that no source is listed for."""

from __future__ import annotations

import numpy as np

from ...sky.box import intersect_boxes
from ..inspection.image import InspectedImage, typical_sigma
from .misfit import MISFIT_FRACTION

# Smallest part of a peak's light in the model of a source that holds it.
HELD_PART = 0.25


def beside_unlisted_light(result) -> np.ndarray:
    """Selects sources (S,) whose models hold the light of a peak in `Result.unlisted`.

    They have grown towards it: they have over HELD_PART of the light that is observed there, and
    over MISFIT_FRACTION of their own. Sources on their way may have lost light to them, and are
    selected too: those at whose places they have over MISFIT_FRACTION of the light. Compared is
    that within half an FWHM of the PSF, of all channels of an observation.
    """
    found = np.zeros(len(result.sources), bool)
    every = np.ones_like(found)
    positions = result.frame.positions_of(result.sources) if result.unlisted else None
    for i in sorted({peak[0] for peak in result.unlisted}):
        peaks = [peak[1:] for peak in result.unlisted if peak[0] == i]
        light, observed, whole = _light_at(result, i, peaks, every)
        holding = ((light > HELD_PART * observed) & (light > MISFIT_FRACTION * whole)).any(axis=0)
        image = InspectedImage.of(result.observations[i], result.frame, positions, result.shifts[i])
        light, observed, _ = _light_at(result, i, image.places[image.inside], holding)
        found[image.inside] |= light.sum(axis=1) > MISFIT_FRACTION * observed[:, 0]
        found |= holding
    return found


def _light_at(result, i, places, chosen):
    """Light of models at places (n, 2) [px] of an image, what is observed there, and all of theirs.

    (n, S), (n, 1) and (S,) [sigma of a typical pixel], sums of the image's channels; 0 of models
    but those chosen (S,). At least their light is observed.
    """
    o, channels = result.observations[i], result.channel_slices()[i]
    unit, radius = typical_sigma(o.weights), np.median(o.psf.fwhm_px) / 2
    data = np.where(o.weights > 0, o.data - result.sky[channels, None, None], 0)
    shape, half = data.shape[1:], int(np.ceil(radius))
    lows = np.rint(places).astype(int).reshape(-1, 2) - half
    light, observed = np.zeros((len(lows), len(result.sources))), np.zeros((len(lows), 1))
    boxes = np.indices((2 * half + 1,) * 2)
    pairs = zip(lows, places, strict=True)
    near = [np.hypot(*(boxes + (low - at)[:, None, None])) <= radius for low, at in pairs]
    for k, low in enumerate(lows):
        here, there = intersect_boxes((0, 0), shape, low, near[k].shape)
        observed[k] = (data[:, *here] * near[k][*there]).sum((1, 2)) @ (1 / unit)
    whole = np.zeros(len(result.sources))
    for c, component in enumerate(result.components):
        spectrum, s = component.spectrum[channels] / unit, component.source
        if not chosen[s]:
            continue
        whole[s] += spectrum.sum() * component.morphology.sum()
        start, image = result.rendered[i].low[c], result.rendered[i].images[c]
        for k, low in enumerate(lows):
            here, there = intersect_boxes(start, image.shape[1:], low, near[k].shape)
            light[k, s] += spectrum @ (image[:, *here] * near[k][*there]).sum((1, 2))
    return light, np.maximum(observed, light.sum(axis=1, keepdims=True)), whole
