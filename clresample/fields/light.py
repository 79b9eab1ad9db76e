"""The models of a finished field as light on windows of its mosaics."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ..resampling.resampler import Resampler
from ..sky.box import Box
from ..sky.frame import model_psf
from ..sky.grid import Grid
from ..sky.psf_checks import PSFWarning
from .models import ModelFile

# [FWHM of the PSF] Distance beyond a model's box up to which its light is rendered.
REACH_FWHM = 3.0
# [bytes] Images that are rendered in one call: more would not be faster.
BATCH_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class ModelLight:
    """Renders the models of a field on windows of its mosaics.

    models: ModelFile; mosaics: of the field; reference: Grid of the models' pixels; device: as
    `get_device` takes it
    """

    models: ModelFile
    mosaics: tuple
    reference: Grid
    device: object = None

    def channels(self, i_mosaic):
        """The part of all channels that a mosaic has."""
        start = sum(len(m.channels) for m in self.mosaics[:i_mosaic])
        return slice(start, start + len(self.mosaics[i_mosaic].channels))

    def window_about(self, i_mosaic, components, reach):
        """The pixels of a mosaic about the boxes of some components: a Box.

        Its area is 0 if the mosaic's projection does not contain them.
        """
        models, mosaic = self.models, self.mosaics[i_mosaic]
        low, high = models.low[components].min(axis=0), models.high[components].max(axis=0)
        corners = _corners(low - 0.5, high - 0.5)
        at = self.reference.positions_in(mosaic.grid, *corners)
        if not np.isfinite(at).all():
            return Box(0, 0, 0, 0)
        return Box.around(at).grown(int(np.ceil(reach)) + 1)

    def images(self, i_mosaic, window, own, psf, grid):
        """{id: model (C, ny, nx) [counts]} of all sources with light on a window of a mosaic."""
        models, mosaic = self.models, self.mosaics[i_mosaic]
        low, high = np.array(window[:2]) - 0.5, np.array(window[2:]) - 0.5
        seen = Box.around(mosaic.grid.positions_in(self.reference, *_corners(low, high)))
        scale = mosaic.grid.pixel_scale_arcsec / self.reference.pixel_scale_arcsec
        reach = int(np.ceil(REACH_FWHM * float(psf.fwhm_px.max()) * scale)) + 1
        near = seen.grown(reach)
        meet = (models.low < near[2:]).all(axis=1) & (models.high > near[:2]).all(axis=1)
        meet[own] = True
        chosen = np.flatnonzero(meet)
        box = seen.grown(1)
        for i in chosen:
            box = box.union(Box(*models.low[i].tolist(), *models.high[i].tolist()))
        found: dict[int, np.ndarray] = {}
        by_shift: dict[tuple, list] = {}
        for i in chosen.tolist():
            by_shift.setdefault(models.shift(i, i_mosaic), []).append(i)
        frame = self.reference.cutout(box.y0, box.x0, box.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)  # the field run has warned
            op = Resampler(frame, model_psf(), grid, psf, device=self.device)
        n_at_once = max(1, BATCH_BYTES // (4 * psf.n_bands * box.area))
        for shift, components in by_shift.items():
            op.shift = shift
            sources = list(dict.fromkeys(models.table["id"][components].tolist()))
            for start in range(0, len(sources), n_at_once):
                some = sources[start : start + n_at_once]
                light = self._light(some, components, box, i_mosaic)
                found |= zip(some, op(light).astype(np.float64), strict=True)
        return found

    def _light(self, sources, components, box, i_mosaic):
        """Models (n, C, Ny, Nx) [counts] of sources on a Box of the field's model pixels."""
        models, channels = self.models, self.channels(i_mosaic)
        light = np.zeros((len(sources), channels.stop - channels.start, *box.shape), np.float32)
        for i in components:
            one = int(models.table["id"][i])
            if one in sources:
                (y0, x0), (y1, x1) = models.low[i] - box[:2], models.high[i] - box[:2]
                spectrum = np.nan_to_num(models.spectra[i, channels])
                image = spectrum[:, None, None] * models.morphology(i)
                light[sources.index(one), :, y0:y1, x0:x1] += image.astype(np.float32)
        return light

    def flux(self, one, i_mosaic):
        """Fluxes (C,) [counts] of a source's model."""
        models, channels = self.models, self.channels(i_mosaic)
        total = np.zeros(channels.stop - channels.start)
        for i in np.flatnonzero(models.table["id"] == one):
            total += np.nan_to_num(models.spectra[i, channels]) * models.morphology(i).sum()
        return total


def _corners(low, high):
    """Rows and columns (4,) of the corners of a box (2,), (2,)."""
    return np.array([low[0], low[0], high[0], high[0]]), np.array(
        [low[1], high[1], low[1], high[1]]
    )
