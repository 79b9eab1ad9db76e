"""Draws from the posterior of a finished fit: components, and the fluxes of sources."""

from __future__ import annotations

from dataclasses import replace

import numpy as np


def drawn_components(result, rng):
    """One draw of all components, morphologies and spectra 0 or more; see `Result.sample`.

    Raises ValueError for results without draws.
    """
    if result.draws is None:
        raise ValueError(
            "result has no posterior to draw from: fit with a MultiscalePrior and errors=True"
        )
    morphs, spectra = result.draws.draw(rng)
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
    shape = n, len(result.sources), len(result.channels)
    found, beyond = np.zeros(shape), np.zeros(len(result.components))
    if result.errors is not None:
        found += result.errors.flux_correction
        beyond = result.errors.outside_box_moments[:, 0]
    for one in found:
        for c, far in zip(drawn_components(result, rng), beyond, strict=True):
            one[c.source] += c.spectrum * (c.morphology.sum(dtype=np.float64) + far)
        if result.draws.flux_changes is not None:
            one += result.draws.flux_changes.draw(len(one), rng)
    found[:, undetermined(result)] = np.nan
    return found


def undetermined(result) -> np.ndarray:
    """Fluxes (S, C) bool that nothing determines: channels without data, sources not fitted.

    A component that is zero everywhere does not contribute to its source's flux.
    """
    known = np.isfinite(np.diagonal(result.covariance, axis1=1, axis2=2))  # (C, n)
    lost = np.ones((len(result.sources), len(result.channels)), bool)
    owner = np.array([c.source for c in result.components], int)
    lost[owner] = False
    for i, c in enumerate(result.components):
        if c.morphology.any() or (
            result.errors is not None and result.errors.outside_box_moments[i, 0]
        ):
            lost[c.source] |= ~known[:, i]
    return lost
