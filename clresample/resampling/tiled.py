"""Whole frames through overlapping tiles, in device memory of a stated size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tqdm import tqdm

from ..device.tuning import Tuning
from ..sky.grid import Grid
from ..sky.psf import PSF
from .linop import LinOp
from .plan import Precision, is_identity, make_plan
from .resampler import Resampler
from .tile_layout import KINDS, make_groups


class TiledResampler(LinOp):
    """The operator of `Resampler` on frames of any size, tile by tile.

        I2[tile] = R_tile I1[window]

    A window is what the tile's pixels see: where they lie and the wrap radius around, falling
    smoothly to zero at its edge, zero beyond the model's. Windows start at whole pixels, so that
    tiles with one Jacobian share an operator and differ in its shift. A distorted frame is affine
    tile by tile where tolerance_px allows.

    Against one tile, images as sharp as the model's PSF agree to 2e-6 (5e-6 where the PSF samples
    alias), which is what padding that single tile otherwise changes. White noise, sharper than the
    PSF, agrees to 1e-6 from HST to HSC, 1e-4 from Euclid to Rubin, 6e-2 between rotated equal
    pixels, whose sinc interpolation never ends.

    grid_in, psf_in, grid_out, psf_out, dtype, device, shift, tolerance_px: as in `Resampler`
    memory [bytes]: device memory to stay within; None = 1 GiB, or a quarter of what the device has
    progress: show a bar where standard error is a terminal

    Frames are NumPy arrays, (C, Ny, Nx) or (B, C, Ny, Nx), and stay on the host. Observed pixels
    whose centre the model does not cover come out as 0; `covered` (My, Mx) tells which are covered,
    `kind` the path of the worst tile, `n_tiles` how many there are, `report` what the set-up found.
    Raises ValueError for grids that do not overlap, band counts that do not match, and a memory too
    small for the smallest tile.
    """

    def __init__(
        self,
        grid_in: Grid,
        psf_in: PSF,
        grid_out: Grid,
        psf_out: PSF,
        *,
        dtype=np.float32,
        device=None,
        shift=(0.0, 0.0),
        tolerance_px=1e-4,
        memory=None,
        progress=True,
    ):
        n_bands = max(psf_in.n_bands, psf_out.n_bands)
        super().__init__(device, dtype, (n_bands, *grid_in.shape), (n_bands, *grid_out.shape))
        self.memory = Tuning.of(self.device, dtype).memory if memory is None else memory
        self.shift, self.progress = shift, progress
        self.psf_in, self.psf_out, self.precision = psf_in, psf_out, Precision.of(dtype)
        self.groups = make_groups(
            grid_in,
            psf_in,
            grid_out,
            psf_out,
            precision=self.precision,
            tolerance_px=tolerance_px,
            memory=self.memory,
        )
        self._built = None, None

    @property
    def shift(self):
        """Offset (2,) [model px] by which every observed pixel is moved."""
        return self._shift

    @shift.setter
    def shift(self, shift):
        self._shift = np.broadcast_to(np.asarray(shift, np.float64), 2).copy()

    @property
    def n_tiles(self):
        return sum(len(group.tiles) for group in self.groups)

    @property
    def tile_shape(self):
        """Shape (My, Mx) [observed px] of every tile."""
        return self.groups[0].mapping.shape_out

    @property
    def kind(self):
        return max((group.mapping.kind for group in self.groups), key=KINDS.index)

    @property
    def covered(self):
        """Observed pixels (My, Mx) whose centre lies on the model."""
        covered = np.zeros(self.shape_out[1:], bool)
        for group in self.groups:
            for tile in group.tiles:
                covered[_box(tile.origin, tile.mask.shape)] |= tile.mask
        return covered

    @property
    def report(self):
        """What the set-up of the first tile found (see Plan.report)."""
        return self._operator(self.groups[0]).report

    def _apply(self, run, name, x, out, shape_x, shape_out):
        if hasattr(x, "base_data"):
            raise ValueError(f"{name} is on the device: frames in tiles are NumPy arrays")
        x = np.asarray(x, self.dtype)
        lead = x.shape[: max(x.ndim - 3, 0)]
        if x.ndim == 2 and shape_x[0] == 1 and x.shape == shape_x[1:]:
            shape_result = shape_out[1:]
        elif len(lead) < 2 and x.shape == (*lead, *shape_x):
            shape_result = (*lead, *shape_out)
        else:
            raise ValueError(f"{name} has shape {x.shape}, expected {shape_x} or (B,) + {shape_x}")
        if out is None:
            out = np.empty(shape_result, self.dtype)
        elif out.shape != shape_result:
            raise ValueError(f"out has shape {out.shape}, expected {shape_result}")
        out[...] = 0
        frames = x.reshape(-1, *shape_x), out.reshape(-1, *shape_out)
        run(*frames)
        if not np.shares_memory(frames[1], out):
            out[...] = frames[1].reshape(shape_result)
        return out

    def _forward(self, x, out):
        for op, tile, origin in self._steps():
            part = out[(..., *_box(tile.origin, tile.mask.shape))]
            for frame, target in zip(x, part, strict=True):
                window = _cut(frame, origin, op.shape_in[1:] if op else tile.mask.shape)
                np.copyto(target, op(window) if op else window, where=tile.mask)

    def _adjoint(self, y, out):
        for op, tile, origin in self._steps():
            part = y[(..., *_box(tile.origin, tile.mask.shape))]
            for piece, frame in zip(part, out, strict=True):
                _add(frame, origin, op.adjoint(piece * tile.mask) if op else piece * tile.mask)

    def _steps(self):
        """Each tile, its operator with its shift, and the first pixel of its window.

        Where pixels and PSF are the same the operator is None: the window is the tile.
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
                    place = tile.place + self.shift
                    first = place + group.mapping.offset
                    if self._copies(group) and (first == np.rint(first)).all():
                        yield None, tile, first.astype(int)
                    else:
                        op, origin = self._operator(group), np.rint(place).astype(int)
                        if (op.shift != place - origin).any():
                            op.shift = place - origin
                        yield op, tile, origin
                    bar.update()

    def _copies(self, group):
        """Whether a tile is its window's middle, but for a shift."""
        shape = group.mapping.shape_out
        mapping = replace(group.mapping, shape_in=shape, offset=np.zeros(2))
        return is_identity(mapping, self.psf_in, self.psf_out)

    def _operator(self, group):
        """The operator of a group; the last one is kept, for one must fit the memory."""
        if self._built[0] is not group:
            self._built = None, None
            plan = make_plan(group.mapping, self.psf_in, self.psf_out, precision=self.precision)
            y, x = (group.taper[axis] for axis in plan.axes)
            plan = replace(plan, in_y=plan.in_y * y, in_x=plan.in_x * x)
            op = Resampler.from_plans([plan], dtype=self.dtype, device=self.device)
            self._built = group, op
        return self._built[1]


def _box(origin, shape):
    return tuple(slice(start, start + n) for start, n in zip(origin, shape, strict=True))


def _meet(frame, origin, shape):
    """Where a window and a frame (..., Ny, Nx) meet: slices of the frame, slices of the window."""
    low = np.maximum(origin, 0)
    high = np.maximum(np.minimum(np.add(origin, shape), frame.shape[-2:]), low)
    return (..., *_box(low, high - low)), (..., *_box(low - origin, high - low))


def _cut(frame, origin, shape):
    """The window of a frame (..., Ny, Nx) from `origin` on, zero beyond its edges."""
    window = np.zeros((*frame.shape[:-2], *shape), frame.dtype)
    there, here = _meet(frame, origin, shape)
    window[here] = frame[there]
    return window


def _add(frame, origin, window):
    """Add a window to a frame (..., Ny, Nx) from `origin` on, as far as they meet."""
    there, here = _meet(frame, origin, window.shape[-2:])
    frame[there] += window[here]
