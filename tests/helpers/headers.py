"""Headers of every way of writing a celestial WCS, for the tests of grids and files."""

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, DistortionLookupTable

from clresample.sky.grid import Grid

RA, DEC = 150.1, 2.2  # [deg]
SCALE = 0.2 / 3600  # [deg/px]


def header(shape, *, scale=SCALE, ctype="TAN", ra=RA, dec=DEC, **cards):
    """Plain TAN header, east left, with the image's centre at (ra, dec)."""
    n_y, n_x = shape
    result = fits.Header({"NAXIS": 2, "NAXIS1": n_x, "NAXIS2": n_y})
    result["CTYPE1"], result["CTYPE2"] = f"RA---{ctype}", f"DEC--{ctype}"
    result["CRPIX1"], result["CRPIX2"] = (n_x + 1) / 2, (n_y + 1) / 2
    result["CRVAL1"], result["CRVAL2"] = ra, dec
    result["CDELT1"], result["CDELT2"] = -scale, scale
    for key, value in cards.items():
        result[key.replace("__", "-")] = value
    return result


def cd_header(shape, matrix, **cards):
    result = header(shape, **cards)
    del result["CDELT*"]
    for (i, j), value in np.ndenumerate(np.asarray(matrix)):
        result[f"CD{i + 1}_{j + 1}"] = value
    return result


def grid_of(cards, shape):
    return Grid.from_wcs(WCS(cards), shape)


def rotation(angle_deg):
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cos, -sin], [sin, cos]])


MODEL = (90, 110)
OBSERVED = (37, 44)
TURN = rotation(17.0)
SIP = {
    "A_ORDER": 3, "A_2_0": 3e-5, "A_1_1": -2e-5, "A_0_3": 4e-7,
    "B_ORDER": 3, "B_0_2": -4e-5, "B_1_1": 1e-5, "B_3_0": 2e-7,
}  # fmt: skip
TPV = {"PV1_0": 1e-5, "PV1_1": 1.0, "PV1_4": 0.9, "PV2_1": 1.0, "PV2_5": -1.2, "PV2_7": 40.0}


def observed_headers():
    """Every way of writing the celestial part of a header."""
    shape = OBSERVED
    yield "plain", header(shape)
    yield "CD", cd_header(shape, SCALE * TURN @ np.diag([-1, 1.03]))
    yield "CD-parity", cd_header(shape, SCALE * TURN)
    yield "CD-swapped", cd_header(shape, SCALE * np.array([[0, 1], [-1, 0]]))
    pc = {f"PC{i + 1}_{j + 1}": v for (i, j), v in np.ndenumerate(TURN)}
    yield "PC+CDELT", header(shape, **pc)
    yield "PC+unequal-CDELT", header(shape, **pc, CDELT1=-0.7 * SCALE)
    yield "CROTA", header(shape, CROTA2=17.0)
    yield "cube", header(shape, NAXIS=3, NAXIS3=5, CTYPE3="FREQ", CDELT3=1e6, **pc)
    yield "cube-2D", header(shape, NAXIS=3, NAXIS3=5, WCSAXES=2)
    yield (
        "dec-first",
        header(shape, CTYPE1="DEC--TAN", CTYPE2="RA---TAN", CRVAL1=DEC, CRVAL2=RA, **pc),
    )
    yield "SIN", header(shape, ctype="SIN", CROTA2=40.0)
    yield "SIP", header(shape, ctype="TAN-SIP", **pc, **SIP)
    yield "TPV", cd_header(shape, SCALE * TURN @ np.diag([-1, 1]), ctype="TPV", **TPV)


def true_positions(grid_out, grid_in):
    """Positions (My, Mx, 2) by astropy alone, for two WCS in one celestial frame."""
    y, x = np.indices(grid_out.shape, dtype=float)
    world = np.array(grid_out.wcs.all_pix2world(x, y, 0))
    if grid_out.wcs.wcs.lng != grid_in.wcs.wcs.lng:
        world = world[::-1]
    back = grid_in.wcs.all_world2pix(*world, 0, tolerance=1e-9, maxiter=60)
    return np.stack(back[::-1], axis=-1)


def with_tables():
    """A WCS with look-up tables of both kinds, as HST's ACS has them."""
    wcs = WCS(header(OBSERVED, ctype="TAN-SIP", **SIP))
    rng = np.random.default_rng(3)
    for name in ("cpdis1", "cpdis2", "det2im1"):
        bumps = rng.normal(scale=0.2, size=(5, 6)).astype(np.float32)
        setattr(wcs, name, DistortionLookupTable(bumps, (1, 1), (1.0, 1.0), (10.0, 10.0)))
    return wcs
