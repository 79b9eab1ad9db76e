"""Errors of the fluxes of saturated stars, which follow from their wings by the PSF."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..inspection.star_psfs import StarPSFs


def core_errors(result, psf_error) -> np.ndarray:
    """Errors (S, C) [counts] of the fluxes of stars with PSFs of their own; 0 of other sources.

        psf_error |p - 2| flux,    p: power of the distance by which the light falls beside the core

    If a PSF's width grows by the fraction epsilon, its light there grows by (p - 2) epsilon.

    psf_error [1]: see Settings
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    positions = np.asarray(result.frame.positions_of(result.sources))
    for observation, channels in zip(result.observations, result.channel_slices(), strict=True):
        if not isinstance(observation.psf_field, StarPSFs):
            continue
        there = result.frame.grid.positions_in(observation.grid, *positions.T)
        for c in result.components:
            star = observation.psf_field.number_at(*there[c.source])
            if star is not None:
                flux = np.abs(c.spectrum[channels]) * c.morphology.sum()
                found[c.source, channels] += observation.psf_field.flux_error[star] * flux
    return psf_error * found


def with_core_errors(errors, cores):
    """Errors that include `core_errors` (S, C) [counts], independent between channels."""
    if not cores.any():
        return errors
    flux, colour, s = errors.flux.copy(), errors.colour.copy(), np.arange(len(cores))
    flux[:, s, s] += cores.T**2
    c = np.arange(cores.shape[1])
    colour[:, c, c] += cores**2
    return replace(errors, flux=flux, colour=colour)
