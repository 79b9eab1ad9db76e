"""Model and residual mosaics of a field, band by band, strip by strip."""

from __future__ import annotations

import numpy as np
from astropy.io import fits

from ..files.whole_file import FileError, whole_file
from .box import Box

STRIP_PX = 512  # rows of a mosaic that are read and written at a time


def write_mosaics(folder, job, parts, last):
    """Write model_NAME.fits and residual_NAME.fits of every mosaic: cubes [counts] with its WCS.

    A model is the sum of all sources' models in the blends' cutouts; a residual is data minus it,
    the background subtracted where it was, NaN where the data are none or cannot be read.
    Raises FileError where a file cannot be written.
    """
    paths = []
    for i_mosaic, mosaic in enumerate(job.mosaics):
        shape = len(mosaic.channels), *mosaic.grid.shape
        scratch = job.folder / f"model-{i_mosaic}.npy"
        model = np.lib.format.open_memmap(scratch, "w+", np.float32, shape)
        for i, part in enumerate(parts):
            chosen = {patch for patch, k in last.items() if k == i}
            for _, i_model, box, image in part.models(chosen):
                if i_model == i_mosaic:
                    model[:, *box.slices] += image
        header = mosaic.grid.to_wcs().to_header(relax=True)
        for i, channel in enumerate(mosaic.channels):
            header[f"BAND{i + 1}"] = channel.name
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in mosaic.name)
        for what, left in (("model", False), ("residual", True)):
            path = folder / f"{what}_{name}.fits"
            _write_cube(path, header, mosaic, model, left)
            paths.append(path)
        del model
        scratch.unlink()
    return paths


def _write_cube(path, header, mosaic, model, residual):
    """A cube (C, Ny, Nx) written strip by strip: the model, or the data without it."""
    cards = fits.PrimaryHDU(header=header).header
    cards["BITPIX"], cards["NAXIS"] = -32, 3
    for axis, n in enumerate(reversed(model.shape), start=1):
        cards.set(f"NAXIS{axis}", n, after=f"NAXIS{axis - 1}" if axis > 1 else "NAXIS")
    with whole_file(path) as part:
        stream = fits.StreamingHDU(part, cards)
        for c, channel in enumerate(mosaic.channels):
            for y0 in range(0, model.shape[1], STRIP_PX):
                box = Box(y0, 0, min(y0 + STRIP_PX, model.shape[1]), model.shape[2])
                strip = model[c, *box.slices]
                if residual:
                    strip = _read(channel, box) - strip
                stream.write(np.ascontiguousarray(strip, dtype=">f4"))
        stream.close()


def _read(channel, box):
    """Pixels of a channel; NaN where they cannot be read, which the blends there say too."""
    try:
        return channel.read(box)
    except FileError:
        return np.full(box.shape, np.nan)
