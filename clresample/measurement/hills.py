"""Hills of light, the pixels from which it rises to one peak, and the saddles between them."""

from __future__ import annotations

import numpy as np


def watershed(light, inside, at):
    """Basins (Ny, Nx) int32 of the sources at pixels (S, 2), numbered from 1, 0 outside.

    There are no gaps: from each pixel the steepest ascent leads to the source that it belongs to.
    """
    peaks, n_peaks = _hills(light, inside)
    hills = peaks[at[:, 0], at[:, 1]] - 1
    taken = np.zeros(n_peaks, bool)
    taken[hills] = True
    parent = np.arange(n_peaks)
    for a, b in saddles(light, peaks):
        a, b = root(parent, a), root(parent, b)
        if a != b and not (taken[a] and taken[b]):
            parent[b], taken[a] = a, taken[a] or taken[b]
    roots = np.array([root(parent, i) for i in range(n_peaks)])
    own = np.unique(roots[hills])
    number = np.zeros(n_peaks, np.int32)
    number[np.isin(roots, own)] = 1 + np.searchsorted(own, roots[np.isin(roots, own)])
    return np.concatenate([[0], number]).astype(np.int32)[peaks]


def _hills(light, inside):
    """The hills of the light (Ny, Nx) int32, numbered from 1, 0 outside, and their number.

    A hill is the set of pixels from which the steepest ascent ends at the same peak.
    """
    width = light.shape[1] + 2
    order = np.argsort(light[inside], kind="stable")  # of equal pixels the later is higher
    n = len(order)
    kind = np.int32 if n < 1 << 31 else np.int64
    at = np.flatnonzero(np.pad(inside, 1))
    rank = np.full((light.shape[0] + 2) * width, -1, kind)
    rank[at[order]] = np.arange(n, dtype=kind)
    best = rank[at]
    for away in (-width - 1, -width, 1 - width, -1, 1, width - 1, width, width + 1):
        np.maximum(best, rank[at + away], out=best)
    up = order[best]  # the highest neighbour of each pixel inside, among these
    while (up[up] != up).any():  # halves the ways each time
        up = up[up]
    is_top = np.zeros(n, bool)
    is_top[up] = True
    number = np.cumsum(is_top, dtype=np.int32)
    found = np.zeros(light.shape, np.int32)
    found[inside] = number[up]
    return found, int(is_top.sum())


def saddles(light, basins, *, heights=False):
    """Pairs of basins (from 0) that touch, by the brightest light on their border, falling.

    heights: whether to return (pairs, that light of each) instead
    """
    width, pairs, lights = light.shape[1] + 2, [], []
    own, height = (np.pad(image, 1).ravel() for image in (basins, light))
    at = np.flatnonzero(own > 0)
    for away in (width, 1, width + 1, width - 1):
        a, b = own[at], own[at + away]
        touch = (a != b) & (b > 0)
        lights.append(np.minimum(height[at[touch]], height[at[touch] + away]))
        pairs.append(np.sort(np.stack([a[touch], b[touch]], axis=1) - 1, axis=1))
    both, height = np.concatenate(pairs), np.concatenate(lights)
    order = np.lexsort((both[:, 1], both[:, 0], -height))
    _, first = np.unique(both[order], axis=0, return_index=True)
    order = order[np.sort(first)]
    found = both[order].tolist()
    return (found, height[order].tolist()) if heights else found


def root(parents, i):
    """The root of i in a forest, whose ways are made shorter."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i
