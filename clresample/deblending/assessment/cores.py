"""Errors of fluxes beside saturated stars, and of these stars, whose cores follow from wings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..component_images import image_within, window_of
from ..inspection.star_psfs import StarPSFs


def core_errors(result, psf_error) -> np.ndarray:
    """Errors (S, C) [counts] of fluxes by the PSFs of their own that saturated stars have.

        psf_error |p - 2| flux,    p: power of the distance by which the light falls beside the core

    of the stars: if a PSF's width grows by the fraction epsilon, its light there grows by (p - 2)
    epsilon. Their neighbours have those of `_neighbour_errors`.

    psf_error [1]: see Settings
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    positions = np.asarray(result.frame.positions_of(result.sources))
    owner = np.array([c.source for c in result.components], int)
    for i, observation in enumerate(result.observations):
        field, channels = observation.psf_field, result.channel_slices()[i]
        if not isinstance(field, StarPSFs):
            continue
        there = result.frame.grid.positions_in(observation.grid, *positions.T)
        for k, c in enumerate(result.components):
            star = field.number_at(*there[c.source])
            if star is not None:
                flux = np.abs(c.spectrum[channels]) * c.morphology.sum()
                own = field.flux_error[star] * flux
                others = _neighbour_errors(result, i, k, owner, psf_error)
                found[:, channels] = np.hypot(found[:, channels], others)
                found[c.source, channels] = np.hypot(found[c.source, channels], own)
    return psf_error * found


def _neighbour_errors(result, i, k, owner, psf_error):
    """Flux errors (S, Co) [counts / psf_error] of other sources by light L of a star, component k.

        sum_pixels w m L / sum_pixels w m^2 flux,    1/w = sigma^2 + (psf_error L)^2

    in observation i, for the model m of a source with this flux, of any brightness: unlike noise,
    the star's light is too bright or too faint by psf_error all over m.
    """
    rendered, channels = result.rendered[i], result.channel_slices()[i]
    light = np.abs(result.components[k].spectrum[channels])[:, None, None] * rendered[k]
    weights = np.where(result.footprints[i].used, result.observations[i].weights, 0.0)
    weights = weights / (1 + weights * (psf_error * light) ** 2)
    out = np.zeros((len(result.sources), len(weights)))
    for s in np.unique(owner[owner != owner[k]]):
        parts = np.flatnonzero(owner == s)
        spectra = np.abs([result.components[j].spectrum[channels] for j in parts])
        spectra = np.where(spectra.any(axis=0), spectra, 1.0)
        sides = zip(*(window_of(rendered, j) for j in parts), strict=True)
        window = tuple(slice(min(s.start for s in w), max(s.stop for s in w)) for w in sides)
        images = (image_within(rendered, j, window) for j in parts)
        model = sum(a[:, None, None] * image for a, image in zip(spectra, images, strict=True))
        weighted = weights[:, *window] * model
        right, power = ((weighted * b).sum((1, 2)) for b in (light[:, *window], model))
        flux = spectra.T @ [result.components[j].morphology.sum() for j in parts]
        out[s] = np.divide(right * flux, power, out=np.zeros_like(right), where=power > 0)
    return out


def with_core_errors(errors, cores):
    """Errors that include `core_errors` (S, C) [counts], independent between channels."""
    if not cores.any():
        return errors
    flux, colour, s = errors.flux.copy(), errors.colour.copy(), np.arange(len(cores))
    flux[:, s, s] += cores.T**2
    c = np.arange(cores.shape[1])
    colour[:, c, c] += cores**2
    return replace(errors, flux=flux, colour=colour)
