"""Where the sources are: detection with `sep` on signal-to-noise images in the model frame.

Three searches, each adding what those before have not found:

1. every observation alone, the sharpest first, its channels added up (`signal.py`): there
   neighbours are best told apart
2. all observations together, under filters of several widths: there faint sources, large ones and
   those seen in few bands are reached (`signal.combined`)
3. what is left of the sharpest observation without the symmetric light of those found: neighbours
   on the flanks of brighter ones (`companions.py`)

Sources: sep, Barbary 2016 (JOSS 1, 58), after SExtractor, Bertin & Arnouts 1996 (A&AS 117, 393);
those of signal.py and companions.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..deblending.spectra import MODEL_ERROR
from ..sky.frame import Frame, model_frame
from ..sky.observation import Observation
from ..sky.sources import Extended
from .companions import (
    LEAST,
    LEAST_WIDE,
    centred,
    is_a_source,
    left_over,
    noise_of,
    top_near,
)
from .signal import SMALL_GALAXY, combined, signal_of

# [sigma] of the combined image: white noise reaches it once in two million independent pixels
THRESHOLD = 5.0
# [FWHM^2] least area of connected pixels above the threshold: smaller ones are not as wide as the
# PSF, but noise on top of light just below the threshold
MIN_AREA = 0.25
# [FWHM^2] the same of what is left beside brighter sources: its area above the threshold is what a
# noise that grows towards them leaves
MIN_AREA_BESIDE = 0.125
# sep's deblending: levels between a threshold and a peak, of equal ratio, and the part of an
# object's light that a branch must hold to be an object of its own. SExtractor's 32 levels and
# 0.005 lose the neighbours of bright galaxies, whose branch rises over few of the levels; a part
# under 0.001 takes clumps of large galaxies for objects.
N_LEVELS, MIN_CONTRAST = 256, 0.001
# of the wider PSF's FWHM: nearer to a source that is found, a peak counts as that source
SAME_SOURCE = 0.7
ALL = "all"  # the name of the combined image


@dataclass(frozen=True, eq=False)
class Detection:
    """Sources that `detect` or `detect_more` found, S of them, brightest peak first.

    sources (S,): Extended, at the pixel of their peak
    frame: Frame that their positions, pixels (y, x), belong to
    peaks (S,) [sigma]: signal to noise of each in the image that found it
    found_in (S,): name of that image: an observation's, or "all"
    image (Ny, Nx) [sigma]: signal to noise of all observations together, 0 where nothing was seen
    """

    sources: tuple[Extended, ...]
    frame: Frame
    peaks: np.ndarray
    found_in: tuple[str, ...]
    image: np.ndarray


def detect(observations, frame=None, *, threshold=THRESHOLD, scatters=None) -> Detection:
    """Find sources in all observations together, in each alone, and beside brighter ones.

    The sharpest image separates neighbours best, the combined one reaches the faintest sources. So
    the images are searched one after the other, the sharpest first and then all together under
    filters of several widths; a peak within 0.7 FWHM of a source that an earlier image found is
    that source again, the FWHM being that of the image's PSF. At last the sharpest image is
    searched without the symmetric light of what was found. Needs `sep` (the extra `detect`).

    observations: sequence of Observation, as `check_observations` takes them
    frame: Frame to search and to place the sources in; None = `model_frame(observations)`
    threshold [sigma]: least signal to noise of a peak. 5 is reached by white noise once in two
        million independent pixels of one image; lower thresholds find more noise
    scatters (n_observations, n_widths): of the observations' signal to noise where there is no
        source, which it is divided by; None = as `noise_scatter` finds them, so that each patch has
        its own
    returns Detection; its sources can be given to `deblend` with its frame

    Raises ValueError for a threshold that is not a positive number, and for observations that do
    not fit together; ImportError, with what to install, without `sep`.
    Source: see the head of this module.
    """
    frame = frame or model_frame(observations)
    return _search(observations, frame, threshold, [], scatters)


def noise_scatter(observation, frame) -> np.ndarray:
    """Scatter (n_widths,) of an observation's signal to noise where there is no source, at least 1.

    More than 1 is noise that the weights do not tell of, such as that of correlated pixels.

    observation: one; frame: Frame that it is searched in
    """
    return signal_of(observation, frame).scatters()


def detect_more(result, *, threshold=THRESHOLD) -> Detection:
    """Find sources in a fit's residuals: those too faint beside others to be found before it.

    The residuals are searched as `detect` does, but for neighbours on flanks. Where the model is
    bright its own errors are larger than the noise: there the variance is 1 / w + (0.15 model)^2.

    result: a fitted blend
    threshold [sigma]: as for `detect`
    returns Detection in the frame of the fit, of new sources only: a peak within 0.7 FWHM of one of
        the fit's sources is left out

    Raises ValueError and ImportError as `detect` does.
    """
    left = []
    for i, o in enumerate(result.observations):
        sky = result.sky[result.channel_slices()[i], None, None]
        error = MODEL_ERROR * (result.model(i) - sky)
        left.append(
            Observation(
                np.nan_to_num(result.residual(i)),
                o.psf,
                o.grid,
                weights=o.weights / (1 + o.weights * error**2),
                channels=o.channels,
                zero_points=o.zero_points,
                name=o.name,
            )
        )
    known = result.frame.place(result.sources)
    pixels = np.stack([*np.indices(result.frame.shape)], axis=-1)
    places = [footprint.locate(pixels) for footprint in result.footprints]
    return _search(left, result.frame, threshold, list(known), beside=False, places=places)


def _search(observations, frame, threshold, known, scatters=None, beside=True, places=None):
    """Detection in the observations, without the known positions (y, x) [model px].

    places: of the frame's pixels on each observation, see `signal_of`; None = by their grids
    """
    if not 0 < threshold < math.inf:
        raise ValueError(f"threshold must be a positive number of sigmas, not {threshold}")
    sep = _import_sep()
    at = places or [None] * len(observations)
    signals = [signal_of(o, frame, one) for o, one in zip(observations, at, strict=True)]
    if scatters is None:
        scatters = [signal.scatters() for signal in signals]
    signals = [one.over(scatter) for one, scatter in zip(signals, scatters, strict=True)]
    widths = np.array([_fwhm_px(o, frame) for o in observations])
    order = np.argsort(widths, kind="stable")
    everything, best = combined(signals)
    found = []  # position, peak, label

    def add(image, label, narrow, wide):
        before = known + [position for position, _, _ in found]
        new = _new_peaks(sep, image, threshold, MIN_AREA * narrow**2, before, SAME_SOURCE * wide)
        found.extend((position, peak, label) for position, peak in new)

    for i in order:
        add(signals[i].flat(), observations[i].label, widths[i], widths[i])
    add(best, ALL, widths.min(), widths.max())
    if beside and found:
        sharp = order[0]
        places = np.array([position for position, _, _ in found])
        scale = frame.grid.pixel_scale_arcsec
        for position, peak in _companions(
            sep, signals, sharp, everything, places, threshold, widths[sharp], scale
        ):
            found.append((position, peak, observations[sharp].label))
    found.sort(key=lambda one: -one[1])
    return Detection(
        sources=tuple(Extended(position_px=tuple(map(float, p))) for p, _, _ in found),
        frame=frame,
        peaks=np.array([peak for _, peak, _ in found]),
        found_in=tuple(label for _, _, label in found),
        image=everything,
    )


def _companions(sep, signals, sharp, everything, places, threshold, fwhm, scale):
    """Positions and heights of sources on the flanks of those at `places` (S, 2), in the sharpest
    observation, whose PSF has the width fwhm [px]; scale [arcsec]: of a pixel."""
    image, seen = signals[sharp].flat(), signals[sharp].n_seen > 0
    centres = np.array(
        [
            centred(image if image[tuple(p.astype(int))] > threshold else everything, p)
            for p in places
        ]
    )
    rest, model = left_over(image, seen, centres)
    wide, _ = left_over(signals[sharp].flat(SMALL_GALAXY), seen, centres)
    new = _new_peaks(
        sep,
        rest / noise_of(model),
        max(threshold, LEAST),
        MIN_AREA_BESIDE * fwhm**2,
        list(places),
        SAME_SOURCE * fwhm,
        own=False,
    )
    found: list = []
    for place, _ in new:
        at = place.astype(int)
        top, height = top_near(rest, at, round(fwhm / 2))
        # two peaks, one on either side of a top, are that one source
        if any(np.hypot(*(top - p)) <= SAME_SOURCE * fwhm for p, _ in found):
            continue
        if top_near(wide, at, round(fwhm))[1] < LEAST_WIDE:
            continue
        if is_a_source(at, height, model, image, signals, centres, fwhm, scale):
            found.append((top, height))
    return found


def _import_sep():
    try:
        import sep
    except ImportError as error:
        raise ImportError(
            "detection needs sep, which is not installed: pip install 'clresample[detect]'"
        ) from error
    return sep


def _fwhm_px(observation, frame):
    """Width [model px] of an observation's sharpest PSF."""
    scale = observation.grid.pixel_scale_arcsec / frame.grid.pixel_scale_arcsec
    return observation.psf.fwhm_px.min() * scale


def _new_peaks(sep, image, threshold, area, known, apart, own=True):
    """Positions (y, x) and heights of the objects in a signal-to-noise image, brightest first.

    area [px]: least of an object; known: positions (2,) of sources; objects whose peak is within
    `apart` [px] of one are left out, and (own) those that hold one: under a wide filter a pair of
    them is one object whose peak lies between
    """
    objects, segments = _objects(sep, image, threshold, area)
    places = np.array(known).reshape(-1, 2)
    at = np.clip(np.rint(places).astype(int), 0, np.array(image.shape) - 1)
    taken = set(segments[at[:, 0], at[:, 1]].tolist()) if own else set()
    found = []
    for i, (position, peak) in enumerate(objects, start=1):
        near = len(places) and np.hypot(*(places - position).T).min() <= apart
        if i not in taken and not near:
            found.append((position, peak))
    return sorted(found, key=lambda one: -one[1])


def _objects(sep, image, threshold, area):
    """sep's objects: (position (y, x), height) of each, and the number from 1 of that which holds a
    pixel (Ny, Nx), 0 = none."""
    if not image.max(initial=0) > threshold:  # as most residuals: sep takes 1 ms to say so
        return [], np.zeros(image.shape, np.int32)
    objects, segments = sep.extract(
        np.ascontiguousarray(image),
        threshold,
        minarea=max(1, int(area)),
        filter_kernel=None,
        deblend_nthresh=N_LEVELS,
        deblend_cont=MIN_CONTRAST,
        segmentation_map=True,
    )
    return [
        (np.array([o["ypeak"], o["xpeak"]], float), float(o["peak"])) for o in objects
    ], segments
