"""astropy's image containers as our Observations, and catalogues as regions on the sky."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty

from ..sky.observation import Observation
from .optional import require


def observation_of(image, psf=None, **given) -> Observation:
    """The Observation of an astropy NDData, CCDData or Cutout2D.

    image, psf, given: see `Observation.from_nddata`, which this calls

    Raises ValueError as that does.
    """
    return Observation.from_nddata(image, psf, **given)


def ccddata_of(data, grid, *, variance=None, mask=None, psf=None, unit=u.ct, cards=()) -> CCDData:
    """An image with its place on the sky as an astropy CCDData.

    data (C, Ny, Nx) or (Ny, Nx): one channel is returned as (Ny, Nx), several as a cube, whose WCS
        is that of its rows and columns
    grid: Grid of (Ny, Nx); a flat grid is placed at RA = Dec = 0
    variance, mask: of the shape of data, or None; psf: PSF of 1 or C bands, or None
    unit: of data; cards: (keyword, value, comment) of the FITS header that is `meta`

    `psf` is the array of the PSF's samples, as many as there are images, divided by their sums.
    PSFSPACE of `meta` is their distance in pixels.
    """
    data = np.asarray(data)
    one = data.ndim == 3 and len(data) == 1
    header = fits.Header([fits.Card(*card) for card in cards])
    images = None
    if psf is not None:
        header["PSFSPACE"] = (psf.spacing, "[px] distance of the PSF's samples")
        images = psf.images[0] if len(psf.images) == 1 else psf.images
    variance, mask = (None if a is None else a[0] if one else a for a in (variance, mask))
    return CCDData(
        data[0] if one else data,
        unit=unit,
        wcs=grid.to_wcs(),
        uncertainty=None if variance is None else StdDevUncertainty(np.sqrt(variance)),
        mask=mask,
        psf=images,
        meta=header,
    )


def regions_of(table, *, radius_arcsec=1.0):
    """Sources of a catalogue as sky regions, to draw or to write for DS9.

    table: QTable of `catalogue`, with ra and dec
    radius_arcsec [arcsec]: radius of the circles of sources without a measured size, such as stars
    returns regions.Regions: an ellipse for each source, with twice the half-axes of its second
        moments, or a circle; the text of each is the source's name

    Raises ImportError without regions; ValueError for a table of a flat sky.
    """
    regions = require("regions", "regions")
    if "ra" not in table.colnames or "dec" not in table.colnames:
        raise ValueError(f"table has no ra and dec, but {', '.join(table.colnames[:4])}, ...")
    frame = table.meta.get("frame", "icrs")
    centres = SkyCoord(table["ra"], table["dec"], frame=frame)
    found = []
    for row, centre in zip(table, centres):
        size, e = row["rms_size"], np.hypot(row["e1"], row["e2"])
        meta = regions.RegionMeta({"text": str(row["name"])})
        if np.isfinite(size.value) and size.value > 0 and np.isfinite(e):
            axes = 4 * size * np.sqrt([1 + e, 1 - e])
            # our position angle is counted from north to east, that of regions from west to north
            angle = row["position_angle"] + 90 * u.deg
            found.append(regions.EllipseSkyRegion(centre, *axes, angle=angle, meta=meta))
        else:
            found.append(regions.CircleSkyRegion(centre, radius_arcsec * u.arcsec, meta=meta))
    return regions.Regions(found)
