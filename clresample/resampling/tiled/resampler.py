"""Whole frames through overlapping tiles, in device memory of a stated size."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from tqdm import tqdm

from ...device.tuning import Tuning
from ...sky.box import box_slices, intersect_boxes
from ...sky.grid import GridLike, as_grid
from ...sky.psf import PSF
from ...sky.validation.checks import check_dtype
from ...sky.validation.observed import PSFLike, as_psf
from ..grid_operator import GridOperator
from ..linop import HostLinOp, LinOp
from ..plan import Precision, is_identity, make_resampling_plan
from ..resampler import Resampler
from .layout import GEOMETRIES, TileGroup, make_groups


class TiledResampler(HostLinOp, GridOperator):
    """The operator of `Resampler` on frames of any size, tile by tile.

        I2[tile] = R_tile I1[window]

    A window is the part of the model that contributes to a tile: the tile's area and the wrap
    radius around it. It falls smoothly to zero at its edge, and is zero beyond the model. Windows
    start at whole pixels, so that tiles with one Jacobian share an operator and differ in its
    shift. A distorted frame is affine tile by tile if tolerance_px permits.

    Images as sharp as the model's PSF agree with the result of a single tile to 2e-6 (5e-6 if the
    PSF's samples alias), the effect of another padding of that tile. White noise, sharper than the
    PSF, agrees to 1e-6 from HST to HSC, 1e-4 from Euclid to Rubin, and 6e-2 between rotated grids
    of equal pixels, whose sinc interpolation has infinite range.

    grid_in, psf_in, grid_out, psf_out, dtype, device, shift, tolerance_px, and the properties: see
    GridOperator; `certificate` is that of the first tile
    memory [bytes]: limit on device memory; None = 1 GiB, or a quarter of the device's memory
    progress: True = show a progress bar if standard error is a terminal

    Frames are NumPy arrays, (C, Ny, Nx) or (B, C, Ny, Nx), and stay on the host.
    Raises ValueError for grids that do not overlap, band counts that do not match, and a memory too
    small for the smallest tile.
    """

    def __init__(
        self,
        grid_in: GridLike,
        psf_in: PSFLike,
        grid_out: GridLike,
        psf_out: PSFLike,
        *,
        dtype=np.float32,
        device=None,
        shift=(0.0, 0.0),
        tolerance_px=1e-4,
        memory=None,
        progress=True,
    ):
        grid_in, grid_out = as_grid("grid_in", grid_in), as_grid("grid_out", grid_out)
        model_psf, seen_psf = as_psf("psf_in", psf_in), as_psf("psf_out", psf_out)
        dtype = check_dtype(dtype)
        n_bands = max(model_psf.n_bands, seen_psf.n_bands)
        shapes = (n_bands, *grid_in.shape), (n_bands, *grid_out.shape)
        LinOp.__init__(self, device, dtype, *shapes)
        tuning = Tuning.of(self.device, dtype)
        self.memory = tuning.memory if memory is None else memory
        self.grid_in, self.grid_out, self.tolerance_px = grid_in, grid_out, tolerance_px
        self.groups = make_groups(
            grid_in,
            model_psf,
            grid_out,
            seen_psf,
            precision=Precision.of(dtype),
            tolerance_px=tolerance_px,
            tuning=tuning,
            memory=self.memory,
        )
        self._operators = TileOperators(model_psf, seen_psf, self.dtype, self.device)
        self.shift, self.progress = shift, progress

    def _about(self):
        return (*super()._about(), f"{self.n_tiles} tiles")

    def _use_shift(self):
        """Does nothing: each tile's operator is shifted when the tile is rendered."""

    @property
    def n_tiles(self) -> int:
        """Tiles of the whole frame."""
        return sum(len(group.tiles) for group in self.groups)

    @property
    def tile_shape(self) -> tuple[int, int]:
        """Shape (My, Mx) [observed px] of every tile."""
        return self.groups[0].mapping.shape_out

    @cached_property
    def mapping(self):
        """Mapping of the observed pixels of the whole frame into the model's.

        Made when first read.
        """
        return self.grid_out.map_to(self.grid_in, self.tolerance_px)

    @property
    def geometry(self) -> str:
        """The most general geometry among the tiles: "aligned", "affine" or "distorted"."""
        return max((group.mapping.geometry for group in self.groups), key=GEOMETRIES.index)

    @property
    def covered(self) -> np.ndarray:
        """Observed pixels (My, Mx) bool whose centre lies on the model."""
        covered = np.zeros(self.shape_out[1:], bool)
        for group in self.groups:
            for tile in group.tiles:
                covered[box_slices(tile.origin, tile.mask.shape)] |= tile.mask
        return covered

    @property
    def certificate(self):
        """Findings of the set-up of the first tile."""
        return self._operators.of(self.groups[0]).certificate

    def _forward(self, x, out):
        """I2[tile] = R_tile I1[window]; x (B, C, Ny, Nx), out (B, C, My, Mx) on the host."""
        out[...] = 0
        for op, tile, origin in self._steps():
            part = out[(..., *box_slices(tile.origin, tile.mask.shape))]
            for frame, target in zip(x, part, strict=True):
                window = _cut(frame, origin, op.shape_in[1:] if op else tile.mask.shape)
                np.copyto(target, op(window) if op else window, where=tile.mask)

    def _adjoint(self, y, out):
        """I1[window] += R_tile^T I2[tile]; y (B, C, My, Mx), out (B, C, Ny, Nx) on the host."""
        out[...] = 0
        for op, tile, origin in self._steps():
            part = y[(..., *box_slices(tile.origin, tile.mask.shape))]
            for piece, frame in zip(part, out, strict=True):
                _add(frame, origin, op.adjoint(piece * tile.mask) if op else piece * tile.mask)

    def _steps(self):
        """Each tile, its operator with its shift, and the first pixel of its window.

        If pixels and PSFs are equal, the operator is None: the window is the tile.
        """
        # tqdm's None: a bar on a terminal only
        with tqdm(
            total=self.n_tiles,
            unit="tile",
            desc="resampling",
            leave=False,
            disable=None if self.progress else True,
        ) as bar:
            for group in self.groups:
                for tile in group.tiles:
                    place = tile.window_origin + self.shift
                    first = place + group.mapping.offset
                    if self._operators.copy(group) and (first == np.rint(first)).all():
                        yield None, tile, first.astype(int)
                    else:
                        op, origin = self._operators.of(group), np.rint(place).astype(int)
                        if (op.shift != place - origin).any():
                            op.shift = place - origin
                        yield op, tile, origin
                    bar.update()


class TileOperators:
    """The operators of groups of tiles, one at a time, since two might not fit the memory.

    psf_in, psf_out, dtype, device: of the TiledResampler
    """

    def __init__(self, psf_in: PSF, psf_out: PSF, dtype, device):
        self.psf_in, self.psf_out, self.dtype, self.device = psf_in, psf_out, dtype, device
        self._group: TileGroup | None = None
        self._op: Resampler | None = None

    def of(self, group: TileGroup) -> Resampler:
        """The operator from a window of the group to its tile, without the tile's shift."""
        if self._op is None or self._group is not group:
            self._group, self._op = None, None  # frees the memory first
            precision = Precision.of(self.dtype)
            plan = make_resampling_plan(
                group.mapping, self.psf_in, self.psf_out, precision=precision
            )
            y, x = (group.taper[axis] for axis in plan.axes)
            plan = replace(plan, in_y=plan.in_y * y, in_x=plan.in_x * x)
            self._op = Resampler.from_plans([plan], dtype=self.dtype, device=self.device)
            self._group = group
        return self._op

    def copy(self, group: TileGroup) -> bool:
        """Returns True if the group's pixels and PSFs are the same.

        A tile is its window's middle.
        """
        shape = group.mapping.shape_out
        mapping = replace(group.mapping, shape_in=shape, offset=np.zeros(2))
        return is_identity(mapping, self.psf_in, self.psf_out)


def _cut(frame, origin, shape):
    """The window of a frame (..., Ny, Nx) from `origin` on, zero beyond its edges."""
    window = np.zeros((*frame.shape[:-2], *shape), frame.dtype)
    there, here = intersect_boxes((0, 0), frame.shape[-2:], origin, shape)
    window[(..., *here)] = frame[(..., *there)]
    return window


def _add(frame, origin, window):
    """Adds the overlapping part of a window at `origin` to a frame (..., Ny, Nx)."""
    there, here = intersect_boxes((0, 0), frame.shape[-2:], origin, window.shape[-2:])
    frame[(..., *there)] += window[(..., *here)]
