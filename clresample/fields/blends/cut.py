"""Cuts oversized blends, those over the limits, where their light is weakest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...measurement.hills import root, saddles, watershed
from ...sky.box import Box

# [sigma] Combined signal to noise at a saddle below which sources are fitted jointly only if the
# fit takes little time. A piece's neighbours are subtracted to 15 % (MODEL_ERROR), so their
# residual light at the border is less than a sigma of a point source's flux there.
WEAK = 6.0
# Ratio of a fit's memory to that of its images: four pieces of 512 x 320 pixels, with 12 sources
# and seven channels each, took 2.8 GB for 1.03 GB of images.
OVERHEAD = 2.7


@dataclass(frozen=True)
class FitLimits:
    """Limits of one fit; blends over them are cut.

    max_sources: largest number of sources; max_pixels: of the model's box around the blend. Larger
        limits give more accurate fits, as one scene, but the time grows faster than the size: the
        errors' normal matrix with the square of the number of sources, its inverse with the cube
    work [px]: model pixels times sources above which a blend is also cut where the light between
        its parts is weak (WEAK); smaller blends are cut only over the limits above
    max_bytes [bytes]: largest predicted memory, see `fit_bytes`. A number of its own, not what is
        free: blends are cut alike in each run
    n_channels: of all mosaics, for that prediction
    """

    max_sources: int = 40
    max_pixels: int = 400 * 400
    work: int = 1_000_000
    max_bytes: float = 1 << 30
    n_channels: int = 1

    def __post_init__(self):
        for name in ("max_sources", "max_pixels", "work", "max_bytes"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be 1 or more")

    @property
    def most_pixels(self) -> float:
        """Of the box of a single source."""
        return min(self.max_pixels, self.max_bytes / fit_bytes(1, 1, self.n_channels))

    def allow(self, n_sources, n_pixels) -> bool:
        """Returns True if numbers of sources and pixels are within the limits."""
        n_bytes = fit_bytes(n_sources, n_pixels, self.n_channels)
        few = n_sources <= self.max_sources and n_pixels <= self.max_pixels
        return few and n_bytes <= self.max_bytes

    def quick(self, n_sources, n_pixels) -> bool:
        """Returns True if a fit of this size is within `work` too."""
        return self.allow(n_sources, n_pixels) and n_sources * n_pixels <= self.work


def fit_bytes(n_sources, n_pixels, n_channels) -> float:
    """Memory [bytes] that a fit takes on device and host together, roughly.

    Each source has its morphology, its gradients and directions (some 20 images of the model's
    pixels) and its image in every channel, in float32; each channel has some 10 more images. The
    factor `OVERHEAD` accounts for tables, padded frames, transforms and the errors' modes.
    """
    images = 20 * n_sources + n_channels * (n_sources + 10)
    return OVERHEAD * 4.0 * images * n_pixels


def cut_blend(light, inside, positions, limits, margin, groups=None):
    """Cuts a blend into pieces within the limits: territories (Ny, Nx) and a piece (S,) per source.

    Each source gets the pixels from which the light rises to it (watershed). Sources are then
    merged in the order of the light at the saddle between them, brightest first, as long as the
    pieces stay within the limits, and below WEAK only within `work`. So cuts are made where the
    light is weakest.

    light (Ny, Nx) [sigma]; inside (Ny, Nx) bool: the blend's pixels; positions (S, 2) [px] in these
    groups (S,): sources of one number are put together first; None = each has its own
    margin [px]: of the box of a piece's fit, on each side
    If the pixels of a single source exceed the limits, it keeps those near it. The others belong
    to no source, and are sky in the pieces around them.
    returns territories int32, 0 = none, else 1 + number of the piece; numbers count from 0
    """
    at = np.clip(np.rint(positions).astype(int), 0, np.array(light.shape) - 1)
    light = np.asarray(light, np.float32)
    basins = watershed(light, inside | _at(inside.shape, at), at)
    owner = basins[at[:, 0], at[:, 1]] - 1  # two sources on one pixel share a basin
    n = int(basins.max())
    boxes = _boxes_within(
        basins, dict(zip(owner.tolist(), at.tolist(), strict=True)), limits, margin
    )
    counts = np.bincount(owner, minlength=n)
    piece = np.arange(n)
    pairs, heights = saddles(light, basins, heights=True)
    within = _within(owner, groups)
    heights = [np.inf] * len(within) + heights
    for (a, b), height in zip(within + pairs, heights, strict=True):
        a, b = root(piece, a), root(piece, b)
        if a == b:
            continue
        both = boxes[a].union(boxes[b])
        fits = limits.allow if height > WEAK else limits.quick
        if not fits(counts[a] + counts[b], both.grown(margin).area):
            continue
        piece[b], boxes[a] = a, both
        counts[a] += counts[b]
    roots = np.array([root(piece, i) for i in range(n)])
    _, number = np.unique(roots, return_inverse=True)
    territory = np.concatenate([[0], number + 1])[basins].astype(np.int32)
    return territory, number[owner]


def _boxes_within(basins, at, limits, margin):
    """The Box of each basin, after removing far pixels from basins over the limits.

    basins: (Ny, Nx), changed in place; at {basin, from 0: (y, x) of its source}
    """
    half = max(1, int(limits.most_pixels**0.5) // 2 - margin)
    boxes = []
    for i, (rows, columns) in enumerate(ndimage.find_objects(basins)):
        box = Box(rows.start, columns.start, rows.stop, columns.stop)
        if not limits.allow(1, box.grown(margin).area):
            y, x = at[i]
            near = Box(y - half, x - half, y + half, x + half).intersection(box)
            own = basins[box.slices] == i + 1
            own[near.relative_to(box).slices] = False
            basins[box.slices][own] = 0
            box = near
        boxes.append(box)
    return boxes


def _at(shape, pixels):
    """True at pixels (S, 2) of an image."""
    found = np.zeros(shape, bool)
    found[pixels[:, 0], pixels[:, 1]] = True
    return found


def _within(owner, groups):
    """Pairs of the basins (from 0) of sources of one group."""
    if groups is None:
        return []
    first: dict[int, int] = {}
    of_group = zip(groups.tolist(), owner.tolist(), strict=True)
    return [(a, o) for g, o in of_group if (a := first.setdefault(g, o)) != o]
