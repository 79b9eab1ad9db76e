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


def saddles(light, basins, *, heights=False):
    """Pairs of basins (from 0) that touch, by the brightest light on their border, falling.

    heights: whether to return (pairs, that light of each) instead
    """
    pairs, lights = [], []
    for first, second in (
        (np.s_[:-1, :], np.s_[1:, :]),
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        a, b = basins[first], basins[second]
        touch = (a != b) & (a > 0) & (b > 0)
        lights.append(np.minimum(light[first], light[second])[touch])
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
