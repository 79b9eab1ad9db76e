"""astropy's image containers as our Observations, and catalogues as regions on the sky."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, InverseVariance, StdDevUncertainty, VarianceUncertainty

from ..sky.grid import Grid
from ..sky.observation import ZERO_POINT_UJY, Observation
from .needed import needed


def observation_of(image, psf, *, channels=None, zero_points=None, **given) -> Observation:
    """An Observation of an astropy NDData, CCDData or Cutout2D.

    image: its data (Ny, Nx) or (C, Ny, Nx), wcs, mask (True = ignore) and uncertainty (standard
        deviation, variance or inverse variance) are taken; a Cutout2D has data and wcs only
    psf: PSF of one band or of C
    channels: names, as of Observation; zero_points [mag]: AB magnitude of one count; where the
        image has a unit of flux density (Jy, nJy, ...; per pixel) they follow from it
    given: more arguments of Observation (weights, variance, mask, noise, name), instead of the
        image's own

    Raises ValueError for an image without a WCS, with an uncertainty of another kind, in a unit
    that is neither flux density nor counts, and as Observation does.
    """
    wcs = getattr(image, "wcs", None)
    if wcs is None:
        raise ValueError(f"image, a {type(image).__name__}, has no wcs")
    data = np.asarray(image.data)
    if getattr(image, "mask", None) is not None:
        given.setdefault("mask", np.asarray(image.mask))
    given.update(_variance(image, given))
    unit = getattr(image, "unit", None)
    if zero_points is None and unit not in (
        None,
        u.dimensionless_unscaled,
        u.adu,
        u.electron,
        u.ct,
    ):
        zero_points = _zero_point(u.Unit(unit))
    return Observation(
        data,
        psf,
        Grid.from_wcs(wcs, data.shape),
        channels=channels,
        zero_points=zero_points,
        **given,
    )


def ccddata_of(data, grid, *, variance=None, mask=None, psf=None, unit=u.ct, cards=()) -> CCDData:
    """An image with its place on the sky as an astropy CCDData.

    data (C, Ny, Nx) or (Ny, Nx): one channel is returned as (Ny, Nx), several as a cube, whose WCS
        is that of its rows and columns
    grid: Grid of (Ny, Nx); a flat one is put at RA = Dec = 0
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


def _variance(image, given):
    """What Observation needs of the image's uncertainty; nothing where the caller gave it."""
    uncertainty = getattr(image, "uncertainty", None)
    if uncertainty is None or {"weights", "variance"} & set(given):
        return {}
    values = np.asarray(uncertainty.array, np.float64)
    if isinstance(uncertainty, StdDevUncertainty):
        return {"variance": values**2}
    if isinstance(uncertainty, VarianceUncertainty):
        return {"variance": values}
    if isinstance(uncertainty, InverseVariance):
        return {"weights": values}
    raise ValueError(
        f"image.uncertainty is {type(uncertainty).__name__}: it must be a standard deviation, a "
        "variance or an inverse variance, or give `variance`"
    )


def _zero_point(unit):
    """AB magnitude of one count, for a unit of flux density per pixel."""
    for per_pixel in (u.dimensionless_unscaled, u.pix):
        try:
            return ZERO_POINT_UJY - 2.5 * np.log10((unit * per_pixel).to(u.uJy))
        except u.UnitConversionError:
            continue
    raise ValueError(
        f"image.unit is {unit}, neither a flux density nor counts: convert it, or give zero_points"
    )


def regions_of(table, *, radius_arcsec=1.0):
    """Sources of a catalogue as sky regions, to draw or to write for DS9.

    table: QTable of `catalogue`, with ra and dec
    radius_arcsec: of the circles of sources whose size was not measured, points among them
    returns regions.Regions: an ellipse a source, of twice its second moments' half-axes;
        circles elsewhere; each with the source's name as text

    Raises ImportError without regions; ValueError for a table of a flat sky.
    """
    regions = needed("regions", "regions")
    if "ra" not in table.colnames or "dec" not in table.colnames:
        raise ValueError(f"table has no ra and dec, but {', '.join(table.colnames[:4])}, ...")
    frame = table.meta.get("frame", "icrs")
    centres = SkyCoord(table["ra"], table["dec"], frame=frame)
    found = []
    for row, centre in zip(table, centres):
        size, e = row["size"], np.hypot(row["e1"], row["e2"])
        meta = regions.RegionMeta({"text": str(row["name"])})
        if np.isfinite(size.value) and size.value > 0 and np.isfinite(e):
            axes = 4 * size * np.sqrt([1 + e, 1 - e])
            # ours is counted from north to east, that of regions from west to north
            angle = row["angle"] + 90 * u.deg
            found.append(regions.EllipseSkyRegion(centre, *axes, angle=angle, meta=meta))
        else:
            found.append(regions.CircleSkyRegion(centre, radius_arcsec * u.arcsec, meta=meta))
    return regions.Regions(found)
