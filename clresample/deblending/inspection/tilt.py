"""Tests whether the sky's level rises from one side of an image to the other."""

from __future__ import annotations

import numpy as np

from .levels import CLIP, MIN_BLOCKS, POWERS, SIGMAS_A_MAD, away_from_sources

# [sigma of a pixel] Smallest rise from edge to edge that is named: it changes a flux measured on
# 100 pixels by more than its error. [1] Smallest decrease of the blocks' chi2 by a plane.
MIN_RISE, MIN_CHI2 = 0.15, 25.0
# [FWHM] Blocks nearer to a source are left out.
NEAR_SOURCE = 2.5
# Wings are sums of powers of the distance, common to the sources, and of Gaussians [FWHM] about the
# N_WIDE with the most light within WIDE_FWHM. Gaussians about all of them may make up any plane.
N_WIDE, WIDE_FWHM = 2, 4.0
WIDTHS = 2.0, 4.0, 8.0, 16.0
# [1] Smallest height of a step, over what else varies in the level, and [blocks] its smallest
# distance from an edge. No step or plane is found in 44 clean simulated images, also of crowds on
# one side, bright stars and galaxies of 20 to 60 px; 12 of 12 planes of 0.5 sigma are.
STEP_PART, MARGIN = 2.0, 4
N_ROUNDS = 2


def tilt_lines(image, sky) -> list[str]:
    """A message about channels whose sky rises by a plane; none where wings explain it as well.

    image: InspectedImage; sky: its SkyLevel, whose blocks are used
    """
    names, usable, blocks = image.observation.channels, image.usable, sky.blocks
    data = np.where(usable, image.observation.data / image.sigma[:, None, None], 0.0)
    several, root = len(data) > 1, len(data) ** 0.5
    if several:  # all together tell a smaller one
        seen = usable.all(axis=0, keepdims=True)
        data = np.concatenate([data, np.where(seen, data.sum(axis=0) / root, 0.0)])
        usable = np.concatenate([usable, seen])
    centers, counts = blocks.centers, blocks.sums(usable.astype(float))
    free = away_from_sources(image, centers, NEAR_SOURCE) & (2 * counts > blocks.side**2)
    channels = zip(data, blocks.sums(data), counts, free, strict=True)
    rises = np.array([_rise(image, centers, *own) for own in channels])
    if several:
        common, rises = rises[-1] / root, rises[:-1]
        rises = np.where(rises.any(axis=1, keepdims=True), rises, common)
    size = np.abs(rises).sum(axis=1)
    if size.max() < MIN_RISE:
        return []
    total = rises.sum(axis=0)
    sides = [
        f"{'larger' if rise > 0 else 'smaller'} {axis}"
        for axis, rise in zip("yx", total, strict=True)
        if abs(rise) > np.abs(total).max() / 3
    ]
    some = ", ".join(f"{n} {one:.2g} sigma" for n, one in zip(names, size, strict=True) if one)
    return [
        f"the sky level varies over the image: from edge to edge by {some} a pixel, up towards "
        f"{' and '.join(sides)}; fluxes of sources include a part of it, and faint ones may be "
        'none; subtract a model of the background (in a field: background="subtract")'
    ]


def _rise(image, centers, data, sums, counts, free):
    """Rises (2,) of data (My, Mx) [sigma] from edge to edge along y and x; 0 if not significant.

    sums, counts (B,): of the data and of usable pixels in blocks; free (B,): bool, those used
    """
    from scipy.optimize import nnls

    none = np.zeros(2)
    if np.count_nonzero(free) < 3 * MIN_BLOCKS:
        return none
    centers, counts = centers[free], counts[free]
    z = sums[free] / np.sqrt(counts)  # means in units of their noise
    shape = np.array(data.shape)
    plane = np.column_stack([np.ones(len(z)), centers / shape - 0.5]) * np.sqrt(counts)[:, None]
    kept = np.ones(len(z), bool)
    for _ in range(N_ROUNDS):
        rest = z - plane @ np.linalg.lstsq(plane[kept], z[kept], rcond=None)[0]
        scale = max(1.0, SIGMAS_A_MAD * np.median(np.abs(rest[kept])))
        kept = np.abs(rest) < CLIP * scale
    plane, z, centers, counts = plane[kept], z[kept] / scale, centers[kept], counts[kept]
    if len(z) < 3 * MIN_BLOCKS or _chi2(plane[:, :1], z) - _chi2(plane, z) < MIN_CHI2:
        return none
    wings = _wings(image, centers, data) * np.sqrt(counts)[:, None]
    found, with_plane = nnls(np.hstack([plane, -plane, wings]), z)
    _, without = nnls(np.hstack([plane[:, :1], -plane[:, :1], wings]), z)
    rises = (found[1:3] - found[4:6]) * scale
    middle = (found[0] - found[3]) * scale
    lowest = _lowest(centers @ (rises / shape), z, counts)
    # wings are positive: no part of their sky is below zero, unless most of it is
    below = lowest > MIN_CHI2**0.5 and middle > -np.abs(rises).sum() / 3
    if not below or without**2 - with_plane**2 < MIN_CHI2:
        columns = np.hstack([plane, wings[:, found[6:] > 0]])
        rises = _step(columns, z, centers, counts, scale)
    return rises


def _lowest(along, z, counts):
    """Depth [sigma] below zero of the quarter of blocks that are lowest `along` a rise (n,)."""
    low = along <= np.quantile(along, 0.25)
    return -(z * np.sqrt(counts))[low].sum() / np.sqrt(counts[low].sum())


def _step(columns, z, centers, counts, scale):
    """Rise (2,) [sigma] of the most significant step along y or x, 0 if none is.

    It must exceed all else that varies beside it, which may be wings that `columns` (n, k) miss.

    z (n,): means in units of `scale` times their white noise
    """
    before, best, rises = _chi2(columns, z), MIN_CHI2, np.zeros(2)
    noise = np.mean(1 / counts) / scale**2
    for axis in (0, 1):
        for edge in np.unique(centers[:, axis])[MARGIN:-MARGIN]:
            step = (centers[:, axis] > edge) * np.sqrt(counts)
            both = np.column_stack([columns, step])
            gain = before - _chi2(both, z)
            if gain > best:
                size = np.linalg.lstsq(both, z, rcond=None)[0][-1]
                rest = np.var((z - size * step) / np.sqrt(counts)) - noise
                if size**2 > STEP_PART**2 * rest:
                    best, rises = gain, size * (np.arange(2) == axis)
    return rises * scale


def _chi2(columns, z):
    """The least chi2 of z (n,) as a sum of columns (n, k)."""
    return ((z - columns @ np.linalg.lstsq(columns, z, rcond=None)[0]) ** 2).sum()


def _wings(image, centers, data):
    """Light (n, k) at centres (n, 2) [px] of the wings of sources and of the brightest few."""
    places = image.places[image.brightest]
    if not len(places):
        return np.zeros((len(centers), 0))
    reach = max(image.width_px, 1.0)
    light = _light(data, places, WIDE_FWHM * reach)
    squares = ((centers[:, None] - places) ** 2).sum(axis=-1)
    powers = [(light * (squares + reach**2) ** (-p / 2)).sum(axis=1) for p in POWERS]
    few = squares[:, np.argsort(-light)[:N_WIDE]]
    widths = np.array(WIDTHS) * reach
    gaussians = np.exp(-0.5 * few[:, :, None] / widths**2).reshape(len(centers), -1)
    wings = np.column_stack([*powers, gaussians])
    return wings / np.maximum(wings.max(axis=0), 1e-300)


def _light(data, places, reach):
    """Light (S,) [sigma] within `reach` [px] of places (S, 2), at least that of one pixel."""
    y, x = np.indices(data.shape)
    return np.array([max(data[np.hypot(y - a, x - b) < reach].sum(), 1.0) for a, b in places])
