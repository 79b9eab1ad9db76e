"""Operators from a model frame to observations, made once for each geometry."""

from __future__ import annotations

import functools
import hashlib

import numpy as np

from ..device.device import get_device
from ..sky.frame import Frame
from ..sky.grid import Grid
from ..sky.psf import PSF
from .plan import Plan, Precision, make_plan
from .resampler import Resampler

# Geometries kept: those of one survey tile's epochs and bands; plans take a few MB each.
N_PLANS, N_OPERATORS = 256, 32


class _Recipe:
    """What a plan is made of, equal to another of the same bytes."""

    def __init__(self, mapping, psf_in, psf_out, dtype, extent):
        self.mapping, self.psf_in, self.psf_out = mapping, psf_in, psf_out
        self.precision, self.extent = Precision.of(dtype), extent
        digest = hashlib.sha256()
        parts = [mapping.matrix, mapping.offset, mapping.positions, mapping.area]
        for psf in (psf_in, psf_out):
            parts += [psf.images, psf.center, np.float64(psf.spacing)]
        for part in parts:
            digest.update(b"-" if part is None else np.ascontiguousarray(part).tobytes())
        self.key = (
            mapping.kind,
            mapping.shape_in,
            mapping.shape_out,
            extent,
            np.dtype(dtype).str,
            tuple(p.images.shape for p in (psf_in, psf_out)),
            digest.digest(),
        )

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return self.key == other.key


@functools.lru_cache(maxsize=N_PLANS)
def _plan(recipe: _Recipe) -> Plan:
    return make_plan(
        recipe.mapping,
        recipe.psf_in,
        recipe.psf_out,
        precision=recipe.precision,
        extent=recipe.extent,
    )


@functools.lru_cache(maxsize=N_OPERATORS)
def _operator(recipe: _Recipe, dtype, device) -> Resampler:
    return Resampler.from_plans([_plan(recipe)], dtype=dtype, device=device)


def cached_resampler(
    frame: Frame, grid: Grid, psf: PSF, *, dtype, device=None, extent=None, private=False
) -> Resampler:
    """The Resampler from `frame` to `grid` and `psf`; asked twice it is the same object.

    extent (2,) [px]: what of the frame holds light, the rest is padding; None = all of it
    private: an operator of the caller's own, whose shift may be set, on the same plan
    """
    recipe = _Recipe(grid.map_to(frame.grid), frame.psf, psf, dtype, extent)
    device, dtype = get_device(device), np.dtype(dtype)
    if private:
        return Resampler.from_plans([_plan(recipe)], dtype=dtype, device=device)
    return _operator(recipe, dtype, device)
