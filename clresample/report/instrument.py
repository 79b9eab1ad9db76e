"""An instrument's model and residual mosaics in a run's folder, read strip by strip."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files.atomic import FileError
from ..files.fits import celestial_header, open_fits
from ..sky.box import Box
from ..sky.grid import Grid

SAMPLE_ROWS = 64  # rows of a mosaic from which noise and stretch are found, spread evenly
# [sigma] A column of a strip with a larger median is dead. Light missing in a model is never as
# bright over half a strip.
DEAD_SIGMAS = 20.0


@dataclass(frozen=True, eq=False)
class Instrument:
    """An instrument of a run: the files model_NAME.fits and residual_NAME.fits.

    name; channels (C,); grid: Grid of (Ny, Nx)
    noise_sigma (C,) [counts]: scatter of the residuals, 1.4826 times the median of their distance
        from their median: that of a pixel's noise where most pixels are sky
    sample (C, L) [counts]: some pixels of the model
    """

    name: str
    channels: tuple[str, ...]
    grid: Grid
    model: Path
    residual: Path
    noise_sigma: np.ndarray
    sample: np.ndarray

    @contextmanager
    def opened(self):
        """A function of a Box that reads (model, residual) (C, Ny, Nx) [counts].

        Residuals of dead columns are NaN. Raises FileError.
        """
        with open_fits(self.model) as models, open_fits(self.residual) as residuals:

            def read(box):
                given = (self.model, models), (self.residual, residuals)
                return [_section(path, hdus, box) for path, hdus in given]

            yield read

    def dead(self, residual):
        """(C, 1, Nx) bool: the columns of a strip of residuals that hold no sky."""
        if not residual.size:
            return np.zeros((len(self.noise_sigma), 1, residual.shape[2]), bool)
        middle = np.median(np.abs(np.nan_to_num(residual)), axis=1, keepdims=True)
        return middle > DEAD_SIGMAS * self.noise_sigma[:, None, None]


def instruments_in(folder, notes, names):
    """The instruments of a folder, smallest pixels first; unreadable ones get a note.

    names: {part of a file's name: name of the mosaic}, as far as they are known
    """
    found = []
    for residual in sorted(folder.glob("residual_*.fits")):
        name = residual.stem.removeprefix("residual_")
        model = folder / f"model_{name}.fits"
        try:
            found.append(_instrument(names.get(name, name), model, residual))
        except FileError as error:
            notes.append(f"no images of {name}: {error}")
    return sorted(found, key=lambda one: (one.grid.pixel_scale_arcsec, one.name))


def _instrument(name, model, residual):
    with open_fits(residual) as hdus, open_fits(model) as models:
        header = hdus[0].header
        shape = hdus[0].shape
        if len(shape) != 3 or 0 in shape or models[0].shape != shape:
            raise FileError(f"{residual}: is not a cube of the shape of {model.name}")
        channels = tuple(str(header.get(f"BAND{i + 1}", i)) for i in range(shape[0]))
        grid = Grid.from_wcs(celestial_header(residual, header, hdus), shape)
        rows = np.unique(np.linspace(0, shape[1] - 1, SAMPLE_ROWS).astype(int))
        left, light = (
            np.stack(
                [_section(path, one, Box(y, 0, y + 1, shape[2]))[:, 0] for y in rows.tolist()],
                axis=1,
            )
            for path, one in ((residual, hdus), (model, models))
        )
    flat = left.reshape(len(left), -1)
    middle = np.array([np.nanmedian(c) if np.isfinite(c).any() else 0.0 for c in flat])
    away = np.abs(flat - middle[:, None])
    sigma = np.array([1.4826 * np.nanmedian(c) if np.isfinite(c).any() else 0.0 for c in away])
    sigma = np.where(sigma > 0, sigma, 1.0)
    return Instrument(name, channels, grid, model, residual, sigma, light.reshape(len(light), -1))


def _section(path, hdus, box):
    """Pixels (C, Ny, Nx) of a file's cube, float32, native; those alone are read."""
    rows, columns = box.slices
    try:
        found = np.asarray(hdus[0].section[:, rows, columns], np.float32)
    except Exception as error:  # of two open files each would take it for its own
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: its pixels cannot be read ({reason})") from error
    if found.shape[1:] != box.shape:
        raise FileError(f"{path}: truncated, {found.shape[1:]} pixels of {box.shape}")
    return found
