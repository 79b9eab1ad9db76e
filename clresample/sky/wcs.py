"""Astropy WCS beyond its own methods: the inverse that never raises, and WCS of cutouts."""

from __future__ import annotations

import numpy as np
from astropy.wcs import DistortionLookupTable, NoConvergence, Sip

# [px] the iterated inverse of SIP and look-up tables stops here, well under NOISE_PX
INVERSE_PX = 1e-8


def pixels_at(wcs, lon, lat):
    """Pixels (L, 2), (y, x), at the points lon, lat (L,) [deg]; NaN where there is none."""
    world = np.stack([lon, lat] if wcs.wcs.lng < wcs.wcs.lat else [lat, lon], axis=-1)
    try:
        pixels = wcs.all_world2pix(
            world, 0, tolerance=INVERSE_PX, maxiter=50, adaptive=True, detect_divergence=True
        )
    except NoConvergence as error:
        pixels = error.best_solution
        for lost in (error.divergent, error.slow_conv):
            if lost is not None:
                pixels[lost] = np.nan
    return pixels[:, ::-1]


def shifted_wcs(wcs, y0, x0):
    """The same WCS for an array that starts at (y0, x0)."""
    wcs = wcs.deepcopy()
    shift = np.array([x0, y0], dtype=np.float64)
    wcs.wcs.crpix = wcs.wcs.crpix - shift
    if wcs.sip is not None:
        sip = wcs.sip
        wcs.sip = Sip(sip.a, sip.b, sip.ap, sip.bp, sip.crpix - shift)
    for name in ("cpdis1", "cpdis2", "det2im1", "det2im2"):
        table = getattr(wcs, name)
        if table is not None:
            place = tuple(np.array(table.crval) - shift)
            moved = DistortionLookupTable(table.data, tuple(table.crpix), place, tuple(table.cdelt))
            setattr(wcs, name, moved)
    wcs.wcs.set()
    return wcs
