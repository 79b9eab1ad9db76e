"""Drizzled images of the James Webb Space Telescope: stage 3 products, *_i2d.fits.

One file a band, with the HDUs

    PRIMARY   INSTRUME, FILTER and PUPIL
    SCI       the image, BUNIT MJy/sr and PIXAR_SR, the area of a pixel: the AB zero point
    ERR       standard deviation of each pixel; NaN or 0 where there are no data
    CON       contexts (n, Ny, Nx): which images went into a pixel; none means: ignore
    WHT       weights of the drizzle; 0 means: ignore
    ASDF      the tree of metadata, whose meta.wcs is the gwcs

The gwcs places the pixels where gwcs is installed (the extra `jwst`); else the header's WCS does,
with a note. Resampling correlates the noise of neighbouring pixels, which ERR does not include: its
correlation is estimated unless noise = "white".

Source: https://jwst-pipeline.readthedocs.io, "Resampled 2-D data: i2d".
"""

from __future__ import annotations

import io
import re

from ...files.fits import open_fits
from ...sky.grid import Grid
from ..field_toml.headers import zero_point
from ..mosaic import FilePlane, Mosaic
from .band_files import (
    BandFiles,
    ReaderOptions,
    assemble_mosaic,
    image_plane,
    matching_plane,
    paths_of,
    require_grid,
)
from .planes import AnyFlagPlane, NoContextPlane

IS_FILTER = re.compile(r"F\d+\w+")


def read_jwst(path, **given) -> Mosaic:
    """The Mosaic of stage 3 images of JWST.

    path: one file, or a list with one for each band on the same pixels
    given: see `ReaderOptions`; bands are named by the filters, such as "F444W". The files hold no
        PSF

    Raises ValueError, one line, for what is missing; FileError for what cannot be read.
    """
    known = ReaderOptions(**given)
    return assemble_mosaic(
        "JWST", [_band(p, known) for p in paths_of(path)], known, noise="estimate"
    )


def _band(path, given):
    """Locates the planes in the file of one band."""
    with open_fits(path) as hdus:
        names = [hdu.name for hdu in hdus]
        wcs, why = _gwcs(hdus)
        n_contexts = hdus["CON"].shape[0] if "CON" in names and len(hdus["CON"].shape) == 3 else 0
        context = names.index("CON") if "CON" in names else None
    data, shape, header, grid = image_plane(path, "SCI" if "SCI" in names else None)
    band = _filter(header, path)
    if wcs is None:
        given.notes.append(f"{band}: {why}: placed by the header's WCS")
    else:
        grid = Grid.from_wcs(wcs, shape)
    if "ERR" not in names:
        raise ValueError(f"rms of band {band} is missing: {path.name} has no HDU ERR")
    grid = require_grid(path, grid)
    empty: list = []
    if context is not None:
        indices = range(n_contexts) if n_contexts else [None]
        empty.append((NoContextPlane(tuple(FilePlane(path, context, i) for i in indices)), None))
    if "WHT" in names:
        empty.append((NoContextPlane((matching_plane(grid, path, "WHT")[0],)), None))
    return BandFiles(
        band,
        grid,
        data,
        matching_plane(grid, path, "ERR")[0],
        "rms",
        AnyFlagPlane(tuple(empty)) if empty else None,
        zero_point=zero_point(header, grid.pixel_scale_arcsec),
        missing_zero_point="the header has no BUNIT of MJy/sr",
        missing_psf="files of JWST hold none",
        files={"image": path},
    )


def _gwcs(hdus):
    """(gwcs of the ASDF tree, None), or (None, the reason why there is none)."""
    if "ASDF" not in hdus:
        return None, "no gwcs in the file"
    try:
        import asdf
        import gwcs  # noqa: F401  whose objects the tree holds
    except ImportError:
        return None, "gwcs is not installed (pip install gwcs)"
    try:
        # arrays of other HDUs stay unread: only the WCS is read, which contains its own numbers
        return asdf.open(io.BytesIO(hdus["ASDF"].data.tobytes())).tree["meta"]["wcs"], None
    except Exception as error:  # asdf, or tags without an installed reader
        return None, f"its gwcs cannot be read ({' '.join(str(error).split()) or type(error)})"


def _filter(header, path):
    """The filter's name: of the pupil wheel's where this holds one, as F162M does."""
    for key in ("PUPIL", "FILTER"):
        name = str(header.get(key, "")).strip()
        if IS_FILTER.fullmatch(name):
            return name
    return path.name.split(".")[0]
