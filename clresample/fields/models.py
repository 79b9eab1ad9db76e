"""The models of all sources in one file, from which those of one blend are read alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.table import Table

from ..files.fits import open_fits
from ..files.whole_file import FileError, whole_file
from .work.part import COMPONENT_COLUMNS

FORMAT = 1  # of the file; raised when an older reader would misread it


@dataclass(frozen=True, eq=False)
class Model:
    """One component of a source's model.

    id, parent_id: as in the catalogue; origin (2,) [px]: (y, x) of its first pixel in the field's
        model pixels
    morphology (ny, nx) [1]: its image under the model's PSF, with maximum 1
    spectrum (C,) [counts]: flux per model pixel where the morphology is 1; NaN in channels that do
        not see it
    """

    id: int
    parent_id: int
    origin: tuple[int, int]
    morphology: np.ndarray
    spectrum: np.ndarray


def write_models(path, job, parts, last, ids):
    """Write the models of the sources with these ids, sorted by their blends.

    HDUs: COMPONENTS, a row for each with COMPONENT_COLUMNS, offset being its first pixel in
    MORPHOLOGIES, and the spectrum; MORPHOLOGIES, one float32 array of all pixels.
    """
    rows, spectra, flat = [], [], []
    for i, part in enumerate(parts):
        table, pixels, their = part.read("COMPONENTS", "MORPHOLOGIES", "SPECTRA")
        numbers = np.stack([table[name] for name in COMPONENT_COLUMNS], axis=1).tolist()
        for row, spectrum in zip(numbers, their, strict=True):
            source, _, patch, *_, n_y, n_x, start = row
            if last.get(patch) == i and source in ids:
                rows.append(row)
                spectra.append(spectrum)
                flat.append(pixels[start : start + n_y * n_x])
    order = sorted(range(len(rows)), key=lambda k: (rows[k][1], rows[k][0], k))
    table = np.array([rows[k] for k in order], np.int64).reshape(-1, len(COMPONENT_COLUMNS))
    sizes = table[:, 5] * table[:, 6]
    table[:, 7] = np.cumsum(sizes) - sizes
    columns = Table(table, names=COMPONENT_COLUMNS)
    columns["spectrum"] = np.array([spectra[k] for k in order]).reshape(
        len(order), len(job.channels)
    )
    primary, hdu = fits.PrimaryHDU(), fits.table_to_hdu(columns)
    primary.header["CLFORMAT"] = (FORMAT, "of this file")
    for i, name in enumerate(job.channels):
        primary.header[f"BAND{i + 1}"] = (name, f"spectrum {i + 1}")
    hdu.name = "COMPONENTS"
    image = fits.ImageHDU(np.concatenate([flat[k] for k in order]) if order else None)
    image.name = "MORPHOLOGIES"
    with whole_file(path) as part:
        fits.HDUList([primary, hdu, image]).writeto(part, overwrite=True)
    return path


def read_models(path, parent_id=None) -> list[Model]:
    """The models of one blend, or of all; of the pixels, only theirs are read.

    Raises FileError for a file without models, or without this blend.
    """
    with open_fits(path) as hdus:
        if "COMPONENTS" not in hdus or "CLFORMAT" not in hdus[0].header:
            raise FileError(f"{path}: holds no models of a field")
        if hdus[0].header["CLFORMAT"] > FORMAT:
            raise FileError(
                f"{path}: has format {hdus[0].header['CLFORMAT']}, this version reads {FORMAT}"
            )
        table = hdus["COMPONENTS"].data
        chosen = np.arange(len(table))
        if parent_id is not None:
            chosen = np.flatnonzero(np.asarray(table["parent_id"]) == parent_id)
            if not len(chosen):
                raise FileError(f"{path}: no blend has the parent_id {parent_id}")
        found = []
        for row in table[chosen]:
            start, shape = int(row["offset"]), (int(row["n_y"]), int(row["n_x"]))
            pixels = hdus["MORPHOLOGIES"].section[start : start + shape[0] * shape[1]]
            found.append(
                Model(
                    int(row["id"]),
                    int(row["parent_id"]),
                    (int(row["y0"]), int(row["x0"])),
                    np.array(pixels, np.float32).reshape(shape),
                    np.array(row["spectrum"], float),
                )
            )
    return found
