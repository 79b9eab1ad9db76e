"""Sources linked into blends by the light that they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...sky.box import Box
from ..memmap import create_memmap


@dataclass(frozen=True, eq=False)
class LinkedFootprints:
    """The light of a field, each blend's pixels by its number.

    labels (Ny, Nx): int32, 1 to n, 0 = no source
    boxes (n): Box of each; light (Ny, Nx) [sigma]: float16
    """

    labels: np.ndarray
    boxes: tuple[Box, ...]
    light: np.ndarray


def link_footprints(tiles, found, region, folder=None) -> LinkedFootprints:
    """Connected footprints of a region, from its tiles: two pixels that touch belong together.

    tiles: of the region; found: called with a tile's number, returns its TileDetections
    region: Box of the model's pixels
    folder: for labels and light in memory-mapped files; None = in memory
    """
    labels = _image(folder, "labels", np.int32, region.shape)
    light = _image(folder, "light", np.float16, region.shape)
    n_labels, joined = 0, []
    for tile in tiles:
        part, where = found(tile.number), tile.core.relative_to(region).slices
        own, n = ndimage.label(part.footprint_mask, np.ones((3, 3), int))
        own[own > 0] += n_labels
        labels[where], light[where] = own, part.snr_map
        joined.append(_touching(labels, tile.core.relative_to(region)))
        n_labels += n
    number = _roots(n_labels, np.concatenate([np.zeros((0, 2), int), *joined]))
    boxes: dict[int, Box] = {}
    for tile in tiles:
        core = tile.core.relative_to(region)
        labels[core.slices] = number[labels[core.slices]]
        for i, slices in enumerate(ndimage.find_objects(labels[core.slices]), start=1):
            if slices is not None:
                (rows, columns) = slices
                box = Box(rows.start, columns.start, rows.stop, columns.stop)
                box = Box(*(np.array(box) + np.array([*tile.core[:2], *tile.core[:2]])).tolist())
                boxes[i] = box if i not in boxes else boxes[i].union(box)
    return LinkedFootprints(labels, tuple(boxes[i] for i in sorted(boxes)), light)


def _touching(labels, core):
    """Pairs of labels (n, 2) that touch across the upper and the left edge of a tile's core."""
    pairs = []
    (n_y, n_x), (y0, x0, y1, x1) = labels.shape, core
    if y0 > 0:
        for shift in (-1, 0, 1):
            columns = np.arange(max(x0, -shift, 0), min(x1, n_x - max(shift, 0)))
            pairs.append((labels[y0, columns], labels[y0 - 1, columns + shift]))
    if x0 > 0:
        for shift in (-1, 0, 1):
            rows = np.arange(max(y0, -shift), min(y1, n_y - max(shift, 0)))
            pairs.append((labels[rows, x0], labels[rows + shift, x0 - 1]))
    if not pairs:
        return np.zeros((0, 2), int)
    both = np.concatenate([np.stack(pair, axis=1) for pair in pairs])
    return np.unique(both[(both > 0).all(axis=1)], axis=0).astype(int)


def _roots(n, pairs):
    """The new number of each label 0 to n: those joined by pairs share one; 0 stays."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(pairs), np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(n + 1, n + 1))
    _, component = connected_components(graph, directed=False)
    # numbers in the order of the first label of each, 0 of the background first
    _, first = np.unique(component, return_index=True)
    order = np.empty(len(first), np.int32)
    order[np.argsort(first)] = np.arange(len(first))
    return order[component].astype(np.int32)


def _image(folder, name, dtype, shape):
    if folder is None:
        return np.zeros(shape, dtype)
    return create_memmap(folder / f"{name}.npy", dtype, shape)
