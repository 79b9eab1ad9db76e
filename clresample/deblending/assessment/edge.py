"""Light of galaxies outside the observed area, by continuation of their models."""

from __future__ import annotations

import numpy as np

from ..profiles import GalaxyProfile

# Fraction of a flux outside the observed area from which a source is flagged: three errors of a
# bright galaxy's flux.
OUTSIDE = 0.03
# Smallest observed fraction of a ring's area for its mean brightness to be valid for all of it: a
# smaller fraction is a corner of the frame.
MIN_COVERED = 0.2
# Fraction of the rings, at the end of a profile, from whose mean slope it is extrapolated.
OUTER = 0.25
# [radius] Largest scale length of the extrapolation: a flatter profile at the image's edge means
# noise or a wrong sky level.
MAX_SCALE = 0.5


def light_outside(result, shapes, thetas, positions, peaks) -> np.ndarray:
    """Flux (S, C) [counts] of each source's model, continued outside the observed area.

    It is at most the flux inside, and the smaller of two estimates: that of the smooth profile,
    which may have wings that the morphology lacks, and that of the extrapolated morphology, whose
    wings may have noise. It is 0 for sources whose boxes end before the border, and for all sources
    but galaxies: the wings of stars are those of the PSF.

    shapes, thetas, positions (n): of the components' profiles; peaks (n,): of the morphologies
        before they were scaled to a maximum of 1, where those of the profiles are 1
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    outside = result.unobserved
    observed = ~outside[1:-1, 1:-1]
    for i, c in enumerate(result.components):
        (y, x), (n_y, n_x) = c.origin, c.morphology.shape
        beside = outside[y : y + n_y + 2, x : x + n_x + 2]  # with a pixel about the box
        if not isinstance(shapes[i], GalaxyProfile) or not beside.any():
            continue
        (image,) = shapes[i].draw_box(thetas[i], positions[i], (0, 0), observed.shape, slopes=False)
        scale = max(image.max() * peaks[i], 1e-300)
        beyond = max(1 - image[observed].sum(), 0.0) / scale  # its integral is 1
        longer = continued(c.origin, c.morphology, positions[i], outside)
        found[c.source] += c.spectrum * min(beyond, longer)
    return found


def continued(origin, morphology, centre, outside) -> float:
    """Sum of a morphology (ny, nx) where its frame was not observed; outside: `Result.unobserved`.

    Elliptical rings around the centre (2,) [frame px] are assumed to have the same mean brightness
    outside. From the radius where less than a fifth of a ring was observed, the profile is
    extrapolated as an exponential, with the slope of the last quarter of the rings. The result is
    at most the observed sum.
    """
    rings = _rings(origin, morphology, centre, outside.shape)
    if rings is None:
        return 0.0
    n = np.bincount(rings[~outside], minlength=rings.max() + 1)
    (y, x), (n_y, n_x) = origin, morphology.shape
    box = np.s_[y + 1 : y + 1 + n_y, x + 1 : x + 1 + n_x]
    own = ~outside[box]
    light = np.bincount(rings[box][own], morphology[own], len(n))
    ring = np.arange(len(n))
    area = np.pi * (2 * ring + 1)
    bare = n <= MIN_COVERED * area
    first = rings[outside].min()
    bare &= ring >= first  # inner rings are completely observed
    end = int(np.argmax(bare)) if bare.any() else len(n)
    brightness = light[:end] / np.maximum(n[:end], 1)
    missing = np.where(ring >= first, np.maximum(area - n, 0.0), 0.0)[:end]
    return float(min(missing @ brightness + _tail(brightness), morphology.sum()))


def _rings(origin, morphology, centre, shape):
    """Number (Ny + 2, Nx + 2) of the ring of a frame's pixels and its border about a centre.

    Rings are similar to the ellipse of the morphology's second moments, and one pixel wide in the
    mean. None without such an ellipse.
    """
    total = morphology.sum()
    if not total > 0:
        return None
    away = np.indices(morphology.shape) - (np.asarray(centre) - origin)[:, None, None]
    second = np.einsum("yx,iyx,jyx->ij", morphology / total, away, away)
    determinant = np.linalg.det(second)
    if not determinant > 0:
        return None
    metric = np.linalg.inv(second) * np.sqrt(determinant)
    away = np.indices(shape) - (np.asarray(centre) + 1)[:, None, None]
    return np.sqrt(np.einsum("iyx,ij,jyx->yx", away, metric, away)).astype(int)


def _tail(brightness):
    """Sum beyond rings of one pixel and brightness (n,), extrapolated as an exponential."""
    if len(brightness) < 2:
        return 0.0
    end, n = float(len(brightness)), max(1, int(OUTER * len(brightness) / 2))
    inner, outer = brightness[-2 * n : -n].mean(), brightness[-n:].mean()
    if not outer > 0:
        return 0.0
    fall = np.log(inner / outer) / n if inner > outer else 0.0
    scale = min(1 / max(fall, 1e-30), MAX_SCALE * end)
    at_end = outer * np.exp(-n / 2 / scale)
    return 2 * np.pi * at_end * scale * (end + scale)


def reaches_outside(result, flux) -> np.ndarray:
    """Selects sources (S,) with more than OUTSIDE of their flux (S, C) outside the observed area.

    Channels in which that light is below the flux error at fixed morphology are ignored.
    """
    if result.errors is None:
        return np.zeros(len(flux), bool)
    noise = np.zeros(flux.shape)
    for i, c in enumerate(result.components):
        variance = np.maximum(result.covariance[:, i, i], 0)
        noise[c.source] += np.sqrt(variance) * c.morphology.sum()
    outside = result.errors.outside
    return ((outside > OUTSIDE * flux) & (outside > noise)).any(axis=1)
