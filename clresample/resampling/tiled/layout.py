"""Tiles of a frame: their sizes, positions and groups that share an operator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ...device.contraction import row_stride
from ...device.rounding import round_up
from ...device.tuning import Tuning
from ...sky.extent import grid_intersection
from ...sky.grid import Grid
from ...sky.mapping import Mapping
from ...sky.psf import PSF
from ..affine import kept_taps
from ..plan import Precision, make_resampling_plan
from ..transfer import wrap_radius
from ..wave_tables import TAPS_PAD

GEOMETRIES = ("aligned", "affine", "distorted")  # from the cheapest on
# [observed px] Side of the tile from which the band is measured. It finds the band's edge to one
# frequency in a hundred; a larger tile is more accurate and slower.
TRIAL_PX = 32
# [model px] A window has full weight up to half the wrap radius beyond its tile, then falls to zero
# over the other half, or over TAPER_PX if that is more: a sharp edge would ring through the tile.
FLAT, TAPER_PX = 0.5, 24
# [observed px] sides to choose from, 8 to 16384
SIDES = np.unique(np.rint(8 * 2 ** (np.arange(45) / 4)).astype(int))


@dataclass(frozen=True)
class OutputTile:
    """One tile of the observed frame.

    origin (2,) [observed px]: its first pixel
    window_origin (2,) [model px]: its window's first pixel; rarely a whole number
    mask (My, Mx) bool: its pixels in the result; each pixel of the frame belongs to one tile
    """

    origin: tuple[int, int]
    window_origin: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class TileGroup:
    """Tiles that share one operator, from a window of the model to a tile, wherever these lie.

    taper (Ny,), (Nx,): weights of the window's rows and columns
    """

    mapping: Mapping
    taper: tuple[np.ndarray, np.ndarray]
    tiles: list[OutputTile]


def make_groups(
    grid_in: Grid,
    psf_in: PSF,
    grid_out: Grid,
    psf_out: PSF,
    *,
    precision: Precision,
    tolerance_px: float,
    tuning: Tuning,
    memory: int,
) -> list[TileGroup]:
    """Tiles that cover every observed pixel on the model once, in groups that share an operator.

    grid_in, psf_in: the model's; grid_out, psf_out: the observation's
    tolerance_px [model px]: largest distance of a pixel from its position by the WCS
    tuning: overheads of tiles on the device
    memory [bytes]: limit for one group's operator

    Raises ValueError for grids that do not overlap, band counts that do not match, and a memory
    that is too small for the smallest tile.
    """
    region = grid_intersection([grid_in, grid_out], like=grid_out)
    corner = np.rint(region.map_to(grid_out).at(0, 0)).astype(int)
    shape = tuple(min(n, TRIAL_PX) for n in region.shape)
    middle = [(n - m) // 2 for n, m in zip(region.shape, shape, strict=True)]
    trial = region.cutout(*middle, shape).map_to(grid_in, tolerance_px)
    radius = np.array(wrap_radius(psf_out, trial.matrix))
    margin = np.ceil(radius * FLAT + np.maximum(radius * (1 - FLAT), TAPER_PX)).astype(int)
    sizes = TileCosts(trial, margin, psf_in, psf_out, precision, tuning)
    geometry = trial.geometry
    while True:
        shape = sizes.choose(geometry, region.shape, memory)
        worst, tiles = _lay(region, grid_in, shape, geometry, tolerance_px)
        if worst == geometry:
            break
        geometry = worst  # its tiles cost more, so that another size is the quickest
    groups: list[TileGroup] = []
    for start, mapping, mask in tiles:
        group, place = _find(groups, mapping, margin, margin - radius * FLAT, tolerance_px)
        y, x = (int(a + b) for a, b in zip(corner, start, strict=True))
        group.tiles.append(OutputTile((y, x), place, mask))
    if not groups:
        raise ValueError(
            f"grids do not overlap: no pixel of the observation {grid_out.shape} lies on the model "
            f"{grid_in.shape}"
        )
    return groups


class TileCosts:
    """Costs of tiles of any size, from one small plan.

    Small tiles spend their time on the margins of their windows, large ones on matrix products,
    whose cost grows as the cube of a side; and memory limits their size. The fastest size is tens
    to hundreds of pixels, depending on both pixel scales, both PSFs and the geometry.

    trial: mapping of a small tile; margin (2,) [model px] of every window
    precision, tuning: of the operators and of their device
    """

    def __init__(self, trial: Mapping, margin, psf_in: PSF, psf_out: PSF, precision, tuning):
        geometry = "affine" if trial.geometry == "distorted" else trial.geometry
        window = window_of(replace(trial, geometry=geometry, positions=None, area=None), margin)
        plan = make_resampling_plan(window, psf_in, psf_out, precision=precision)
        n_fft = plan.certificate.n_fft
        self.tuning = tuning
        self.n_bands, self.itemsize = plan.n_bands, 4 if precision == Precision.of("f4") else 8
        self.scale = np.abs(trial.matrix).sum(axis=1).max()
        self.border = 2 * int(margin.max()) + 2
        self.pad = max(k - n for k, n in zip(n_fft, window.shape_in, strict=True))
        # the band's edge, to one frequency of the small plan
        n_frequencies = plan.certificate.n_frequencies
        self.band = max((h + 1) / k for h, k in zip(n_frequencies, n_fft, strict=True))
        self.window = precision.window
        self.columns, self.taps, self.taps_back = 0.0, 0, 0
        if plan.lines is not None:
            self.taps, self.taps_back = plan.lines.weight.shape[1], plan.lines.weight_t.shape[1]
            reach = np.abs(trial.matrix) @ np.subtract(trial.shape_out, 1)
            self.columns = (plan.out_x.shape[1] - self.taps) / max(reach.min(), 1)

    def cost(self, geometry, m):
        """Time [flops] of a tile of m x m observed pixels, and its device memory [bytes]."""
        return self.account(geometry, m, *self.sides(geometry, m))

    def sides(self, geometry, m):
        """Sides of a tile of m x m observed pixels: window pixels n, waves k, columns j.

        Upper limits: pixels of a side of its window, waves of an axis, columns crossed by its
            lines or of its plane.
        """
        n = int(np.ceil(self.scale * (m - 1))) + self.border
        k = 2 * (int(self.band * (n + self.pad)) + 1)
        if geometry == "distorted":
            j = 2 * self.band * self.window.oversampling * self.scale * m
            return n, k, int(j) + round_up(self.window.n_taps, TAPS_PAD) + 2
        return n, k, int(self.columns * self.scale * m) + self.taps + 1

    def account(self, geometry, m, n, k, j):
        """Terms of `cost`, from the sides of the executors' matrices."""
        rows = j if geometry == "distorted" else m
        wide, crossed = row_stride(k), row_stride(j)
        flops = n * n * k + n * k * k
        tables = 2 * n * k + k * row_stride(n) + n * wide + 2 * rows * k
        each_band = (max(n, rows) + 2 * k) * wide + 2 * (n * n + m * m)  # images: both ways
        if geometry == "aligned":
            flops += m * k * k + m * m * k
            tables += k * row_stride(m) + m * wide
        elif geometry == "affine":
            flops += k * k * j + m * k * j + m * m * self.taps
            tables += 2 * k * crossed + j * wide
            taps = kept_taps(self.taps, j, self.tuning)
            taps_back = kept_taps(self.taps_back, m, self.tuning)
            tables += m * m * (taps + 1) + m * crossed * (taps_back + 1)
            each_band += (k + m) * crossed
        else:
            taps = self.window.n_taps
            flops += j * k * k + j * j * k + m * m * taps * (taps + 1)
            tables += k * crossed + j * wide
            tables += m * m * (4 + 2 * round_up(taps, TAPS_PAD)) + j * j
            each_band += j * j
        pixels = self.n_bands * (n * n + m * m)
        time = 2 * self.n_bands * flops
        time += self.tuning.tile_flops + self.tuning.pixel_flops * pixels
        return time, self.itemsize * (tables + self.n_bands * each_band)

    def choose(self, geometry, shape, memory):
        """Tile shape (My, Mx) [observed px] of the quickest frame of this shape within `memory`."""
        best = None
        for side in SIDES:
            counts = [-(-n // side) for n in shape]
            tile = tuple(-(-n // count) for n, count in zip(shape, counts, strict=True))
            time, n_bytes = self.cost(geometry, max(tile))
            if n_bytes > memory:
                break
            if best is None or counts[0] * counts[1] * time < best[0]:
                best = counts[0] * counts[1] * time, tile
        if best is None:
            raise ValueError(
                f"memory is {memory} bytes, but tiles of {max(tile)} pixels a side need {n_bytes}"
            )
        return best[1]


def window_of(mapping: Mapping, margin) -> Mapping:
    """The affine mapping between this tile and the middle of a window that contains it.

    The window leaves `margin` (2,) [model px] on every side, and half a pixel for a shift.
    """
    middle = np.subtract(mapping.shape_out, 1) / 2
    reach = np.abs(mapping.matrix) @ (2 * middle)
    shape = np.ceil(reach).astype(int) + 2 * margin + 2
    offset = (shape - 1) / 2 - mapping.matrix @ middle
    return replace(mapping, shape_in=tuple(int(n) for n in shape), offset=offset)


def _lay(region, grid_in, shape, geometry, tolerance_px):
    """Geometry needed by the tiles of a region, and the tiles if that is `geometry` or simpler.

    returns one of GEOMETRIES, and for each tile its first pixel, mapping and mask
    """
    tiles = []
    for first in product(*(range(0, n, m) for n, m in zip(region.shape, shape, strict=True))):
        # the last tiles of a row or column overlap those before
        start = [min(i, n - m) for i, n, m in zip(first, region.shape, shape, strict=True)]
        mapping = region.cutout(*start, shape).map_to(grid_in, tolerance_px)
        mask = mapping.covered
        mask[: first[0] - start[0]] = False
        mask[:, : first[1] - start[1]] = False
        if mask.any():
            if GEOMETRIES.index(mapping.geometry) > GEOMETRIES.index(geometry):
                return mapping.geometry, []
            tiles.append((start, mapping, mask))
    return geometry, tiles


def _find(groups, mapping, margin, width, tolerance_px):
    """The first group whose operator serves a tile, or a new one; and the tile's index in it."""
    middle = np.subtract(mapping.shape_out, 1) / 2
    if mapping.geometry == "distorted":
        inside = mapping.positions[mapping.covered]
        low = np.floor(inside.min(axis=0)).astype(int) - margin
        shape = np.ceil(inside.max(axis=0)).astype(int) + margin - low + 1
        window = mapping.window(low, tuple(int(n) for n in shape), (0, 0), mapping.shape_out)
        groups.append(TileGroup(window, _taper(window.shape_in, width), []))
        return groups[-1], low.astype(float)
    for group in groups:
        if group.mapping.geometry != mapping.geometry:
            continue
        turn = mapping.matrix - group.mapping.matrix
        moved = max(np.hypot(*(turn @ (middle * corner))) for corner in ((1, 1), (1, -1)))
        if moved + mapping.departure_px <= tolerance_px:
            break
    else:
        window = window_of(mapping, margin)
        group = TileGroup(window, _taper(window.shape_in, width), [])
        groups.append(group)
    window = group.mapping
    return group, mapping.matrix @ middle + mapping.offset - window.matrix @ middle - window.offset


def _taper(shape, width):
    """Weights along each axis: 1 inside, down to 0 over `width` (2,) [px], smooth to order 3."""
    tapers = []
    for n, w in zip(shape, width, strict=True):
        u = np.minimum((np.minimum(np.arange(n), np.arange(n)[::-1]) + 0.5) / w, 1)
        tapers.append(u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3))
    return tapers[0], tapers[1]
