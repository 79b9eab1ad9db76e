"""Where the sources are: detection with `sep` on signal-to-noise images in the model frame.

For a point of unit flux at x the best linear estimate of one channel, the matched filter, is

    n(x) = [P1 * R^T w d](x),    v(x) = [P1 * R^T w](x) |P2|^2,    signal to noise = n / sqrt(v)

with R the operator from the model frame, P1 the model's PSF and P2 the observed one, w the weights
and d the data. R P1 is P2 at x: n is the sum of P2 w d over all observed pixels, wherever they lie,
and v its variance where the weights change little over the PSF. Channels are added as for a
spectrum of equal signal to noise in all of them, so that an instrument of coarse pixels counts as
much as a sharp one of its depth.

Sources: the matched filter, Zackay & Ofek 2017 (ApJ 836, 187); sep, Barbary 2016 (JOSS 1, 58),
after SExtractor, Bertin & Arnouts 1996 (A&AS 117, 393).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..deblending.spectra import MODEL_ERROR
from ..resampling.cache import cached_resampler
from ..sky.frame import Frame, model_frame
from ..sky.noise import sigma_below_zero
from ..sky.observation import Observation
from ..sky.sources import Extended
from .residuals import convolved

# [sigma] of the combined image: white noise reaches it once in two million independent pixels
THRESHOLD = 5.0
# [FWHM^2] least area of connected pixels above the threshold: smaller ones are not as wide as the
# PSF, but noise on top of light just below the threshold
MIN_AREA = 0.25
# sep's deblending: levels between a threshold and a peak, and the part of an object's light that a
# branch must hold to be an object of its own; both are SExtractor's defaults
N_LEVELS, MIN_CONTRAST = 32, 0.005
# of a channel's largest variance v: a point with less lies on pixels that are masked or not seen
LEAST_WEIGHT = 0.1
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


def detect(
    observations, frame=None, *, threshold=THRESHOLD, scatters=None, device=None
) -> Detection:
    """Find sources in all observations together, and in each alone.

    The sharpest image separates neighbours best, the combined one reaches the faintest sources. So
    the images are searched one after the other, the sharpest first and at last all together; a
    peak within 0.7 FWHM of a source that an earlier image found is that source again, the FWHM
    being that of the image's PSF. Needs `sep` (the extra `detect`).

    observations: sequence of Observation, as `check_observations` takes them
    frame: Frame to search and to place the sources in; None = `model_frame(observations)`
    threshold [sigma]: least signal to noise of a peak. 5 is reached by white noise once in two
        million independent pixels; lower thresholds find more noise
    scatters (n_observations,): of the observations' signal to noise where there is no source, which
        it is divided by; None = as `noise_scatter` finds them, so that each patch has its own
    device: as for `get_device`
    returns Detection; its sources can be given to `deblend` with its frame

    Raises ValueError for a threshold that is not a positive number, and for observations that do
    not fit together; ImportError, with what to install, without `sep`.
    Source: see the head of this module.
    """
    frame = frame or model_frame(observations)
    return _search(observations, frame, threshold, device, [], scatters)


def noise_scatter(observation, frame, *, device=None) -> float:
    """Scatter of an observation's signal to noise where there is no source, at least 1.

    More than 1 is noise that the weights do not tell of, such as that of correlated pixels.

    observation: one; frame: Frame that it is searched in; device: as for `get_device`
    """
    return _scatter(_signal_to_noise(observation, frame, device))


def detect_more(result, *, threshold=THRESHOLD, device=None) -> Detection:
    """Find sources in a fit's residuals: those too faint beside others to be found before it.

    The residuals are searched as `detect` does. Where the model is bright its own errors are larger
    than the noise: there the variance is 1 / w + (0.15 model)^2.

    result: a fitted blend
    threshold [sigma], device: as for `detect`
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
    return _search(left, result.frame, threshold, device, list(known))


def _search(observations, frame, threshold, device, known, scatters=None):
    """Detection in the observations, without the known positions (y, x) [model px]."""
    if not 0 < threshold < math.inf:
        raise ValueError(f"threshold must be a positive number of sigmas, not {threshold}")
    sep = _import_sep()
    images = [_signal_to_noise(o, frame, device) for o in observations]
    if scatters is None:
        scatters = [_scatter(image) for image in images]
    images = [image / scatter for image, scatter in zip(images, scatters, strict=True)]
    widths = np.array([_fwhm_px(o, frame) for o in observations])
    n_channels = np.array([len(o.channels) for o in observations])
    everything = np.einsum("o,oyx->yx", np.sqrt(n_channels / n_channels.sum()), images)
    order = np.argsort(widths, kind="stable")
    searched = [(images[i], widths[i], widths[i], observations[i].label) for i in order]
    if len(observations) > 1:
        searched.append((everything, widths.min(), widths.max(), ALL))
    found = []  # position, peak, label
    for image, narrow, wide, label in searched:
        before = known + [position for position, _, _ in found]
        for position, peak in _peaks(sep, image, threshold, MIN_AREA * narrow**2):
            if all(np.hypot(*(position - other)) > SAME_SOURCE * wide for other in before):
                found.append((position, peak, label))
    found.sort(key=lambda one: -one[1])
    return Detection(
        sources=tuple(Extended(position_px=tuple(map(float, p))) for p, _, _ in found),
        frame=frame,
        peaks=np.array([peak for _, peak, _ in found]),
        found_in=tuple(label for _, _, label in found),
        image=everything,
    )


def _import_sep():
    try:
        import sep
    except ImportError as error:
        raise ImportError(
            "detection needs sep, which is not installed: pip install 'clresample[detect]'"
        ) from error
    return sep


def _signal_to_noise(observation, frame, device):
    """One observation's channels together (Ny, Nx); of unit scatter in white noise alone."""
    observation = observation.white
    op = cached_resampler(frame, observation.grid, observation.psf, dtype=np.float32, device=device)
    weights = observation.weights * op.covered
    # in units of the noise, so that float32 holds data of any scale
    unit = np.sqrt(weights.max(axis=(1, 2), keepdims=True))
    unit[unit == 0] = 1
    weights = weights / unit**2
    spread = [
        convolved(image, frame.psf.images[0])
        for image in np.concatenate(
            [
                op.adjoint((weights * observation.data * unit).astype(np.float32)),
                op.adjoint(weights.astype(np.float32)),
            ]
        ).astype(np.float64)
    ]
    total, n_seen = np.zeros(frame.shape), np.zeros(frame.shape)
    psf = observation.psf
    area = (psf.images**2).sum(axis=(1, 2)) / psf.spacing**2
    for n, v, power in zip(spread, spread[len(spread) // 2 :], area):
        seen = v > LEAST_WEIGHT * v.max(initial=0)
        total[seen] += n[seen] / np.sqrt(v[seen] * power)
        n_seen += seen
    return total / np.sqrt(np.maximum(n_seen, 1))


def _scatter(image):
    """Scatter of a signal-to-noise image: that of its negative pixels, which are noise, at least
    1. Correlated noise has more."""
    return max(1.0, sigma_below_zero(image) or 1.0)


def _fwhm_px(observation, frame):
    """Width [model px] of an observation's sharpest PSF."""
    scale = observation.grid.pixel_scale_arcsec / frame.grid.pixel_scale_arcsec
    return observation.psf.fwhm_px.min() * scale


def _peaks(sep, image, threshold, area):
    """Positions (y, x) and heights of the objects in a signal-to-noise image, brightest first."""
    objects = sep.extract(
        np.ascontiguousarray(image),
        threshold,
        minarea=max(1, int(area)),
        filter_kernel=None,
        deblend_nthresh=N_LEVELS,
        deblend_cont=MIN_CONTRAST,
    )
    found = [(np.array([o["ypeak"], o["xpeak"]], float), float(o["peak"])) for o in objects]
    return sorted(found, key=lambda one: -one[1])
