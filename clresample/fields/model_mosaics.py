"""Model and residual mosaics of a field, band by band, strip by strip."""

from __future__ import annotations

import numpy as np
from astropy.io import fits

from ..files.atomic import FileError, atomic_file
from ..sky.box import Box
from .memmap import create_memmap

STRIP_PX = 512  # rows of a mosaic that are read and written at a time


def write_mosaics(folder, job, parts, last):
    """Writes model_NAME.fits and residual_NAME.fits of every mosaic: cubes [counts] with its WCS.

    A model is the sum of all sources' models in the blends' cutouts; a residual is data minus it,
    the background subtracted where it was, NaN where the data are none or cannot be read.
    Of a part of a field, they are those pixels that lie on the part. Raises FileError where a file
    cannot be written.
    """
    paths = []
    core = job.reference.cutout(job.core.y0, job.core.x0, job.core.shape)
    for i_mosaic, mosaic in enumerate(job.mosaics):
        here = Box.of(mosaic.grid.shape) if not job.is_part else mosaic.box_on(core)
        if not here.area:
            continue
        shape = len(mosaic.channels), *here.shape
        scratch = folder / f".model-{i_mosaic}.npy"
        model = create_memmap(scratch, np.float32, shape)
        for i, part in enumerate(parts):
            chosen = {patch for patch, k in last.items() if k == i}
            for _, _, box, image in part.models(chosen, i_mosaic) if chosen else ():
                both = box.intersection(here)
                if both.area:
                    model[:, *both.relative_to(here).slices] += image[
                        :, *both.relative_to(box).slices
                    ]
        header = mosaic.grid.cutout(*here[:2], here.shape).to_wcs().to_header(relax=True)
        for i, channel in enumerate(mosaic.channels):
            header[f"BAND{i + 1}"] = channel.name
        for what, left in (("model", False), ("residual", True)):
            path = folder / f"{what}_{file_name(mosaic.name)}.fits"
            _write_cube(path, header, mosaic, here, model, left)
            paths.append(path)
        del model
        scratch.unlink()
    return paths


def file_name(name) -> str:
    """A mosaic's name as a part of a file's: letters, digits, - and _ stay."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)


def _write_cube(path, header, mosaic, here, model, residual):
    """A cube (C, Ny, Nx) of the Box `here`, strip by strip: the model, or the data without it."""
    cards = fits.PrimaryHDU(header=header).header
    cards["BITPIX"], cards["NAXIS"] = -32, 3
    for axis, n in enumerate(reversed(model.shape), start=1):
        cards.set(f"NAXIS{axis}", n, after=f"NAXIS{axis - 1}" if axis > 1 else "NAXIS")
    with atomic_file(path) as part:
        stream = fits.StreamingHDU(part, cards)
        for c, channel in enumerate(mosaic.channels):
            for y0 in range(0, model.shape[1], STRIP_PX):
                y1 = min(y0 + STRIP_PX, model.shape[1])
                strip = model[c, y0:y1]
                if residual:
                    box = Box(here.y0 + y0, here.x0, here.y0 + y1, here.x1)
                    strip = _read(channel, box) - strip
                stream.write(np.ascontiguousarray(strip, dtype=">f4"))
        stream.close()


def _read(channel, box):
    """Pixels of a channel; NaN where they cannot be read."""
    try:
        return channel.read(box)
    except FileError:
        return np.full(box.shape, np.nan)
