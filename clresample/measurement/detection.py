"""Detects sources with `sep` on signal-to-noise images in the model frame.

Three searches, each of which adds new sources:

1. every observation alone, the sharpest first, its channels added up (`signal_to_noise.py`), which
   separates neighbours best
2. all observations together, under filters of several widths (`combine_bands`), which detects
   faint sources, large ones and those bright in few bands
3. the sharpest observation minus the symmetric light of the sources so far (`companions.py`), which
   shows neighbours on the flanks of brighter sources; so do others of several channels, if these
   are of another colour

Sources: sep, Barbary 2016 (JOSS 1, 58), after SExtractor, Bertin & Arnouts 1996 (A&AS 117, 393);
those of signal_to_noise.py and companions.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..deblending.inspection.noisy_variance import prepared
from ..deblending.inspection.rays import without_rays
from ..deblending.inspection.star_psfs import StarPSFs
from ..deblending.linear.spectra import MODEL_ERROR
from ..deblending.result import Result
from ..drawing.display import ShownDetection
from ..sky.frame import Frame, model_frame
from ..sky.observation import Observation, as_observations, check_observations
from ..sky.sources import ExtendedSource, PointSource, Source
from ..sky.validation.checks import check_instance, check_number
from .clumps import bodies_of
from .companions import (
    LEVEL_FWHM,
    MIN_PEAK_SIGMA,
    MIN_WIDE,
    brightest_peak_near,
    is_a_source,
    local_level,
    parabolic_peak,
    residual_scatter,
    symmetric_residual,
)
from .constant_sky import search_without_sky
from .levels import level_of
from .peaks import import_sep, new_peaks
from .searched import SAME_SOURCE, Search
from .signal_to_noise import SMALL_GALAXY, combine_bands, signal_of
from .star_light import UNEVEN, peak_beside, remove_star_light, saturated_stars

# [sigma] of the combined image: white noise reaches it once in two million independent pixels
THRESHOLD = 5.0
# [FWHM^2] Smallest area above the threshold of a residual beside a brighter source. It is small
# because the noise grows towards that source.
MIN_AREA_BESIDE = 0.125
# [areas of the model's PSF] Area of a morphology, its sum over its peak, up to which a fit's source
# counts as a point. Of stars fitted as galaxies it was 1.1 to 2.3, of galaxies 6 and more. A star's
# PSF is known to some percent (UNEVEN): of 9 peaks left about each of two stars of signal to noise
# 5500 and 6300 none was a source
POINT_WIDTH = 2.5
# [sigma] Largest light of a star, removed before, at a neighbour of another source: the residual of
# more is not symmetric about a source on it. With 0 no neighbours are found as far as any light of
# a star is removed: a galaxy of signal to noise 236 was missed 144 pixels from one of 10,000.
MAX_STAR_LIGHT = 1.0
ALL = "all"  # the name of the combined image


@dataclass(frozen=True, eq=False, repr=False)
class Detection(ShownDetection):
    """Sources that `detect` or `detect_more` found, S of them, stars first, brightest peak first.

    sources (S,): first a free PointSource for each star with a saturated or masked core, see
        star_light.py, then ExtendedSource; those that may be pieces of one galaxy have its `group`
    frame: Frame that their positions, pixels (y, x), belong to
    peaks (S,) [sigma]: signal to noise of each in the image that found it
    found_in (S,): name of that image: an observation's, or "all"
    groups (S,): number of the large galaxy of which each may be a clump, see clumps.py; its own
        number if there is none
    image (Ny, Nx) [sigma]: signal to noise of all observations together, 0 if not observed
    hosts (S,): only from `detect_more`: number of the fit's source, a large galaxy, of which each
        may be a clump; -1 if there is none. None from `detect`
    """

    sources: tuple[Source, ...]
    frame: Frame
    peaks: np.ndarray
    found_in: tuple[str, ...]
    image: np.ndarray
    groups: np.ndarray
    hosts: np.ndarray | None = None


def detect(observations, frame=None, *, threshold=THRESHOLD, scatters=None) -> Detection:
    """Finds sources in all observations together, in each alone, and beside brighter ones.

    The sharpest image separates neighbours best, the combined one reaches the faintest sources. So
    the images are searched one after the other, the sharpest first and then all together under
    filters of several widths. A peak within 0.7 FWHM of the image's PSF of an earlier source is
    the same source. Finally the sharpest image is searched without the symmetric light of these
    sources, and others of several channels for some of another colour. Cosmic rays that one channel
    alone shows are masked and the light of stars with a saturated core is removed first. Needs
    `sep` (the extra `detect`).

    observations: sequence of Observation, see `check_observations`, or of astropy's NDData and
        CCDData that have a PSF
    frame: Frame to search, in whose pixels positions are; None = `model_frame(observations)`
    threshold [sigma]: smallest signal to noise of a peak. White noise reaches 5 once in two
        million independent pixels of one image; lower thresholds find more noise
    scatters (n_observations, n_widths): scatter of each observation's signal to noise without
        sources, by which it is divided; None = from `noise_scatter`, for this patch of sky, whose
        constant level is subtracted too, where pixels without a source certainly have one
    returns Detection; pass its sources to `deblend` with its frame

    Raises ValueError for a threshold that is not a positive number, and for observations that do
    not fit together; ImportError, with what to install, without `sep`.
    Source: see the head of this module.
    """
    observations = as_observations(observations)
    check_observations(observations)
    frame = model_frame(observations) if frame is None else check_instance("frame", frame, Frame)
    observations = without_rays(prepared(observations)[0], frame)

    def search(images):
        return _search(images, frame, threshold, [], scatters)

    if scatters is not None:
        return search(observations)
    return search_without_sky(observations, frame, search)


def check_threshold(threshold):
    """Raises ValueError unless a threshold [sigma] is a positive number."""
    check_number("threshold", threshold, "a positive number of sigmas", lambda x: 0 < x < math.inf)


def noise_scatter(observation, frame) -> np.ndarray:
    """Scatter (n_widths,) of an observation's signal to noise without sources, at least 1.

    It exceeds 1 if the weights underestimate the noise, for example of correlated pixels.

    observation: one; frame: Frame that it is searched in
    """
    return signal_of(prepared([observation])[0][0], frame).scatters()


def detect_more(result, *, threshold=THRESHOLD) -> Detection:
    """Finds sources in a fit's residuals that were too faint beside others before the fit.

    The residuals are searched as by `detect`, without the search for neighbours on flanks. Errors
    of a bright model exceed the noise, so the variance is 1 / w + (0.15 model)^2.

    result: a fitted blend
    threshold [sigma]: as for `detect`
    returns Detection in the frame of the fit, of new sources only: a peak within 0.7 FWHM of one of
        the fit's sources is left out

    Raises ValueError and ImportError as `detect` does.
    """
    check_instance("result", result, Result)
    left = []
    for i, o in enumerate(result.observations):
        sky = result.sky[result.channel_slices()[i], None, None]
        error = MODEL_ERROR * (result.model(i) - sky)
        left.append(_with_data(o, result.residual(i), o.weights / (1 + o.weights * error**2)))
    known = result.frame.positions_of(result.sources)
    pixels = np.stack([*np.indices(result.frame.shape)], axis=-1)
    places = [footprint.locate(pixels) for footprint in result.footprints]
    found = _search(left, result.frame, threshold, list(known), beside=False, places=places)
    found = _without_ghosts(result, found, places, threshold)
    if not found.sources:
        return replace(found, hosts=np.zeros(0, int))
    return _without_structure(result, found, known, places, threshold)


def _with_data(observation, data, weights):
    """An Observation of other data (C, Ny, Nx), 0 where they are NaN, with white noise."""
    return Observation(
        np.nan_to_num(data),
        observation.psf,
        observation.grid,
        weights=weights,
        channels=observation.channels,
        zero_points=observation.zero_points,
        name=observation.name,
    )


def _without_structure(result, found, known, places, threshold):
    """The Detection without peaks that are structure of a large galaxy of the model, see clumps.py.

    known (S, 2) [px]: of the fit's sources; places: of the frame's pixels on each observation
    """
    frame = result.frame
    sharp = int(np.argmin([_fwhm_px(o, frame) for o in result.observations]))
    o = result.observations[sharp]
    sky = result.sky[result.channel_slices()[sharp], None, None]
    light, rest = (
        signal_of(_with_data(o, image, o.weights), frame, places[sharp]).flat()
        for image in (result.model(sharp) - sky, result.residual(sharp))
    )
    inside = known[frame.contains(known)]
    scale = frame.grid.pixel_scale_arcsec
    bodies = bodies_of(light + rest, inside, _fwhm_px(o, frame), threshold, scale)
    kept, hosts = [], []
    for i, source in enumerate(found.sources):
        number = bodies.body_at(np.array(source.position_px))
        y, x = np.rint(source.position_px).astype(int)
        is_structure = is_member = False
        if number >= 0:
            body = bodies.bodies[number]
            is_structure, is_member = body.takes(rest[y, x], light[y, x])
        if not is_structure:
            kept.append(i)
            host = np.nanargmin(np.hypot(*(known - body.center).T)) if is_member else -1
            hosts.append(int(host))
    return replace(_chosen(found, kept), hosts=np.array(hosts, int))


def _without_ghosts(result, found, places, threshold):
    """The Detection without peaks that are the unevenness of a star's light, saturated or not.

    A saturated star's counts in all images, that of another one in the image that found a peak, in
    the sharpest for peaks of all together.
    """
    saturated = np.zeros(result.frame.shape)
    points, of_points = _point_sources(result), {}
    for i, o in enumerate(result.observations):
        own = isinstance(o.psf_field, StarPSFs) and not o.psf_field.keeps_core.all()
        sky = result.sky[result.channel_slices()[i], None, None]
        images = [result.model(i) - sky] if own else [result.source_model(k, i) for k in points]
        if not images:
            continue
        light = signal_of(_with_data(o, sum(images), o.weights), result.frame, places[i]).flat()
        if own:
            saturated = np.maximum(saturated, light)
        else:
            of_points[o.label] = light
    sharp = min(result.observations, key=lambda o: _fwhm_px(o, result.frame)).label
    none, kept = np.zeros(result.frame.shape), []
    for i, source in enumerate(found.sources):
        at = tuple(np.rint(source.position_px).astype(int))
        label = found.found_in[i] if found.found_in[i] in of_points else sharp
        light = max(saturated[at], of_points.get(label, none)[at])
        if found.peaks[i] > threshold * np.hypot(1, UNEVEN * light):
            kept.append(i)
    return _chosen(found, kept)


def _point_sources(result):
    """Numbers of a fit's sources whose morphologies are hardly wider than the model's PSF."""
    psf = result.frame.psf.images[0]
    area = POINT_WIDTH * psf.sum() / psf.max()
    wide = {c.source for c in result.components if c.morphology.sum() > area * c.morphology.max()}
    return [i for i in range(len(result.sources)) if i not in wide]


def _chosen(found, kept):
    """The Detection of some of its sources, each in a group of its own."""
    return Detection(
        sources=tuple(found.sources[i] for i in kept),
        frame=found.frame,
        peaks=found.peaks[kept],
        found_in=tuple(found.found_in[i] for i in kept),
        image=found.image,
        groups=np.arange(len(kept)),
    )


def _search(observations, frame, threshold, known, scatters=None, beside=True, places=None):
    """Detection in the observations, without the known positions (y, x) [model px].

    places: of the frame's pixels on each observation, see `signal_of`; None = by their grids
    """
    check_threshold(threshold)
    sep = import_sep()
    at = places or [None] * len(observations)
    pairs = zip(observations, at, strict=True)
    signals = [signal_of(o, frame, one, deficits=beside) for o, one in pairs]
    widths = np.array([_fwhm_px(o, frame) for o in observations])
    order = np.argsort(widths, kind="stable")
    scale = frame.grid.pixel_scale_arcsec
    stars = saturated_stars(observations, frame) if beside else []
    full = signals
    pairs = zip(signals, widths, strict=True)
    signals = [remove_star_light(signal, stars, width, scale) for signal, width in pairs]
    if scatters is None:
        scatters = [signal.scatters() for signal in signals]
    full, signals = (
        [one.divided_by(s) for one, s in zip(many, scatters, strict=True)]
        for many in (full, signals)
    )
    everything, _ = combine_bands(full)
    if beside:
        everything = everything - level_of(everything, everything != 0)[1]
    levelled, skies = signals, np.zeros((len(signals), 1))
    if beside:
        levelled, skies = zip(*(signal.levelled() for signal in signals), strict=True)
    _, best = combine_bands(levelled)
    sharp = order[0]
    found = Search(sep, threshold, known + [star.place for star in stars])
    found.add(levelled[sharp].flat(), observations[sharp].label, widths[sharp], widths[sharp])
    if beside:
        found.sort_out(signals[sharp].flat() - skies[sharp][0], widths[sharp], scale)
    for i in order[1:]:
        found.add(levelled[i].flat(), observations[i].label, widths[i], widths[i])
    found.add(best, ALL, widths.min(), widths.max())
    # of its neighbour's colour the sharpest image would show a source
    for i in order if beside else ():
        if not found.positions or (i != sharp and len(observations[i].channels) == 1):
            continue
        given = everything, np.array(found.positions), threshold, widths[i], scale
        new = _companions(sep, levelled, i, *given, coloured=i != sharp)
        image = signals[i].flat()
        removed = full[i].flat() - image
        places = [tuple(np.rint(position).astype(int)) for position, _ in new]
        new = [one for one, at in zip(new, places, strict=True) if removed[at] < MAX_STAR_LIGHT]
        found.add_companions(new, image, observations[i].label)
    order, groups = found.in_order()
    positions = [found.position_of(i) for i in order]
    points = [
        PointSource(position_px=tuple(map(float, star.place)), free_position=True) for star in stars
    ]
    heights = [peak_beside(everything, star) for star in stars]
    groups = groups + len(stars)
    counts = np.bincount(groups, minlength=1)
    galaxies = [
        ExtendedSource(position_px=position, group=int(group) if counts[group] > 1 else None)
        for position, group in zip(positions, groups, strict=True)
    ]
    return Detection(
        sources=(*points, *galaxies),
        frame=frame,
        peaks=np.array([*heights, *(found.peaks[i] for i in order)]),
        found_in=(*(ALL for _ in stars), *(found.labels[i] for i in order)),
        image=everything,
        groups=np.concatenate([np.arange(len(stars)), groups]),
    )


def _companions(sep, signals, one, everything, places, threshold, fwhm, scale, *, coloured=False):
    """Positions and heights of sources on the flanks of those at `places` (S, 2).

    They are found in observation number `one`, whose PSF has the width fwhm [px]; scale [arcsec]:
    of a pixel; coloured: see `is_a_source`
    """
    image, seen = signals[one].flat(), signals[one].measured
    centres = np.array(
        [
            parabolic_peak(image if image[tuple(p.astype(int))] > threshold else everything, p)
            for p in places
        ]
    )
    rest, model, lights = symmetric_residual(image, seen, centres)
    wide, *_ = symmetric_residual(signals[one].flat(SMALL_GALAXY), seen, centres)
    noise = residual_scatter(model)
    new = new_peaks(
        sep,
        rest / noise,
        max(threshold, MIN_PEAK_SIGMA),
        MIN_AREA_BESIDE * fwhm**2,
        fwhm,
        list(places),
        SAME_SOURCE * fwhm,
        own=False,
    )
    found: list = []
    for place, _ in new:
        at = place.astype(int)
        top, height = brightest_peak_near(rest, at, round(fwhm / 2))
        level = local_level(rest, at, round(LEVEL_FWHM * fwhm))
        if height - level < MIN_PEAK_SIGMA * noise[tuple(at)]:
            continue
        # two peaks on either side of a maximum are one source, as is what pixels as large as the
        # PSF leave beside a star's own maximum
        others = np.array([*centres, *(position for position, _ in found)])
        if np.hypot(*(others - top).T).min() <= SAME_SOURCE * fwhm:
            continue
        if brightest_peak_near(wide, at, round(fwhm))[1] < MIN_WIDE:
            continue
        given = model, lights, image, signals, centres, fwhm, scale
        if is_a_source(at, height, *given, coloured=coloured):
            found.append((top, height))
    return found


def _fwhm_px(observation, frame):
    """Width [model px] of an observation's sharpest PSF."""
    scale = observation.grid.pixel_scale_arcsec / frame.grid.pixel_scale_arcsec
    return observation.psf.fwhm_px.min() * scale
