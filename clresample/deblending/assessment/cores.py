"""Errors of fluxes beside stars, and of saturated stars, whose cores follow from wings."""

from __future__ import annotations

from functools import cache

import numpy as np

from ...sky.box import intersect_boxes
from ...sky.sources import PointSource
from ..inspection.star_psfs import StarPSFs
from ..start.star_weights import MIN_PSF_ERROR_SIGMA

# [1] Error of the power of the distance by which a saturated star's light is continued beyond the
# last ring in which it was measured. Under PSFs with Moffat wings it is 0.9 to 1.7 of the truth at
# 1.4 radii of that ring, and 0.9 to 2.3 at twice the radius.
EXTRAPOLATED = 1.0


def core_errors(result) -> np.ndarray:
    """Errors (S, C) [counts] of fluxes by the errors of stars' PSFs.

        psf_error |p - 2| flux,    p: power of the distance by which the light falls beside the core

    of saturated stars with a PSF of their own: if its width grows by the fraction epsilon, its
    light there grows by (p - 2) epsilon. Neighbours of all stars have those of `_neighbour_errors`.
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    owner = np.array([c.source for c in result.components], int)
    is_star = any(isinstance(result.sources[s], PointSource) for s in owner)
    if not is_star or not result.psf_error:
        return found
    for i, observation in enumerate(result.observations):
        field, channels = observation.psf_field, result.channel_slices()[i]
        model = cache(lambda s, i=i: _model(result, i, np.flatnonzero(owner == s)))
        for k, star, place in _stars(result, i):
            source = owner[k]
            if star is not None:
                component = result.components[k]
                flux = np.abs(component.spectrum[channels]) * component.morphology.sum()
                own = field.flux_error[star] * flux
                found[source, channels] = np.hypot(found[source, channels], own)
            others = np.unique(owner[owner != source])
            # wings that were measured do not follow from the width of a core
            is_measured = star is not None and not field.keeps_core[star]
            measured_px = field.measured_px[star] if is_measured else None
            errors = _neighbour_errors(result, i, k, others, model, place, measured_px)
            found[:, channels] = np.hypot(found[:, channels], errors)
    return result.psf_error * found


def star_variance(result, i) -> np.ndarray | None:
    """Variance (Co, My, Mx) [counts^2] of an observation by the errors of its stars' PSFs, or None.

        psf_error^2 sum over stars of L^2 + (r . grad L)^2

    as weights of the start have it: of light L at r from a star, of measured wings too, since a
    result that was read does not tell them.
    """
    stars = list(_stars(result, i)) if result.psf_error else []
    if not stars:
        return None
    found = np.zeros(result.footprints[i].used.shape)
    for k, _, place in stars:
        window, changes = _star_changes(result, i, k, place)
        found[:, *window] += result.psf_error**2 * sum(change**2 for change in changes)
    return found


def _stars(result, i):
    """Yields each star's component in observation i, its number in a StarPSFs or None, its place.

    The place (2,) [px] is that of the fit, with the shift of the observation.
    """
    observation, grid = result.observations[i], result.frame.grid
    for k, component in enumerate(result.components):
        source = result.sources[component.source]
        if not isinstance(source, PointSource):
            continue
        light = component.morphology / max(component.morphology.sum(), 1e-300)
        center = [(light * index).sum() for index in np.indices(light.shape)]
        at = np.add(component.origin, center) - result.shifts[i]
        star, field = None, observation.psf_field
        if isinstance(field, StarPSFs):
            (listed,) = grid.positions_in(observation.grid, *result.frame.positions_of([source]).T)
            star = field.number_at(*listed)
        yield k, star, grid.positions_in(observation.grid, *at)


def _star_changes(result, i, k, place):
    """Window (slices y, x) of a star's light L, and its changes by errors of its PSF.

    returns (window, [(Co, ny, nx) [counts], ...]): L itself, of a total that is off, and r . grad L
        of a width that is, unless `place` is None
    """
    own = result.rendered[i].window(k, margin=1)
    spectrum = np.abs(result.components[k].spectrum[result.channel_slices()[i]])
    changes = [spectrum[:, None, None] * result.rendered[i].within(k, own)]
    if place is not None:
        changes.append(_widening(changes[0], [np.mgrid[own][a] - place[a] for a in (0, 1)]))
    return own, changes


def _model(result, i, parts):
    """Window (slices y, x), model (Co, ny, nx) and flux (Co,) in observation i of some components.

    Those of all components together, of a brightness of 1 in channels without flux.
    """
    rendered, channels = result.rendered[i], result.channel_slices()[i]
    spectra = np.abs([result.components[j].spectrum[channels] for j in parts])
    spectra = np.where(spectra.any(axis=0), spectra, 1.0)
    flux = spectra.T @ [result.components[j].morphology.sum() for j in parts]
    window = rendered.window(*parts)
    images = (rendered.within(j, window) for j in parts)
    model = sum(a[:, None, None] * image for a, image in zip(spectra, images, strict=True))
    return window, model, flux


def _neighbour_errors(result, i, k, others, model_of, place, measured_px=None):
    """Flux errors (S, Co) [counts / psf_error] of other sources by light L of a star, component k.

        |sum_pixels w m (L, r . grad L)| / sum_pixels w m^2 flux
        1/w = sigma^2 + psf_error^2 [L^2 + (r . grad L)^2]

    in observation i, for the model m of a source with this flux, of any brightness. Unlike noise,
    the star's light is too bright by psf_error, and its PSF too wide, all over m.

    others (n,): numbers of the other sources; model_of: returns `_model` of one
    place (2,) [px]: of the star, from which r is; None leaves the width out
    measured_px (Co,): radius up to which the star's light was measured, or None. It does not follow
        from a width; beyond, it was extrapolated by a power of r that is known to EXTRAPOLATED
    """
    used, weights = result.footprints[i].used, result.observations[i].weights
    out = np.zeros((len(result.sources), len(weights)))
    own, changes = _star_changes(result, i, k, place if measured_px is None else None)
    if measured_px is not None:
        away = np.hypot(*(np.mgrid[own] - np.reshape(place, (2, 1, 1))))
        error = EXTRAPOLATED * (away / measured_px[:, None, None] - 1)
        changes[0] *= np.clip(error, result.psf_error, 1) / result.psf_error
    beside = np.where(used[:, *own], weights[:, *own], 0.0)
    lowered = 1 + beside * result.psf_error**2 * sum(change**2 for change in changes)
    if not lowered.max(initial=1.0) > 1 + MIN_PSF_ERROR_SIGMA**2:
        return out
    weights = np.where(used, weights, 0.0)
    weights[:, *own] /= lowered
    for s in others:
        window, model, flux = model_of(s)
        here, there = intersect_boxes(*_box(window), *_box(own))
        if not changes[0][:, *there].size:
            continue
        weighted = weights[:, *window] * model
        power = (weighted * model).sum((1, 2))
        sums = [(weighted[:, *here] * one[:, *there]).sum((1, 2)) for one in changes]
        right = np.linalg.norm(sums, axis=0) * flux
        out[s] = np.divide(right, power, out=np.zeros_like(right), where=power > 0)
    return out


def _widening(light, away):
    """r . grad L (Co, ny, nx) of light L, by differences of pixels; away: r (y, x), (ny, nx)."""
    axes = [(axis, r) for axis, r in zip((1, 2), away, strict=True) if light.shape[axis] > 1]
    return sum((r * np.gradient(light, axis=axis) for axis, r in axes), np.zeros_like(light))


def _box(window):
    """Origin and shape (2,) [px] of a window (slices y, x)."""
    return tuple(zip(*((part.start, part.stop - part.start) for part in window), strict=True))
