"""Quality of a result's fit: chi2 of channels and sources, and their labels."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc

from ..deblending.assessment.status import misfitted_sources
from ..deblending.assessment.unlisted import beside_unlisted_light
from ..deblending.posterior.residuals import pixels_in_boxes
from ..deblending.posterior.sampling import undetermined
from ..deblending.result import Result
from ..sky.sources import PointSource
from ..sky.validation.checks import check_instance

# [px] from a pixel's centre to its corners
PIXEL_RADIUS = 0.5**0.5
# [radii of the core] Distance up to which light beside a masked core shows that it is saturated.
BESIDE = 4.0
# [sigma] Light of a pixel beside a saturated core is brighter: detectors saturate at 1e3 sigma.
SATURATED_SIGMAS = 20.0
# [1] Probability by which so many of the pixels within twice a core's radius are masked by chance,
# if masked pixels are as frequent as in the rest of the image: rows, columns, cosmic rays.
BY_CHANCE = 0.02


def summary(result) -> dict:
    """Summary of the fit of a whole blend, in plain values that JSON can hold.

    result: a fitted blend
    returns a dict: status, messages, seconds as in `Result`; n_sources, n_fitted (inside the
        frame), n_components, n_iterations, losses; chi2 {channel: per pixel with a weight on the
        frame, NaN without any}, n_pixels {channel: number of these pixels}, sky {channel} [counts],
        shifts {observation: (y, x)} [model px]; misfits, the numbers of the sources that
        are flagged MISFIT (`misfitted_sources`); good, True if the fit converged at a model that
        describes the data, and no source is a misfit or UNLISTED
    """
    check_instance("result", result, Result)
    chi2, n_pixels = channel_chi2(result)
    misfits = np.flatnonzero(misfitted_sources(result)).tolist()
    return {
        "status": str(result.status),
        "good": result.converged and not misfits and not beside_unlisted_light(result).any(),
        "misfits": misfits,
        "messages": list(result.messages),
        "n_sources": len(result.sources),
        "n_fitted": int(fitted_sources(result).sum()),
        "n_components": len(result.components),
        "n_iterations": max(len(result.losses) - 1, 0),
        "losses": [float(loss) for loss in result.losses],
        "chi2": chi2,
        "n_pixels": n_pixels,
        "sky": dict(zip(result.channels, map(float, result.sky), strict=True)),
        "shifts": {
            label: [float(s) for s in shift]
            for label, shift in zip(observation_labels(result), result.shifts, strict=True)
        },
        "seconds": {stage: float(t) for stage, t in result.seconds.items()},
    }


def channel_chi2(result) -> tuple[dict, dict]:
    """Chi2 per pixel with a weight on the frame, and the number of these pixels, by channel.

    NaN without such pixels.
    """
    chi2, n_pixels = {}, {}
    for i, (observation, footprint) in enumerate(
        zip(result.observations, result.footprints, strict=True)
    ):
        used = footprint.used
        terms = chi2_terms(result, i, used)
        for channel, one, where in zip(observation.channels, terms, used, strict=True):
            n_pixels[channel] = int(where.sum())
            chi2[channel] = float(one[where].mean()) if where.any() else float("nan")
    return chi2, n_pixels


def observation_labels(result) -> list[str]:
    """A name for each observation, unique: its own, numbered where it has none or shares it."""
    names = [o.name or "observation" for o in result.observations]
    return [
        name if names.count(name) == 1 and o.name else f"{name}{i}"
        for i, (name, o) in enumerate(zip(names, result.observations, strict=True))
    ]


def fitted_sources(result):
    """Selects sources (S,) with a component."""
    fitted = np.zeros(len(result.sources), dtype=bool)
    fitted[[c.source for c in result.components]] = True
    return fitted


def masked_cores(result, positions):
    """Sources (S,) bool whose core is masked in some channel, as it is where it is saturated.

    The core consists of the pixels within half of the PSF's FWHM of the position (S, 2)
    [model px], and the pixel at the position. The criterion is one pixel without weight for a point
    source, in a channel with enough of its light to determine a flux. For others it is half of the
    core, more masked pixels in and beside it than by chance, see BY_CHANCE, and a neighbouring
    pixel of over 20 sigma, since faint sources do not saturate.
    """
    found, lost = np.zeros(len(result.sources), dtype=bool), None
    for channels, footprint in zip(result.channel_slices(), result.footprints, strict=True):
        observation = footprint.observation
        masked = observation.weights == 0
        if not masked.any():
            continue
        radius = footprint.pixel_scale * np.maximum(observation.psf.fwhm_px / 2, PIXEL_RADIUS)
        for i in np.flatnonzero(fitted_sources(result) & ~found):
            distance = np.linalg.norm(footprint.positions - positions[i], axis=-1)
            core = distance <= radius[:, None, None]
            if not (masked & core).any():
                continue
            if isinstance(result.sources[i], PointSource):
                lost = undetermined(result) if lost is None else lost
                found[i] = (masked & core)[~lost[i, channels]].any()
                continue
            half = 2 * (masked & core).sum(axis=(1, 2)) >= core.sum(axis=(1, 2))
            half &= _chance(masked, distance <= 2 * radius[:, None, None]) < BY_CHANCE
            beside = ~masked & (distance <= BESIDE * radius[:, None, None])
            light = np.where(beside, observation.data * np.sqrt(observation.weights), 0)
            found[i] = (half & (light.max(axis=(1, 2)) > SATURATED_SIGMAS)).any()
    return found


def _chance(masked, near):
    """Probability (C,) of as many masked pixels (C, My, Mx) among those near by chance."""
    far, axes = ~near, (1, 2)
    part = (masked & far).sum(axis=axes) / np.maximum(far.sum(axis=axes), 1)
    n = np.maximum((masked & near).sum(axis=axes), 1)
    return bdtrc(n - 1, near.sum(axis=axes), part)


def chi2_terms(result, i_observation, used):
    """Weighted squared residuals (Co, My, Mx), 0 where not used."""
    o = result.observations[i_observation]
    if result.components:
        residual = o.data - result.model(i_observation)
    else:
        channels = result.channel_slices()[i_observation]
        residual = o.data - np.asarray(result.sky)[channels, None, None]
    return np.where(used, o.chi2_map(residual), 0.0)


def box_chi2(result, i_observation, footprint):
    """Chi2 per pixel (S,) on the pixels whose centre lies in a box of the source."""
    terms = chi2_terms(result, i_observation, footprint.used).sum(axis=0)
    counts = footprint.used.sum(axis=0)
    chi2 = np.full(len(result.sources), np.nan)
    for s, window, inside in pixels_in_boxes(result, i_observation, footprint.positions):
        n = counts[window][inside].sum()
        if n:
            chi2[s] = terms[window][inside].sum() / n
    return chi2
