"""Validates the arguments of an Observation and converts them to one form."""

from __future__ import annotations

import numpy as np

from ..grid import as_grid
from ..noise import mask_from
from ..psf import PSF
from ..varying_psf.derived import RepeatedPSF
from ..varying_psf.field import PSFField
from .checks import as_float_array, check_instance, split_mask


def images_of(data, grid, mask):
    """Validates data (C, Ny, Nx), mask and grid: float64 data of the grid's size.

    The mask returned includes the data's own; the grid is made from a WCS where one is passed.
    """
    data, hidden = split_mask("data", data)
    data = as_float_array("data", data)
    if data.ndim == 2:
        data = data[None]
    if data.ndim != 3 or 0 in data.shape:
        raise ValueError(f"data must be (C, Ny, Nx) or (Ny, Nx), not {data.shape}")
    grid = as_grid("grid", grid, data.shape)
    if data.shape[1:] != tuple(grid.shape):
        raise ValueError(f"data has images of {data.shape[1:]} pixels, grid has {grid.shape}")
    return data, mask if hidden is None else mask_from(mask, data.shape) | hidden, grid


def psfs_of(psf, shape):
    """psf and psf_field of images (C, Ny, Nx), one band a channel, a single one serving all."""
    n_channels = shape[0]
    psf = as_psf("psf", psf, (PSF, PSFField))
    if psf.n_bands not in (1, n_channels):
        raise ValueError(
            f"psf has {psf.n_bands} bands, data have {n_channels} channels: "
            "give one band, or one for each channel"
        )
    if isinstance(psf, PSF):
        psf = psf if psf.n_bands == n_channels else psf.select([0] * n_channels)
        return {"psf": psf, "psf_field": None}
    if psf.n_bands != n_channels:
        psf = RepeatedPSF(psf, n_channels)
    middle = psf.psf_at((shape[1] - 1) / 2, (shape[2] - 1) / 2)
    return {"psf": middle, "psf_field": psf if psf.varies else None}


def channels_of(channels, name, n_channels):
    """Channel names (C,); by default the instrument's name and a number."""
    if channels is None:
        return tuple(f"{name or 'channel'}{i}" for i in range(n_channels))
    channels = (channels,) if isinstance(channels, str) else tuple(channels)
    if len(channels) != n_channels:
        raise ValueError(f"channels has {len(channels)} names, data have {n_channels} channels")
    if not all(isinstance(channel, str) and channel for channel in channels):
        raise ValueError(f"channels must be names, not {channels}")
    if len(set(channels)) < n_channels:
        raise ValueError(f"channels must be unique, not {channels}")
    return channels


def bands_of(bands, channels):
    """Band names (C,) of channels; by default the channels' names."""
    if bands is None:
        return channels
    bands = (bands,) if isinstance(bands, str) else tuple(bands)
    if len(bands) != len(channels) or not all(isinstance(b, str) and b for b in bands):
        raise ValueError(f"bands is {bands}, must be {len(channels)} names, one for each channel")
    return bands


# A PSF, or its images.
PSFLike = PSF | np.ndarray


def as_psf(name, psf, kinds=PSF):
    """Returns the PSF, made from images if passed. Raises ValueError for anything else."""
    if isinstance(psf, np.ndarray) or (isinstance(psf, list | tuple) and len(psf)):
        return PSF(psf)
    return check_instance(name, psf, kinds)


def saturation_of(values, n_channels, unit=None):
    """Saturation levels (C,) [counts] above 0, infinite where unknown; None for None.

    unit: of the data, to which levels with a unit are converted
    """
    if values is None:
        return None
    values = as_float_array("saturation", values, unit)
    if values.shape not in ((), (n_channels,)) or not (values > 0).all():
        raise ValueError(
            f"saturation is {values}, must be above 0, one number or {n_channels}: give infinity "
            "where it is unknown"
        )
    values = np.broadcast_to(values, n_channels).copy()
    values.flags.writeable = False
    return values


def per_channel(name, values, n_channels):
    """Finite numbers (C,), from one for each channel or one for all; None for None."""
    if values is None:
        return None
    values = as_float_array(name, values)
    if values.shape not in ((), (n_channels,)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be one finite number or {n_channels}, one for each channel, not {values}"
        )
    values = np.broadcast_to(values, n_channels).copy()
    values.flags.writeable = False
    return values
