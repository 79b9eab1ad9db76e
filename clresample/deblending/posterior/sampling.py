"""Draws from the posterior of a finished fit: components, and the fluxes of sources."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...sky.sources import PointSource
from ..linear.ties import Ties
from ..profiles import MIN_LIGHT, MIN_STAR_LIGHT


def drawn_components(result, rng):
    """One draw of all components, morphologies and spectra 0 or more; see `Result.sample`.

    Raises ValueError for results without draws.
    """
    morphs, spectra = _draws_of(result).draw(rng)
    return tuple(
        replace(
            c,
            morphology=np.where(c.morphology > 0, np.maximum(c.morphology + m, 0), c.morphology),
            spectrum=np.maximum(c.spectrum + a, 0),
        )
        for c, m, a in zip(result.components, morphs, spectra, strict=True)
    )


def drawn_fluxes(result, n, rng):
    """Fluxes (n, S, C) [counts] of n draws; see `Result.sample_fluxes`.

    Raises ValueError for results without draws.
    """
    draws = _draws_of(result)
    owner = np.array([c.source for c in result.components], int)
    spectra = np.array([c.spectrum for c in result.components])
    mean = result.errors.flux_correction.copy()
    for source, spectrum, sums in zip(owner, spectra, draws.sums, strict=True):
        mean[source] += spectrum * sums[0]
    found = np.tile(mean, (n, 1, 1))
    for one in found:
        np.add.at(one, owner, draws.draw_fluxes(spectra, rng))
        if draws.flux_changes is not None:
            one += draws.flux_changes.draw(len(one), rng)
    found[:, undetermined(result)] = np.nan
    return found


def _draws_of(result):
    """The PosteriorSampler of a result. Raises ValueError for one without it."""
    if result.draws is None:
        raise ValueError(
            "result has no posterior to draw from: fit with a MultiscalePrior and errors=True"
        )
    return result.draws


def undetermined(result) -> np.ndarray:
    """Fluxes (S, C) bool that no data determine: with too little light on pixels, or not fitted.

    Of each component with light MIN_LIGHT, MIN_STAR_LIGHT of stars, must be on pixels with weight,
    of any exposure of the band. The wings of a model do not determine the flux of what is beyond.
    """
    known = np.isfinite(np.diagonal(result.covariance, axis1=1, axis2=2))  # (C, n)
    lost = np.ones((len(result.sources), len(result.channels)), bool)
    owner = np.array([c.source for c in result.components], int)
    lost[owner] = False
    seen = light_on_pixels(result)
    for i, c in enumerate(result.components):
        star = isinstance(result.sources[c.source], PointSource)
        if c.morphology.any() or (
            result.errors is not None and result.errors.outside_box_moments[i, 0]
        ):
            lost[c.source] |= ~known[:, i] | (seen[i] < (MIN_STAR_LIGHT if star else MIN_LIGHT))
    return lost


def light_on_pixels(result) -> np.ndarray:
    """Fraction (n, C) of each component's light on pixels with weight, of all exposures of a band.

    Their fractions are added: two exposures that have all of it give 2.
    """
    seen = np.zeros((len(result.components), len(result.channels)))
    parts = zip(result.channel_slices(), result.rendered, result.footprints, strict=True)
    for channels, rendered, footprint in parts:
        for i, c in enumerate(result.components):
            image = rendered.images[i] * footprint.used[:, *rendered.window(i)]
            seen[i, channels] = image.sum((1, 2), dtype=np.float64) / max(c.morphology.sum(), 1e-30)
    ties = Ties.of([band for o in result.observations for band in o.bands])
    return seen if ties is None else ties.spread(ties.total(seen))
