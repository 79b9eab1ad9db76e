"""Base of all operators between pixel grids: mapping, coverage, shift, certificate."""

from __future__ import annotations

import numpy as np

from ..sky.grid import GridLike, as_grid
from ..sky.mapping import Mapping
from ..sky.validation.checks import as_float_array, check_dtype, check_instance
from ..sky.validation.observed import PSFLike, as_psf
from .linop import LinOp
from .transfer import Certificate


class GridOperator(LinOp):
    """A linear operator from images on one pixel grid to images on another.

    grid_in, grid_out (Grid): pixels of the model and of the observation, or WCS with shapes
    psf_in (1 or C bands), psf_out (1 or C bands): their PSFs, each in its own grid's pixels, or
        images accepted by `PSF`
    dtype: float32, or float64 if the device supports it
    device: see `get_device`; None = the default device
    shift (2,) [model px]: moves every observed pixel; may be set again at any time
    tolerance_px [model px]: departures up to this size are ignored when the geometry is chosen

    Images are flux per pixel, (C, Ny, Nx) or (B, C, Ny, Nx). Observed pixels whose centres are not
    on the model are 0.

    n_terms: T, the number of model images whose sum is a band, see ResamplingPlan; shape_in then
        has C * T images

    If each item has its own geometry (`Resampler.from_plans`), `mapping` and `certificate` are
    lists, `covered` is (n, My, Mx) and `shift` (n, 2); otherwise there is one of each.

    Raises ValueError for grids that do not overlap and for band counts that do not match.
    Subclasses implement `_prepare` and `_use_shift`, beside `_forward` and `_adjoint`.
    """

    is_shared = False  # True = an OperatorCache returns it to several callers
    _n_geometries = 1
    _mappings: list[Mapping]
    _certificates: list[Certificate]

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
    ):
        grid_in, grid_out = as_grid("grid_in", grid_in), as_grid("grid_out", grid_out)
        psf_in, psf_out = as_psf("psf_in", psf_in), as_psf("psf_out", psf_out)
        dtype = check_dtype(dtype)
        mapping = grid_out.map_to(grid_in, tolerance_px=tolerance_px)
        self._prepare(mapping, psf_in, psf_out, dtype, device)
        self.shift = shift

    @classmethod
    def from_mapping(
        cls,
        mapping: Mapping,
        psf_in: PSFLike,
        psf_out: PSFLike,
        *,
        dtype=np.float32,
        device=None,
        shift=(0.0, 0.0),
    ):
        """The operator of a mapping, observed pixels -> model pixels, instead of two grids."""
        check_instance("mapping", mapping, Mapping)
        psf_in, psf_out = as_psf("psf_in", psf_in), as_psf("psf_out", psf_out)
        op, dtype = cls.__new__(cls), check_dtype(dtype)
        op._prepare(mapping, psf_in, psf_out, dtype, device)
        op.shift = shift
        return op

    def _about(self):
        return (self.geometry,) + (("shifted",) if self._shift.any() else ())

    def _prepare(self, mapping, psf_in, psf_out, dtype, device):
        """Everything but the shift, from a mapping; calls `_begin` first."""
        raise NotImplementedError

    def _use_shift(self):
        """Updates the device's tables to `_shift` (n, 2)."""
        raise NotImplementedError

    def _begin(self, device, dtype, n_bands, mappings, n_terms=1):
        """The operator's shapes, from a mapping for each geometry; all alike in their shapes.

        n_terms: images of the model that each band of the observation adds up

        The caller must also set `_certificates`, one for each mapping.
        """
        self.n_terms = n_terms
        shape_in, shape_out = mappings[0].shape_in, mappings[0].shape_out
        LinOp.__init__(self, device, dtype, (n_bands * n_terms, *shape_in), (n_bands, *shape_out))
        self._mappings, self._n_geometries = list(mappings), len(mappings)

    @property
    def mapping(self) -> Mapping:
        """Mapping of the observed pixels into the model's."""
        return _one_or_all(self._mappings)

    @property
    def geometry(self) -> str:
        """Simplest geometry valid within tolerance_px: "aligned", "affine" or "distorted"."""
        return self._mappings[0].geometry

    @property
    def covered(self) -> np.ndarray:
        """Observed pixels (My, Mx) bool whose centre lies on the model."""
        masks = [mapping.covered for mapping in self._mappings]
        return masks[0] if len(masks) == 1 else np.stack(masks)

    @property
    def certificate(self) -> Certificate:
        """Findings of the set-up about the transfer function and its kernel."""
        return _one_or_all(self._certificates)

    @property
    def shift(self) -> np.ndarray:
        """Offset (2,) [model px] by which every observed pixel is moved; read-only.

        It can be set to one number, (2,), or (n, 2) for n geometries. Raises ValueError for other
        shapes, for numbers that are not finite, and for an OperatorCache's shared operators.
        """
        return self._shift[0] if len(self._shift) == 1 else self._shift

    @shift.setter
    def shift(self, shift):
        shift, expected = as_float_array("shift", shift), (self._n_geometries, 2)
        if shift.shape not in ((), (2,), expected) or not np.isfinite(shift).all():
            raise ValueError(
                f"shift is {shift.tolist()}, must be (2,) or {expected} finite numbers"
            )
        if self.is_shared and shift.any():
            raise ValueError(
                f"shift is {shift.tolist()}, must be 0 for an operator that others use too: ask "
                "the cache for one with private=True"
            )
        shift = np.broadcast_to(shift, expected).copy()
        shift.flags.writeable = False  # a change must come through this setter
        with self._lock:
            self._shift = shift
            self._use_shift()


def _one_or_all(values):
    """The only one of a list, or the list."""
    return values[0] if len(values) == 1 else values
