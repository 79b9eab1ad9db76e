"""Measures PSF images: width, core, light beyond the edge; and warns of them."""

from __future__ import annotations

import math

import numpy as np

# [samples] half of what confusing the centre n/2 with (n-1)/2 gives, well above centroid errors
CORE_TOLERANCE = 0.25
# Fraction of the light beyond the image's edge (`light_beyond_edge`) from which a warning is
# issued; good HST and HSC images have 2 to 5 %.
EDGE_TOLERANCE = 0.05
# The same fraction from which an image is refused: a uniform image has 1.6.
EDGE_REFUSED = 0.5


# Fraction of a PSF's transform at the frequency limit of its samples from which the sampling is too
# coarse. About the same fraction of a rendered image is wrong, because light beyond the limit is
# aliased. Good PSF images with noise have one percent; a Gaussian of sigma 0.8 px has 2.7 %.
LIMIT_TOLERANCE = 0.05


class PSFWarning(UserWarning):
    """A PSF image that can be used, but whose centre, edge or ratio to another is suspect."""


def fwhm(image):
    """Width [samples] of a PSF image (ny, nx): diameter of the disc of its samples over half peak.

    Samples are counted, not fitted. The result is exact to about one sample for any shape of the
    core, and independent of noise below half of the peak.
    """
    return 2 * math.sqrt(_n_above_half(image) / math.pi)


def core_centroid(image):
    """Centroid of the core of an image (ny, nx), Gaussian-weighted: (2,) [samples], (y, x).

    The fixed point c of sum_s w(s - c) P[s] (s - c) = 0, with w a Gaussian as wide as the core. The
    iteration begins at the brightest sample, which is the result if the steps leave its
    neighbourhood, as they do in noise.
    """
    peak = np.unravel_index(np.argmax(image), image.shape)
    # sigma of a round core with as many samples above half its maximum; one sample at least
    sigma = max(math.sqrt(_n_above_half(image) / math.pi / (2 * math.log(2))), 1.0)
    core = np.array(peak, dtype=np.float64)
    for _ in range(50):  # a Gaussian core halves its error at least once per step
        y, x = (np.arange(n) - c for n, c in zip(image.shape, core, strict=True))
        weight_y, weight_x = np.exp(-0.5 * (y / sigma) ** 2), np.exp(-0.5 * (x / sigma) ** 2)
        weighted = weight_y[:, None] * image * weight_x
        # twice the weighted centroid is the full step when core and weight are equally wide
        step = 2 * np.array([weighted.sum(axis=1) @ y, weighted.sum(axis=0) @ x]) / weighted.sum()
        if not (np.abs(core + step - peak) <= 2 * sigma).all():
            return np.array(peak, dtype=np.float64)  # noise, not a core: the brightest sample
        core += step
        if np.abs(step).max() < 1e-6:  # samples; far below CORE_TOLERANCE
            break
    return core


def check_edge(images):
    """Raises ValueError for images (C, ny, nx) of unit sum that are too small for their light."""
    light = float(light_beyond_edge(images).max())
    if light > EDGE_REFUSED:
        raise ValueError(
            f"too wide for its {images.shape[1]} x {images.shape[2]} image, or no PSF: by the "
            f"light at its edge, another {100 * light:.0f} % lies beyond"
        )


def _n_above_half(image):
    """Number of samples above half of the brightest one; one at least where it is positive."""
    return np.count_nonzero(image > 0.5 * image.max())


def light_beyond_edge(images):
    """Light beyond the edge, as a fraction of the light inside, for a wing falling as r^-3.

        L = 2 pi R^2 I(R),   I: mean of the outermost ring, R = (sqrt(ny nx) - 1)/2 its radius

    images (C, ny, nx): of unit sum
    returns (C,): negative where the ring's mean is
    """
    n_y, n_x = images.shape[1:]
    ring = np.ones((n_y, n_x), dtype=bool)
    ring[1:-1, 1:-1] = False
    radius = (math.sqrt(n_y * n_x) - 1) / 2
    return 2 * math.pi * radius**2 * images[:, ring].mean(axis=1)


def limit_power(images):
    """Transform of PSF images (C, ny, nx) of unit sum at the limit of their samples: (C,) [1].

    The limit is half a cycle a sample along y or x, whichever is more.

    The samples' own transform has twice as much there, from either side of the limit.
    """
    rows, columns = images.sum(axis=2), images.sum(axis=1)
    parts = [np.abs(s[:, ::2].sum(axis=1) - s[:, 1::2].sum(axis=1)) for s in (rows, columns)]
    return np.maximum(*parts) / 2


def psf_warnings(images, center, core='center="core"') -> list[str]:
    """Warnings about PSF images: a sentence each, with figures.

    Causes: a core more than 0.25 samples off the centre along an axis; more than 5 % of the light
    (of either sign) beyond the edge, by `light_beyond_edge`; samples too coarse, by `limit_power`.

    images (C, ny, nx): of unit sum; center (C, 2) [samples]: (y, x) of the stated centres
    core: the option that makes the core the centre, for the message
    """
    messages = []
    cores = np.stack([core_centroid(image) for image in images])
    off = cores - center
    far = np.abs(off).max(axis=1)
    if far.max() > CORE_TOLERANCE:
        i = int(far.argmax())
        messages.append(
            f"PSF core off the centre, {_bands(far > CORE_TOLERANCE)}: in band {i} it is at "
            f"(y, x) = ({cores[i, 0]:.2f}, {cores[i, 1]:.2f}), ({off[i, 0]:+.2f}, "
            f"{off[i, 1]:+.2f}) samples from ({center[i, 0]:g}, {center[i, 1]:g}), "
            f"and shifts the result by as much; {core} takes the core"
        )
    light = light_beyond_edge(images)
    cut = np.abs(light) > EDGE_TOLERANCE
    if cut.any():
        i = int(np.abs(light).argmax())
        n_y, n_x = images.shape[1:]
        where = f"at the edge of the {n_y} x {n_x} image, {_bands(cut)}: in band {i}"
        messages.append(
            f"PSF light cut {where} about {100 * light[i]:.1f} % lies beyond; a larger image, or "
            "one without background, is needed"
            if light[i] > 0
            else f"PSF negative {where} wings as faint would take {-100 * light[i]:.1f} % of the "
            "light; too much background has been subtracted"
        )
    limit = limit_power(images)
    coarse = limit > LIMIT_TOLERANCE
    if coarse.any():
        i = int(limit.argmax())
        messages.append(
            f"PSF sampled too coarsely, {_bands(coarse)}: in band {i} {100 * limit[i]:.0f} % of "
            "its transform is left at the frequency limit of the samples, and models are wrong by "
            "about that part of their light; give an oversampled image with its `spacing`, such "
            "as 0.25 (native pixels of HST, Roman, and Euclid VIS and NISP are too coarse)"
        )
    return messages


def _bands(chosen):
    """The bands of a mask (C,), in words."""
    numbers = np.flatnonzero(chosen)
    return f"band{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
