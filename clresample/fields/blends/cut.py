"""Giants: blends over the limits, cut where their light is weakest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..box import Box

# A fit's memory over that of its images: four pieces of 512 x 320 pixels, 12 sources and seven
# channels each, took 2.8 GB for 1.03 GB of images.
OVERHEAD = 2.7


@dataclass(frozen=True)
class Limits:
    """What one fit may hold; blends over it are cut.

    sources: how many; pixels: of the model, in the box about the blend. Larger ones are fitted more
    exactly, as one scene, but take longer than in proportion: the errors' normal matrix grows with
    the square of the number of sources, its inverse with the cube
    memory [bytes]: that it may take by prediction, see `fit_bytes`; None = any; n_channels: of all
    mosaics, for that
    """

    sources: int = 40
    pixels: int = 400 * 400
    memory: float | None = None
    n_channels: int = 1

    def __post_init__(self):
        for name in ("sources", "pixels"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be 1 or more")

    @property
    def most_pixels(self) -> float:
        """Of the box of a single source."""
        if self.memory is None:
            return self.pixels
        return min(self.pixels, self.memory / fit_bytes(1, 1, self.n_channels))

    def hold(self, n_sources, n_pixels) -> bool:
        """Whether a fit of so many sources in a box of so many pixels is within them."""
        n_bytes = fit_bytes(n_sources, n_pixels, self.n_channels)
        few = n_sources <= self.sources and n_pixels <= self.pixels
        return few and (self.memory is None or n_bytes <= self.memory)


def fit_bytes(n_sources, n_pixels, n_channels) -> float:
    """Memory [bytes] that a fit takes on device and host together, roughly.

    Each source has its morphology, its gradients and directions (some 20 images of the model's
    pixels) and its image in every channel, in float32; each channel some 10 more images. All else
    (tables, padded frames, transforms, the errors' modes) makes it `OVERHEAD` times as much.
    """
    images = 20 * n_sources + n_channels * (n_sources + 10)
    return OVERHEAD * 4.0 * images * n_pixels


def pieces_of(light, inside, positions, limits, margin):
    """Cut a blend into pieces within the limits: territories (Ny, Nx) and a piece (S,) per source.

    Each source gets the pixels from which the light rises to it (watershed); sources are then put
    together in the order of the light at the saddle between them, brightest first, as long as the
    pieces stay within the limits. So the pieces part where the light is weakest.

    light (Ny, Nx) [sigma]; inside (Ny, Nx) bool: the blend's pixels; positions (S, 2) [px] in these
    margin [px]: by which the box of a piece's fit is larger on each side
    A single source whose own pixels are over the limits keeps those near it: the others are
    nobody's, and sky in the pieces that hold them.
    returns territories int32, 0 = none, else 1 + number of the piece; numbers count from 0
    """
    at = np.clip(np.rint(positions).astype(int), 0, np.array(light.shape) - 1)
    light = np.asarray(light, np.float32)
    basins = _watershed(light, inside | _at(inside.shape, at), at)
    owner = basins[at[:, 0], at[:, 1]] - 1  # two sources on one pixel share a basin
    n = int(basins.max())
    boxes = _boxes_within(
        basins, dict(zip(owner.tolist(), at.tolist(), strict=True)), limits, margin
    )
    counts = np.bincount(owner, minlength=n)
    piece = np.arange(n)
    for a, b in _saddles(light, basins):
        a, b = _root(piece, a), _root(piece, b)
        if a == b:
            continue
        both = boxes[a].join(boxes[b])
        if not limits.hold(counts[a] + counts[b], both.grown(margin).area):
            continue
        piece[b], boxes[a] = a, both
        counts[a] += counts[b]
    roots = np.array([_root(piece, i) for i in range(n)])
    _, number = np.unique(roots, return_inverse=True)
    territory = np.concatenate([[0], number + 1])[basins].astype(np.int32)
    return territory, number[owner]


def _boxes_within(basins, at, limits, margin):
    """The Box of each basin, after those over the limits have lost what lies far from their source.

    basins: (Ny, Nx), changed in place; at {basin, from 0: (y, x) of its source}
    """
    half = max(1, int(limits.most_pixels**0.5) // 2 - margin)
    boxes = []
    for i, (rows, columns) in enumerate(ndimage.find_objects(basins)):
        box = Box(rows.start, columns.start, rows.stop, columns.stop)
        if not limits.hold(1, box.grown(margin).area):
            y, x = at[i]
            near = Box(y - half, x - half, y + half, x + half).meet(box)
            own = basins[box.slices] == i + 1
            own[near.within(box).slices] = False
            basins[box.slices][own] = 0
            box = near
        boxes.append(box)
    return boxes


def _at(shape, pixels):
    """True at pixels (S, 2) of an image."""
    found = np.zeros(shape, bool)
    found[pixels[:, 0], pixels[:, 1]] = True
    return found


def _watershed(light, inside, at):
    """Basins (Ny, Nx) int32 of the sources at pixels (S, 2), numbered from 1 without gaps, 0
    outside: each pixel belongs to the source from which the light falls to it."""
    peaks, n_peaks = _hills(light, inside)
    hills = peaks[at[:, 0], at[:, 1]] - 1
    taken = np.zeros(n_peaks, bool)
    taken[hills] = True
    parent = np.arange(n_peaks)
    for a, b in _saddles(light, peaks):
        a, b = _root(parent, a), _root(parent, b)
        if a != b and not (taken[a] and taken[b]):
            parent[b], taken[a] = a, taken[a] or taken[b]
    roots = np.array([_root(parent, i) for i in range(n_peaks)])
    own = np.unique(roots[hills])
    number = np.zeros(n_peaks, np.int32)
    number[np.isin(roots, own)] = 1 + np.searchsorted(own, roots[np.isin(roots, own)])
    return np.concatenate([[0], number]).astype(np.int32)[peaks]


def _hills(light, inside):
    """The hills of the light (Ny, Nx) int32, numbered from 1, 0 outside, and how many there are:
    all pixels from which the steepest way up ends on the same peak."""
    n_y, n_x = light.shape
    kind = np.int32 if light.size < 1 << 31 else np.int64
    rank = np.empty(light.size, kind)  # of equal pixels the later is higher: no plateaus
    own = np.arange(light.size, dtype=kind)
    rank[np.argsort(light, axis=None, kind="stable")] = own
    own, rank = own.reshape(light.shape), rank.reshape(light.shape)
    rank[~inside] = -1
    rank = np.pad(rank, 1, constant_values=-1)
    best, up = rank[1:-1, 1:-1].copy(), own.copy()
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            there = rank[1 + dy : 1 + dy + n_y, 1 + dx : 1 + dx + n_x]
            higher = inside & (there > best)
            up[higher] = own[higher] + dy * n_x + dx
            best[higher] = there[higher]
    up = up.ravel()
    while (up[up] != up).any():  # halves the ways each time
        up = up[up]
    up = up[inside.ravel()]
    is_top = np.zeros(light.size, bool)
    is_top[up] = True
    number = np.cumsum(is_top, dtype=np.int32)
    found = np.zeros(light.shape, np.int32)
    found[inside] = number[up]
    return found, int(number[-1])


def _saddles(light, basins):
    """Pairs of basins (from 0) that touch, by the brightest light on their border, falling."""
    pairs, heights = [], []
    for first, second in (
        (np.s_[:-1, :], np.s_[1:, :]),
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        a, b = basins[first], basins[second]
        touch = (a != b) & (a > 0) & (b > 0)
        heights.append(np.minimum(light[first], light[second])[touch])
        pairs.append(np.sort(np.stack([a[touch], b[touch]], axis=1) - 1, axis=1))
    both, height = np.concatenate(pairs), np.concatenate(heights)
    order = np.lexsort((both[:, 1], both[:, 0], -height))
    _, first = np.unique(both[order], axis=0, return_index=True)
    return both[order][np.sort(first)].tolist()


def _root(parents, i):
    """The root of i in a forest, whose ways are made shorter."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i
