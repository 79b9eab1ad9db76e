"""astropy's image containers as our Observations, and catalogues as regions on the sky."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

from ..sky.observation import Observation
from .needed import needed


def observation_of(image, psf=None, **given) -> Observation:
    """The Observation of an astropy NDData, CCDData or Cutout2D.

    image, psf, given: see `Observation.from_nddata`, which this is

    Raises ValueError as that does.
    """
    return Observation.from_nddata(image, psf, **given)


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
