"""Giants: blends over the limits, cut where their light is weakest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..box import Box


@dataclass(frozen=True)
class Limits:
    """What one fit may hold; blends over it are cut.

    sources: how many; pixels: of the model, in the box about the blend. Larger ones are fitted more
    exactly, as one scene, but take longer than in proportion: the errors' normal matrix grows with
    the square of the number of sources, its inverse with the cube
    """

    sources: int = 40
    pixels: int = 400 * 400

    def __post_init__(self):
        for name in ("sources", "pixels"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be 1 or more")


def pieces_of(light, inside, positions, limits, margin):
    """Cut a blend into pieces within the limits: territories (Ny, Nx) and a piece (S,) per source.

    Each source gets the pixels from which the light rises to it (watershed); sources are then put
    together in the order of the light at the saddle between them, brightest first, as long as the
    pieces stay within the limits. So the pieces part where the light is weakest.

    light (Ny, Nx) [sigma]; inside (Ny, Nx) bool: the blend's pixels; positions (S, 2) [px] in these
    margin [px]: by which the box of a piece's fit is larger on each side
    returns territories int32, 0 = none, else 1 + number of the piece; numbers count from 0
    """
    at = np.clip(np.rint(positions).astype(int), 0, np.array(light.shape) - 1)
    basins = _watershed(np.asarray(light, np.float32), inside, at)
    owner = basins[at[:, 0], at[:, 1]] - 1  # two sources on one pixel share a basin
    n = int(basins.max())
    boxes = [None] * n
    for i, slices in enumerate(ndimage.find_objects(basins)):
        boxes[i] = Box(slices[0].start, slices[1].start, slices[0].stop, slices[1].stop)
    counts = np.bincount(owner, minlength=n)
    piece = np.arange(n)
    for a, b in _saddles(np.asarray(light, np.float32), basins):
        a, b = _root(piece, a), _root(piece, b)
        if a == b:
            continue
        both = boxes[a].join(boxes[b])
        if counts[a] + counts[b] > limits.sources or both.grown(margin).area > limits.pixels:
            continue
        piece[b], boxes[a] = a, both
        counts[a] += counts[b]
    roots = np.array([_root(piece, i) for i in range(n)])
    _, number = np.unique(roots, return_inverse=True)
    territory = np.concatenate([[0], number + 1])[basins].astype(np.int32)
    return territory, number[owner]


def _watershed(light, inside, at):
    """Basins (Ny, Nx) int32 of the sources at pixels (S, 2), numbered from 1 without gaps."""
    # in 65,000 steps of brightness, the brightest lowest: what scipy's watershed takes
    depth = np.where(inside, light, light[inside].min(initial=0.0))
    depth = np.arcsinh(depth)
    span = max(float(np.ptp(depth)), 1e-9)
    levels = ((depth.max() - depth) / span * 65000).astype(np.uint16)
    markers = np.zeros(light.shape, np.int32)
    number = 0
    for y, x in at:
        if markers[y, x] == 0:
            number += 1
            markers[y, x] = number
    markers[~inside & (markers == 0)] = -1
    basins = ndimage.watershed_ift(levels, markers, structure=np.ones((3, 3), int))
    return np.maximum(basins, 0)


def _saddles(light, basins):
    """Pairs of basins (from 0) that touch, by the brightest light on their border, falling."""
    found: dict[tuple[int, int], float] = {}
    for first, second in (
        (np.s_[:-1, :], np.s_[1:, :]),
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        a, b = basins[first], basins[second]
        touch = (a != b) & (a > 0) & (b > 0)
        height = np.minimum(light[first], light[second])[touch]
        pairs = np.sort(np.stack([a[touch], b[touch]], axis=1) - 1, axis=1)
        for (i, j), h in zip(pairs.tolist(), height.tolist(), strict=True):
            found[i, j] = max(found.get((i, j), -np.inf), h)
    return sorted(found, key=lambda pair: (-found[pair], pair))


def _root(parents, i):
    while parents[i] != i:
        i = parents[i]
    return i
