"""GalSim's images, PSFs and profiles as ours, and fitted sources as GalSim profiles.

GalSim's tangent plane has u to the west and v to the north; so has a flat grid's sky, x and y.
"""

from __future__ import annotations

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..sky.grid import Grid
from ..sky.psf import PSF
from ..sky.wcs import cutout_wcs, local_axes
from .optional import require


def grid_of(image) -> Grid:
    """The Grid of a GalSim image: of its celestial WCS, or flat where its WCS is affine.

    image: galsim.Image with a wcs (None: pixels of 1 arcsec)

    Raises ValueError for a WCS that is neither celestial nor the same all over the image.
    """
    galsim = require("galsim", "galsim")
    wcs = image.wcs or galsim.PixelScale(1.0)
    shape = image.array.shape
    if isinstance(wcs, galsim.AstropyWCS):
        first = image.ymin - 1 - wcs.origin.y, image.xmin - 1 - wcs.origin.x
        return Grid.from_wcs(cutout_wcs(wcs.wcs, *first), shape)
    if wcs.isCelestial():
        header = fits.Header()
        wcs.writeToFitsHeader(header, image.bounds)
        return Grid.from_wcs(WCS(header), shape)
    if not wcs.isUniform():
        raise ValueError(
            f"image.wcs is {type(wcs).__name__}, neither celestial nor the same everywhere"
        )
    jacobian = wcs.jacobian()
    corner = wcs.toWorld(galsim.PositionD(image.xmin, image.ymin))
    matrix = [[jacobian.dvdy, jacobian.dvdx], [jacobian.dudy, jacobian.dudx]]
    return Grid.from_jacobian(shape, matrix, (corner.y, corner.x))


def psf_of(profile, grid, *, n_pixels=41, oversampling=1, position_px=None) -> PSF:
    """The PSF of a GalSim profile on a grid's pixels, pixel response included.

    profile: galsim.GSObject, the PSF before pixels; a list of C of them makes C bands
    n_pixels: side of the images [pixels of the grid], odd; light beyond is cut off
    oversampling: samples per pixel and axis, odd
    position_px (2,) [px]: (y, x), a position on the grid; None = its centre

    Raises ValueError for even numbers.
    """
    galsim = require("galsim", "galsim")
    for name, value in (("n_pixels", n_pixels), ("oversampling", oversampling)):
        if value != int(value) or value < 1 or value % 2 == 0:
            raise ValueError(f"{name} is {value}, must be an odd whole number")
    wcs = _local_wcs(galsim, grid, _position(grid, position_px))
    fine = galsim.JacobianWCS(*(wcs.getMatrix() / oversampling).ravel())
    side = n_pixels * oversampling
    images = []
    for each in profile if isinstance(profile, (list, tuple)) else [profile]:
        pixel = wcs.toWorld(galsim.Pixel(1.0))
        drawn = galsim.Convolve(each, pixel).drawImage(
            nx=side, ny=side, wcs=fine, method="no_pixel", dtype=float
        )
        images.append(drawn.array)
    return PSF(np.array(images), spacing=1 / oversampling)


def image_of(array, grid):
    """A GalSim image of an array (Ny, Nx), placed on the sky by its grid."""
    galsim = require("galsim", "galsim")
    array = np.asarray(array)
    if array.shape != tuple(grid.shape):
        raise ValueError(f"array has shape {array.shape}, its grid {tuple(grid.shape)}")
    if not grid.is_flat:
        header = grid.to_wcs().to_header(relax=True)
        wcs = galsim.AstropyWCS(header=galsim.FitsHeader(header))
        return galsim.Image(array, wcs=wcs, xmin=1, ymin=1)
    wcs = _local_wcs(galsim, grid, (0, 0))
    y, x = grid.sky(0, 0)
    affine = galsim.AffineTransform(
        *wcs.getMatrix().ravel(),
        origin=galsim.PositionD(1, 1),
        world_origin=galsim.PositionD(float(x), float(y)),
    )
    return galsim.Image(array, wcs=affine, xmin=1, ymin=1)


def profile_of(image, grid, position_px, *, interpolant="lanczos15"):
    """An image as a GalSim profile about a position in it.

    image (Ny, Nx): flux per pixel of a band-limited model, as those of fits are
    grid: of the image; position_px (2,) [px]: (y, x) that becomes the profile's origin
    interpolant: GalSim's name for the interpolation between pixels. "sinc" is exact, but GalSim 2.8
        crashes with a segmentation fault when it draws such a profile in real space. lanczos15 is
        within 1e-3 of the peak for images as finely sampled as models
    returns galsim.InterpolatedImage, in arcsec on the tangent plane at that position
    """
    galsim = require("galsim", "galsim")
    image, position = np.asarray(image, np.float64), np.asarray(position_px, np.float64)
    if image.shape != tuple(grid.shape):
        raise ValueError(f"image has shape {image.shape}, its grid {tuple(grid.shape)}")
    y, x = position - (np.array(image.shape) - 1) / 2
    return galsim.InterpolatedImage(
        galsim.Image(image, wcs=_local_wcs(galsim, grid, position)),
        x_interpolant=interpolant,
        offset=galsim.PositionD(x, y),
        normalization="flux",
    )


def as_galsim(op, grid_out):
    """An operator as a function of GalSim images: galsim.Image -> galsim.Image.

    op: Resampler of one band, float32 or float64; the image has the pixels of its first grid
    grid_out: the operator's second grid, which places the result

    Raises ValueError, when called, for an image of another shape.
    """

    def apply(image):
        return image_of(op(np.asarray(image.array, op.dtype)), grid_out)

    return apply


def _position(grid, position_px):
    """The position (y, x) [px]; None = the grid's centre."""
    if position_px is None:
        return (np.array(grid.shape) - 1) / 2
    return np.asarray(position_px, np.float64)


def _local_wcs(galsim, grid, position):
    """GalSim's JacobianWCS of a grid at (y, x) [px]: pixels to the tangent plane there [arcsec]."""
    (north_y, north_x), (east_y, east_x) = local_axes(grid, position)
    return galsim.JacobianWCS(-east_x, -east_y, north_x, north_y)
