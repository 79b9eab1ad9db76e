"""All checks of a blend's observations before its fit: messages and masks."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from ...sky.psf_checks import LIMIT_TOLERANCE, limit_power
from ...sky.sources import is_open
from ..blend import Blend
from ..settings import AUTO, SMALL, FitSettings
from . import listing, shifted, spoilt
from .centroids import centroids
from .counts import count_lines
from .image import InspectedImage
from .levels import SkyLevel, sky_level
from .matched_widths import width_lines
from .noisy_variance import prepared
from .pixel_noise import noise_lines
from .star_psfs import replace_by_stars, with_star_psfs
from .stars import misfitting_widths, point_sources
from .tilt import tilt_lines

# A sky level is reported as left in or over-subtracted above this many of its errors, and above
# this fraction of a pixel's noise, which changes a flux measured on 100 pixels by its own error.
LEVEL_SIGMAS, LEVEL_PART = 4.0, 0.1
# The same for the light at the rim, which may come from wings: 4 errors of the flux in 100 pixels,
# and at least two errors of that light.
RIM_PART, RIM_SIGMAS = 0.4, 2.0
# A level that is uncertain because of wings is reported as possibly wrong above this many of its
# errors and this fraction of a pixel's noise: none of 400 clean simulated images reaches two
# thirds.
DOUBT_SIGMAS, DOUBT_PART = 1.5, 0.3
# Fraction of a pixel's noise by which a fitted level may differ from 0 where it does not certainly:
# where nearly all of the sky was subtracted ("small"), and in observations whose sky is not fitted
# while that of others is. In observations that are fitted for another channel it is LEVEL_PART.
SMALL_PART, HELD_PART = 0.05, 1e-3
# Fraction of a pixel's noise above which the error of a fitted sky level is reported: it changes a
# flux measured on 50 pixels by its own error.
UNSURE_PART = 0.15
# [FWHM], [px] Pixels nearer to a listed source are not masked as cosmic rays, because the true PSF
# may be narrower than the one passed.
CORE_FWHM, CORE_PX = 0.5, 1.5


class InputWarning(UserWarning):
    """A problem of fitted observations or sources that biases fluxes."""


def warn_of_many(problems):
    """Warns once of the problems of blends, a list of messages of each."""
    n = len(problems)
    warnings.warn(
        f"{n} blend{'s have' if n > 1 else ' has'} problems with observations or sources, such as: "
        f"{problems[0][0]}; see the messages of the results",
        InputWarning,
        stacklevel=3,
    )


@dataclass(frozen=True, eq=False)
class Inspection:
    """Results of the inspection of a blend.

    blend: the Blend to be fitted, spoilt pixels masked; the one inspected where there are none
    settings: FitSettings with fit_shifts and fit_sky decided
    shifts (n_observations, 2) [model px]: of the observations, from which a fit of them starts
    messages: a sentence for each problem
    levels: SkyLevel of each observation, that of a fit if the sky is fitted
    unlisted: peaks that no source is listed for, see Result
    """

    blend: Blend
    settings: FitSettings
    shifts: np.ndarray
    messages: list[str]
    levels: list[SkyLevel]
    unlisted: tuple


def inspect(blend, frame, positions, shifts, settings) -> Inspection:
    """The Inspection of a Blend with sources at positions (S, 2) [model px] of its Frame.

    shifts (n_observations, 2) [model px]: of the observations, as known; settings: FitSettings
    """
    near = np.flatnonzero(frame.contains(positions))
    sources = [blend.sources[i] for i in near]
    messages, levels, found, unlisted = _doubles(blend.sources, positions), [], [], []
    images: list[InspectedImage] = []
    auto, small = settings.fit_sky == AUTO, settings.fit_sky == SMALL
    free = not (auto or small) and bool(settings.fit_sky)
    fit_sky = False
    n_channels = np.zeros((3, len(near)), int)  # of wide cores, of own PSFs, of all
    seen, changes = prepared(blend.observations)
    for observation, shift, changed in zip(seen, shifts, changes, strict=True):
        image = InspectedImage.of(observation, frame, positions[near], shift)
        sky = sky_level(image)
        image = image.over(sky.level)
        bad, more = _spoilt(image)
        if bad.any():
            image = image.without(bad)
        wrong, dark = wrong_levels(image, sky)
        fitted = free or small or (auto and bool((wrong | dark).any()))
        image, wide, own = with_star_psfs(image, sources, fitted, free)
        n_channels += wide, own, image.inside * len(image.usable)
        # the wings of a star that fill the image make its sky level uncertain
        unknown = bool(wide.any())
        if unknown:
            sky = replace(sky, error=np.full_like(sky.error, np.inf))
            fitted, wrong, dark = free or small, np.zeros_like(wrong), np.zeros_like(dark)
        part = SMALL_PART if small else LEVEL_PART if fitted else HELD_PART
        expected = sky if free else sky.expected(wrong, dark, part * image.sigma)
        levels.append((sky, expected))
        fit_sky = fit_sky or fitted
        lines = changed + _unmeasured(image)
        if not unknown:
            about = tilt_lines(image, sky) or (
                _unsure_lines(image, sky)
                if free
                else _level_lines(image, sky, wrong | dark, expected, fitted)
            )
            lines += about + noise_lines(image, sky)
        lines += more + _coarse(observation.psf, observation.channels)
        found.append(centroids(image))
        peaks = listing.unlisted(image)
        unlisted += [(len(images), y, x) for _, y, x in peaks]
        lines += _missing(peaks) + _widths(image, sources, near)
        messages += [f"{observation.label}: {line}" for line in lines]
        images.append(image)
    messages += _offset(images, found)
    moved, lines = shifted.disagreements(images, found, settings.fit_shifts)
    there = images if moved is None else list(map(InspectedImage.moved, images, moved))
    lines += count_lines(there) + width_lines(there)
    move = moved is not None if settings.fit_shifts == AUTO else bool(settings.fit_shifts)
    observations = tuple(image.observation for image in images)
    if any(a is not b for a, b in zip(observations, blend.observations, strict=True)):
        blend = replace(blend, observations=observations)
    n_wide, n_own, n_all = n_channels
    listed_open = np.array([is_open(source) for source in sources], bool)
    is_point = point_sources(images, listed_open, settings.psf_error)
    stars, still = near[(n_wide > 0) | is_point], near[(n_own > 0) & (n_own == n_all)]
    if len(stars):
        blend = replace(blend, sources=replace_by_stars(blend.sources, stars, still))
    if moved is not None:
        shifts = shifts + moved
    settings = replace(settings, fit_shifts=move, fit_sky=fit_sky)
    of_fit = [pair[fit_sky] for pair in levels]
    return Inspection(blend, settings, shifts, messages + lines, of_fit, tuple(unlisted))


def _doubles(sources, positions):
    pairs = listing.doubles(sources, positions)
    if not pairs:
        return []
    some = ", ".join(f"{i} and {j}" for i, j in pairs[:5])
    return [
        f"sources lie within {listing.SAME_PLACE_PX:g} model pixel of each other: {some}; no image "
        "tells their fluxes apart; if they are one source listed twice, leave one out"
    ]


def _unmeasured(image):
    """A line on channels without any pixel to fit."""
    seen = image.usable.any(axis=(1, 2))
    pairs = zip(image.observation.channels, seen, strict=True)
    names = [name for name, one in pairs if not one]
    if not names:
        return []
    return [
        f"no pixel of {', '.join(names)} has a weight: nothing is measured there; check weights "
        "or variance for NaN, or leave the channel out"
    ]


def wrong_levels(image, sky):
    """Selects channels (C,) whose sky is certainly not zero.

    By their SkyLevel, and of others by their rim: light is positive, so the sky of a rim below zero
    is too dark.
    """
    part, error = sky.level / image.sigma, sky.error / image.sigma
    known = np.isfinite(error)
    wrong = known & (np.abs(part) > np.maximum(LEVEL_SIGMAS * error, LEVEL_PART))
    mean, total = _common_level(image, sky)
    if abs(mean) > max(LEVEL_SIGMAS * total, LEVEL_PART):
        wrong |= known & (part * mean > 0)
    rim, rim_error = sky.rim / image.sigma, sky.rim_error / image.sigma
    return wrong, ~wrong & (rim < -np.maximum(LEVEL_SIGMAS * rim_error, LEVEL_PART))


def _common_level(image, sky):
    """Mean of the known levels and its error [1], in units of the pixels' noise.

    The uncertainty from wings is common to all channels.
    """
    known = np.isfinite(sky.error)
    if not known.any():
        return 0.0, np.inf
    part, error, wings = (v[known] / image.sigma[known] for v in (sky.level, sky.error, sky.wings))
    own = np.maximum(error**2 - wings**2, 0).sum()
    return part.mean(), np.hypot(wings.mean(), np.sqrt(own) / len(part))


def _level_lines(image, sky, shown, expected, fitted):
    """Messages about a SkyLevel other than zero, and about light at the rim.

    shown (C,): bool, channels by `wrong_levels`; expected: SkyLevel of the fit; fitted: True if it
        is fitted
    """
    lines = []
    for chosen, what, cure in (
        (shown & (expected.level > 0), "sky is left in", "subtract it"),
        (shown & (expected.level < 0), "too much sky was subtracted", "add it back"),
    ):
        if chosen.any():
            lines.append(
                f"{what}: pixels without a source have the level "
                f"{_parts(image, expected.level, chosen)} a pixel; "
                + (
                    "a constant is fitted near this level, light from beyond the image included"
                    if fitted
                    else f"every flux includes its share of it; {cure}, or give fit_sky=True"
                )
            )
    rim, rim_error = sky.rim / image.sigma, sky.rim_error / image.sigma
    if lines or not np.isfinite(rim_error).all():
        return lines
    unsure = RIM_SIGMAS * rim_error.mean() / np.sqrt(len(rim))
    mean, total = _common_level(image, sky)
    doubt = abs(mean) > max(DOUBT_SIGMAS * total, DOUBT_PART) and (mean > 0 or rim.mean() < -unsure)
    if rim.mean() > RIM_PART + unsure:
        lines.append(
            "the pixels furthest from the sources are not dark: "
            f"{_parts(image, sky.rim, rim > 0)} a pixel; sky is left in, or wings of the sources "
            "end beyond the image, and fluxes include a part of it; give fit_sky=True or a larger "
            "image"
        )
    elif doubt:
        known = np.isfinite(sky.error)
        lines.append(
            "the sky's level is unsure, as the sources' wings reach all over the image: "
            f"{_parts(image, sky.level, known)} a pixel, +- "
            f"{(sky.error / image.sigma)[known].mean():.2g} sigma, and "
            "every flux includes its share of it; give fit_sky=True or a larger image"
        )
    return lines


def _unsure_lines(image, sky):
    """Message about a fitted sky whose SkyLevel is uncertain; none for a certain one."""
    seen = image.usable.any(axis=(1, 2))
    part, names = sky.error / image.sigma, image.observation.channels
    unsure = seen & (part > UNSURE_PART)
    if not unsure.any():
        return []
    some = ", ".join(
        f"{names[c]} +- {part[c]:.2g} sigma" if np.isfinite(part[c]) else f"{names[c]} not at all"
        for c in np.flatnonzero(unsure)
    )
    return [
        f"the sky is fitted, and pixels without a source hardly tell its level ({some} a pixel): "
        "fluxes of faint or wide sources and their errors depend on it; give a larger image, or "
        "subtract the sky that is known from one"
    ]


def _parts(image, level, chosen):
    """Levels (C,) [counts] of the channels chosen, in words."""
    return ", ".join(
        f"{name} {level[c] / image.sigma[c]:+.3g} sigma ({level[c]:+.4g} counts)"
        for c, name in enumerate(image.observation.channels)
        if chosen[c]
    )


def _spoilt(image):
    """Pixels (C, My, Mx) to mask, and messages about them."""
    names, lines = image.observation.channels, []
    full = spoilt.saturated(image)
    for c in np.flatnonzero(full.any(axis=(1, 2))):
        y, x = np.argwhere(full[c])[0]
        lines.append(
            f"channel {names[c]} is saturated: {full[c].sum()} pixels from (y, x) = ({y}, {x}) on, "
            "flat tops or above `saturation` and what touches them, are masked"
        )
    if full.any():
        image = image.without(full)
    sharp = spoilt.sharper_than_psf(image)
    if not sharp.any():
        return full, lines
    repeated, cores = sharp & (sharp.sum(axis=0) > 1), _cores(image)
    track = spoilt.tracks(sharp & ~repeated, cores)
    on_source = sharp & cores & ~track
    sharp, kept = sharp | track, (on_source | repeated) & ~track
    for c in np.flatnonzero(kept.any(axis=(1, 2))):
        y, x = np.argwhere(kept[c])[0]
        lines.append(
            f"channel {names[c]} has light sharper than its PSF: at (y, x) = ({y}, {x}), "
            f"{'on a source' if on_source[c].any() else 'in other channels too'}; the PSF is too "
            "wide, or a cosmic ray lies there; it is fitted as it is: mask it if it is none of the "
            "sky's"
        )
    rays = spoilt.grown(sharp & ~kept) & image.usable & ~kept
    for c in np.flatnonzero(rays.any(axis=(1, 2))):
        y, x = np.argwhere((sharp & ~kept)[c])[0]
        lines.append(
            f"channel {names[c]} has pixels sharper than its PSF, cosmic rays or hot pixels: "
            f"{(sharp & ~kept)[c].sum()}, the first at (y, x) = ({y}, {x}); they and those beside "
            "them are masked"
        )
    return full | rays, lines


def _cores(image):
    """Pixels (My, Mx) in the core of a listed source."""
    n_y, n_x = image.usable.shape[1:]
    reach = max(CORE_FWHM * image.width_px, CORE_PX)
    core = np.zeros((n_y, n_x), bool)
    for y, x in image.places[image.inside]:
        core |= np.hypot(np.arange(n_y)[:, None] - y, np.arange(n_x) - x) <= reach
    return core


def _coarse(psf, channels):
    """Message about a PSF whose samples are too coarse."""
    limit = limit_power(psf.images)
    names = [name for name, part in zip(channels, limit, strict=True) if part > LIMIT_TOLERANCE]
    if not names:
        return []
    return [
        f"the PSF of {', '.join(names)} is sampled too coarsely: {100 * limit.max():.0f} % of its "
        "transform is left at the samples' limit, and models are wrong by about as much; give an "
        "oversampled image with its `spacing`"
    ]


def _missing(peaks):
    if not peaks:
        return []
    some = ", ".join(f"({y}, {x}) at {value:.0f} sigma" for value, y, x in peaks[:3])
    return [
        f"there is light that no source is listed for: brightest at (y, x) = {some}; it goes to "
        "the neighbours; list it, or run detection"
    ]


def _offset(images, found):
    """Message about wrong positions in the sharpest image, from the Centroids in each."""
    i = shifted.sharpest(images)
    offset = listing.common_offset(found[i])
    if offset is None:
        return []
    (y, x), error = offset
    return [
        f"{images[i].observation.label}: the sources' light lies away from their positions: by "
        f"({y:+.2f}, {x:+.2f}) +- {error.max():.1g} pixels (y, x); these are wrong by as much (the "
        "centre of the first pixel is (0, 0), FITS counts from 1), or the WCS is"
    ]


def _widths(image, sources, numbers):
    """Message about a PSF whose width differs from that of the sources."""
    lines = []
    for i, c, part, error in misfitting_widths(image, sources):
        how = "narrower" if part < 0 else "wider"
        which = "too wide" if part < 0 else "too narrow, or the source is no star"
        lines.append(
            f"a source is {how} than the PSF of {image.observation.channels[c]}: source "
            f"{numbers[i]} by {100 * abs(part):.0f} +- {100 * error:.1g} %; the PSF is {which}"
        )
    return lines
