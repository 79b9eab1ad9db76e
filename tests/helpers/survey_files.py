"""Small files in the formats of surveys, as their archives hand them out."""

import numpy as np
from astropy.io import fits
from astropy.table import Table

from clresample import PSF, Grid

SHAPE = (70, 60)


def sky_grid(shape=SHAPE, scale=0.2):
    """A Grid with a WCS."""
    return Grid.from_wcs(Grid.flat(shape, scale).to_wcs(ra_deg=10, dec_deg=-30), shape)


def header_of(grid, **cards):
    """Its WCS as cards, and others."""
    header = grid.to_wcs().to_header(relax=True)
    header.update({k if len(k) <= 8 else f"HIERARCH {k}": value for k, value in cards.items()})
    return header


def noise_image(sigma=1.0, seed=0, shape=SHAPE):
    """White noise, float32."""
    return np.random.default_rng(seed).normal(0, sigma, shape).astype(np.float32)


def psf_image(sigma=1.5, n=15):
    """A Gaussian PSF (n, n), float32."""
    return PSF.gaussian(sigma, n_pixels=n).images[0].astype(np.float32)


def write_brick(folder, bands=("g", "r"), *, skip=(), copsf=False):
    """A brick of the Legacy Surveys; the kinds in `skip` are left out."""
    grid, name = sky_grid(scale=0.262), "legacysurvey-0100m300"
    for k, band in enumerate(bands):
        planes = {"image": noise_image(2.0, k), "invvar": np.full(SHAPE, 0.25, np.float32)}
        widths = np.full(SHAPE, 1.1, np.float32) + 0.2 * np.indices(SHAPE)[0] / SHAPE[0]
        planes["psfsize"] = widths.astype(np.float32)
        for kind, pixels in planes.items():
            if kind not in skip:
                hdu = fits.CompImageHDU(pixels, header_of(grid, BUNIT="nanomaggy"))
                path = folder / f"{name}-{kind}-{band}.fits.fz"
                fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
        if copsf:
            fits.PrimaryHDU(psf_image()).writeto(folder / f"{name}-copsf-{band}.fits.fz")
    bits = np.zeros(SHAPE, np.int16)
    bits[3], bits[4], bits[5] = 1 << 2, 1 << 3, 1 << 12  # SATUR_G, SATUR_R, GALAXY
    if "maskbits" not in skip:
        hdu = fits.CompImageHDU(bits, header_of(grid), name="MASKBITS")
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(folder / f"{name}-maskbits.fits.fz")
    return grid


def write_drizzled(path, *, unit="ELECTRONS/S", **cards):
    """A drizzled image of HST's ACS with WHT an exposure time, in F814W."""
    grid = sky_grid(scale=0.05)
    primary = {"INSTRUME": "ACS", "FILTER1": "CLEAR1L", "FILTER2": "F814W", "EXPTIME": 1000.0}
    science = {"PHOTFLAM": 7.0332e-20, "PHOTPLAM": 8045.5, "BUNIT": unit} | cards
    time = np.full(SHAPE, 1000.0, np.float32)
    time[:, :5] = 0
    hdus = [
        fits.PrimaryHDU(header=fits.Header(primary)),
        fits.ImageHDU(noise_image(0.01), header_of(grid, **science), name="SCI"),
        fits.ImageHDU(time, header_of(grid), name="WHT"),
        fits.ImageHDU(np.ones(SHAPE, np.int32), name="CTX"),
    ]
    fits.HDUList(hdus).writeto(path)
    return grid


def write_i2d(path, *, wcs=None, skip=(), **cards):
    """A stage 3 image of JWST's NIRCam in F444W; wcs: gwcs for its ASDF tree."""
    grid, area = sky_grid(scale=0.06), (0.06 / 206264.806) ** 2
    primary = {"INSTRUME": "NIRCAM", "FILTER": "F444W", "PUPIL": "CLEAR"} | cards
    error = np.full(SHAPE, 0.5, np.float32)
    error[:, :3] = np.nan
    contexts = np.ones((2, *SHAPE), np.int32)
    contexts[:, 8] = 0
    weights = np.ones(SHAPE, np.float32)
    weights[9] = 0
    science = header_of(grid, BUNIT="MJy/sr", PIXAR_SR=area)
    hdus = [
        fits.PrimaryHDU(header=fits.Header(primary)),
        fits.ImageHDU(noise_image(0.5), science, name="SCI"),
        fits.ImageHDU(error, name="ERR"),
        fits.ImageHDU(contexts, name="CON"),
        fits.ImageHDU(weights, name="WHT"),
    ]
    if wcs is not None:
        hdus.append(_asdf_hdu(wcs))
    fits.HDUList([hdu for hdu in hdus if hdu.name not in skip]).writeto(path)
    return grid


def _asdf_hdu(wcs):
    """A tree in a table of one row, as JWST's pipeline embeds it."""
    import io

    import asdf

    stream = io.BytesIO()
    asdf.AsdfFile({"meta": {"wcs": wcs, "telescope": "JWST"}}).write_to(stream)
    array = "data: !core/ndarray-1.1.0 {source: 'fits:SCI,1', datatype: float32, byteorder: big, "
    text = stream.getvalue().replace(b"\n...\n", f"\n{array}shape: [70, 60]}}\n...\n".encode())
    raw = np.frombuffer(text, np.uint8)
    column = fits.Column("ASDF_METADATA", f"{raw.size}B", array=raw[None])
    return fits.BinTableHDU.from_columns([column], name="ASDF")


def write_exposure(path, *, unit=None, fluxmag0=None, photocalib=None, names=True):
    """An exposure as afw writes it: image, mask, variance, and an archive with a calibration."""
    grid = sky_grid()
    flags = np.zeros(SHAPE, np.int32)
    flags[5], flags[6], flags[7] = 1 << 1, 1 << 5, 1 << 8  # SAT, DETECTED, NO_DATA
    primary = fits.Header({"FILTER": "r"})
    offset = {"LTV1": 0.0, "LTV2": 0.0}
    image = header_of(grid, **offset, **({"BUNIT": unit} if unit else {}))
    variance = header_of(grid, **offset, **({"BUNIT": f"{unit}2"} if unit else {}))
    mask = header_of(grid, **offset, MP_SAT=1, MP_DETECTED=5, MP_NO_DATA=8)
    hdus = [
        fits.PrimaryHDU(header=primary),
        fits.CompImageHDU(noise_image(3.0), image, name="IMAGE"),
        fits.CompImageHDU(flags, mask, name="MASK"),
        fits.CompImageHDU(np.full(SHAPE, 9.0, np.float32), variance, name="VARIANCE"),
    ]
    if not names:
        hdus[1:] = [fits.ImageHDU(hdu.data, hdu.header) for hdu in hdus[1:]]
        for hdu in hdus[1:]:
            hdu.header.pop("EXTNAME", None)
    if fluxmag0:
        primary["FLUXMAG0"] = hdus[0].header["FLUXMAG0"] = fluxmag0
    if photocalib:
        hdus[0].header["AR_HDU"], hdus[0].header["HIERARCH PHOTOCALIB_ID"] = 5, 17
        index = {"id": [3, 17], "cat.archive": [1, 1], "row0": [0, 1], "nrows": [1, 1]}
        rows = {"calibrationMean": [99.0, photocalib], "isConstant": [True, photocalib != 2.0]}
        for name, columns in (("ARCHIVE_INDEX", index), ("PhotoCalib", rows)):
            hdus.append(fits.table_to_hdu(Table(columns)))
            hdus[-1].name = name
    fits.HDUList(hdus).writeto(path)
    return grid
