"""Files for `clresample resample`, and the command run on them."""

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from clresample import PSF
from clresample.cli.command import main

ARGUMENTS = {
    "image": "in.fits",
    "--psf": "p.fits",
    "--like": "ref.fits",
    "--psf-like": "q.fits",
    "-o": "out.fits",
}


def wcs_header(shape, scale_arcsec, *, ra_deg=150.0, angle_deg=0.0):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [ra_deg, 2.0]
    wcs.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    wcs.wcs.cd = np.array([[-c, s], [s, c]]) * scale_arcsec / 3600
    return wcs.to_header()


def image_of(shape, scale_arcsec, bands=(), **place):
    """A dark image with a few round sources, as an HDU; a cube where bands are named."""
    y, x = np.indices(shape)
    sources = sum(
        np.exp(-((y - a * shape[0]) ** 2 + (x - b * shape[1]) ** 2) / 12)
        for a, b in ((0.4, 0.5), (0.6, 0.3), (0.5, 0.7))
    )
    header = wcs_header(shape, scale_arcsec, **place)
    header["BUNIT"] = "count"
    for i, name in enumerate(bands):
        header[f"BAND{i + 1}"] = name
    factors = np.arange(1, len(bands) + 1)[:, None, None] if bands else 1
    return fits.PrimaryHDU((sources * factors).astype(np.float32), header)


def write_files():
    """An image, a cube, a reference, and their PSFs, in the current folder."""
    image_of((60, 70), 0.1).writeto("in.fits")
    image_of((60, 70), 0.1, "gri").writeto("cube.fits")
    image_of((40, 30), 0.2, angle_deg=10).writeto("ref.fits")
    fits.PrimaryHDU(PSF.gaussian(1.4, n_pixels=21).images[0]).writeto("p.fits")
    fits.PrimaryHDU(PSF.gaussian(1.5, n_pixels=21).images[0]).writeto("q.fits")
    three = PSF.gaussian([1.5, 1.6, 1.7], n_pixels=21).images
    header = fits.Header([(f"BAND{i + 1}", name) for i, name in enumerate("gri")])
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(three, header, name="PSF")]).writeto("q3.fits")


def resample(*more, **changes):
    """Exit status of `clresample resample` on the files of `write_files`, some arguments changed.

    more: words to append; changes: arguments by name, as psf_like="q3.fits"
    """
    arguments = ARGUMENTS | {
        f"--{k.replace('_', '-')}" if k != "image" else k: v for k, v in changes.items()
    }
    if "--output" in arguments:
        del arguments["-o"]
    image = arguments.pop("image")
    argv = [word for pair in arguments.items() for word in pair]
    try:
        return main(["resample", image, *argv, *more])
    except SystemExit as stop:  # argparse's own refusals
        return stop.code


def nan_image():
    """An image with three NaN pixels; returns the argument that names it."""
    with fits.open("in.fits") as hdus:
        hdus[0].data[3, 4:7] = np.nan
        hdus.writeto("nan.fits")
    return {"image": "nan.fits"}
