"""Rebuilds single sources of a finished field without their neighbours.

Pixels, weights and PSFs are read from the mosaics of the run, models from models.fits, errors of
fluxes from the catalogue. The operator of the fits renders a window around a source: all models
that reach into it, of any blend, with the PSF at the source.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from ..deblending.cutouts.choice import MissingSource, chosen_observation
from ..deblending.cutouts.cutout import as_ccddata
from ..deblending.cutouts.separation import Separation, check_kind, separation_of
from ..deblending.cutouts.window import sized_window, window_of
from ..device.multi_device import one_blas_thread
from ..files.atomic import FileError
from ..files.fits import open_fits
from ..sky.box import Box
from .field_toml.field_file import read_field
from .light import REACH_FWHM, ModelLight
from .models import ModelFile
from .reference import reference_grid
from .sky_level import without_sky

PROVENANCE = "provenance.json"


class FieldCutouts:
    """Cutouts of the sources of a finished run over a field.

    folder: written by `run_field` or `clresample field`
    mosaics: those of the run; None = those of its field file, which is named in provenance.json
    device: see `get_device`

    Attributes: ids (S,) int64 and group_ids (S,) of the catalogue; mosaics; notes: messages for the
    user, one line each

    Raises FileError for a folder without a finished run, and for inputs that are missing or have
    other names; ImportError as `read_field` does.
    """

    def __init__(self, folder, mosaics=None, *, device=None):
        self.folder, self.notes = Path(folder), []
        if not self.folder.is_dir():
            raise FileError(f"{folder}: no such folder")
        catalogue = self.folder / "catalogue.fits"
        if not catalogue.is_file():
            raise FileError(f"{folder}: holds no finished run of `clresample field`")
        with open_fits(catalogue) as hdus:
            table = hdus[1].data
            self._columns = {
                name: np.array(table[name])
                for name in table.names
                if name in ("id", "group_id", "y", "x", "status") or name.startswith("flux_err_")
            }
        self.ids = self._columns["id"].astype(np.int64)
        self.group_ids = self._columns.get("group_id", self.ids).astype(np.int64)
        self._row = {one: row for row, one in enumerate(self.ids.tolist())}
        self._models = ModelFile(self.folder / "models.fits")
        about = self._provenance()
        mosaics = tuple(self._read_mosaics(about) if mosaics is None else mosaics)
        self.mosaics = without_sky(mosaics, about.get("sky_levels", {}))
        names = tuple(c.name for m in self.mosaics for c in m.channels)
        if names != self._models.channels:
            raise FileError(
                f"{folder}: is a run over the channels {', '.join(map(str, self._models.channels))}"
                f", the mosaics have {', '.join(names)}: give those that it was run with"
            )
        self._reference = reference_grid(self.mosaics)
        self._light = ModelLight(self._models, self.mosaics, self._reference, device)

    def _read_mosaics(self, about):
        """Reads the mosaics of the run's field file; about: the run's provenance."""
        try:
            given = Path(about["inputs"]["field"]["file"])
        except (KeyError, TypeError):
            raise FileError(
                f"{self.folder / PROVENANCE}: names no field file: give the mosaics that the run "
                "was made with"
            ) from None
        places = [given, self.folder.absolute().parent / given.name, self.folder / given.name]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise FileError(
                f"{self.folder / PROVENANCE}: its field file {given} is not there: put it back, or "
                "give the mosaics"
            )
        field = read_field(found)
        self._note_changes(about, field.inputs)
        return field.mosaics

    def _provenance(self) -> dict:
        """The provenance of the run; empty if it is not there."""
        try:
            found = json.loads((self.folder / PROVENANCE).read_text())
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def _note_changes(self, about, inputs):
        """Records inputs whose size or date differs from those of the run."""
        known = (about.get("run") or {}).get("inputs") or {}
        for path in map(str, inputs.values()):
            state = os.stat(path) if os.path.exists(path) else None
            if path in known and (
                state is None or known[path] != [state.st_size, state.st_mtime_ns]
            ):
                self.notes.append(f"{path} has changed since the run: models may not belong to it")

    def cutout(self, source, observation, what="data", *, size=None, unit=None, group=False):
        """Cuts out a source without its neighbours in the pixels of a mosaic.

        source: id of the catalogue, or several that are cut out as one
        observation: number or name of a mosaic, or the name of a channel
        what, size, unit: see `Result.cutout`
        group: cut out all sources of the source's group (group_id) as one

        The standard deviation of "data" is that of the noise and of the neighbours' fluxes: flux
        errors of the catalogue times the models' shapes, neighbours being independent.
        Images are those of the input, minus its background if the run subtracted it.

        Raises ValueError for an unknown id, a source without a model or without data there, and as
        `Result.cutout` does; FileError for pixels that cannot be read.
        """
        check_kind(what)
        ids = self._chosen(source, group)
        i_mosaic, channel = chosen_observation(self._labels, observation)
        found, o, first = self.separate(ids, i_mosaic, size=size)
        name = "+".join(map(str, ids))
        given = {"channel": channel, "unit": unit, "name": name, "first": first}
        return as_ccddata(found, o, (0, 0), what, **given)

    @property
    def _labels(self):
        """Names of mosaics and channels, as `chosen_observation` expects them."""
        return [_MosaicNames(m) for m in self.mosaics]

    def _chosen(self, source, group):
        ids = [int(one) for one in np.atleast_1d(source)]
        for one in ids:
            if one not in self._row:
                raise ValueError(f"source is {one}, must be an id of {self.folder}")
        if group:
            groups = self.group_ids[[self._row[one] for one in ids]]
            ids = self.ids[np.isin(self.group_ids, groups)].tolist()
        if not ids:
            raise ValueError("source is empty, must be an id or several")
        return ids

    @one_blas_thread()
    def separate(self, ids, i_mosaic, *, size=None) -> tuple[Separation, object, tuple[int, int]]:
        """The Separation of sources with these ids, its Observation, and its first pixel.

        i_mosaic: number of the mosaic; size: see `Result.cutout`
        """
        mosaic, models = self.mosaics[i_mosaic], self._models
        own = np.flatnonzero(np.isin(models.table["id"], ids))
        rows = [self._row[one] for one in ids]
        if not len(own):
            status = self._columns["status"][rows[0]]
            raise MissingSource(f"source {ids[0]} has no model: its fit ended as {str(status)!r}")
        position = self._position(mosaic, rows)
        psf = mosaic.psf.psf_at(*position)
        n_channels = len(mosaic.channels)
        psf = psf if psf.n_bands == n_channels else psf.select([0] * n_channels)
        fwhm = float(psf.fwhm_px.max())
        whole = Box.of(mosaic.grid.shape)
        if size is None:
            wide = self._light.window_about(i_mosaic, own, REACH_FWHM * fwhm).intersection(whole)
        else:
            wide = Box(*sized_window(size, position, mosaic.grid.pixel_scale_arcsec))
        window = wide.intersection(whole)
        o = mosaic.observation(window) if window.area else None
        if o is None:
            raise MissingSource(f"source {ids[0]} has no pixel with a weight in {mosaic.name!r}")
        images = self._light.images(i_mosaic, window, own, psf, o.grid)
        sky = models.sky(own[0])[self._light.channels(i_mosaic), None, None]
        given = o.data - sky, o.weights, images, set(ids)
        errors = self._errors(images, set(ids), o, i_mosaic)
        found = separation_of(*given, errors, joint=False)
        if size is not None:
            before = window.y0 - wide.y0, window.x0 - wide.x0
            padded = found.padded(before, wide.shape)
            grid = mosaic.grid.cutout(wide.y0, wide.x0, wide.shape)
            return padded, _CutoutObservation(o, grid, mosaic, psf), (wide.y0, wide.x0)
        local = position - np.array(window[:2])
        inner = Box(*window_of(found.own, o.weights, local, fwhm))
        if not inner.area:
            raise MissingSource(f"source {ids[0]} lies outside of {mosaic.name!r}")
        first = window.y0 + inner.y0, window.x0 + inner.x0
        grid = mosaic.grid.cutout(*first, inner.shape)
        return found.part(inner.slices), _CutoutObservation(o, grid, mosaic, psf), first

    def _position(self, mosaic, rows):
        """(y, x) [px] of the middle of some sources in a mosaic."""
        y, x = (self._columns[name][rows] for name in ("y", "x"))
        at = self._reference.positions_in(mosaic.grid, y, x)
        middle = (at.min(axis=0) + at.max(axis=0)) / 2
        if not np.isfinite(middle).all():
            raise MissingSource(f"source {self.ids[rows[0]]} has no place in {mosaic.name!r}")
        return middle

    def _errors(self, images, ids, observation, i_mosaic):
        """Deviations (K, C, ny, nx) of own and other sources: one row each, its flux error."""
        shape = (len(images), *observation.shape)
        own, others = np.zeros((2, *shape))
        bands = [c.band or c.name for c in self.mosaics[i_mosaic].channels]
        scale = observation.flux_scale
        scale = np.ones(shape[1]) if scale is None else scale
        for k, (one, image) in enumerate(images.items()):
            row = self._row.get(one)
            if row is None:
                continue
            error = np.array([float(self._columns[f"flux_err_{b}"][row]) for b in bands]) / scale
            flux = self._light.flux(one, i_mosaic)
            good = np.isfinite(error) & (flux > 0)
            part = np.where(good, error / np.where(good, flux, 1), 0)
            (own if one in ids else others)[k] = np.where(good, part, 0)[:, None, None] * image
        return own, others


class _MosaicNames:
    """A mosaic's name and channels, for `chosen_observation`."""

    def __init__(self, mosaic):
        self.name, self.channels = mosaic.name, tuple(c.name for c in mosaic.channels)


class _CutoutObservation:
    """Properties of an observation for `as_ccddata`: the grid of a cutout, the source's PSF."""

    psf_field = None

    def __init__(self, observation, grid, mosaic, psf):
        self.grid, self.label = grid, mosaic.name
        self.channels, self.zero_points = observation.channels, observation.zero_points
        self.flux_scale = observation.flux_scale
        self.psf, self.shape = psf, (len(self.channels), *grid.shape)
