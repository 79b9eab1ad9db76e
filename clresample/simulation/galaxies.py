"""Galaxies as GalSim objects, real or made up, and their direct drawing on any flat grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np

CATALOGUE_FILE = "real_galaxy_catalog.fits"
# GalSim's folding, k-space cut and k-space accuracy, 5, 10 and 100 times below its defaults:
# Gaussians are accurate to 3e-6 of their peak, and two drawings of a parametric galaxy (EUCLID,
# RUBIN) agree to 75 dB; with the defaults they agree to 56 dB.
DRAWING = {"folding_threshold": 1e-3, "maxk_threshold": 1e-4, "kvalue_accuracy": 1e-7}

# Parametric galaxies: sizes as of the COSMOS sample's faint galaxies, the rest plain ranges
HALF_LIGHT_ARCSEC, HALF_LIGHT_SCATTER = 0.25, 0.4  # median, standard deviation of its logarithm
BULGE_FRACTION = (0.0, 0.5)  # of all light
BULGE_SIZE = 0.4  # half-light radius in units of the disk's
BULGE_CUT = 8.0  # half-light radii at which the infinite wings of n = 4 are cut off
KNOT_FRACTION = (0.1, 0.4)  # of the disk's light
N_KNOTS = (5, 30)
AXIS_RATIO = (0.3, 1.0)


def import_galsim():
    """Imports galsim. Raises ImportError that names the package to install."""
    try:
        import galsim
    except ImportError as error:
        raise ImportError(
            "simulations need GalSim, which is not installed: pip install galsim"
        ) from error
    return galsim


def open_catalogue(folder):
    """COSMOS galaxies of a folder (or of one catalogue file in it) as a `galsim.RealGalaxyCatalog`.

    folder: path; in a folder the catalogue is `real_galaxy_catalog.fits`; an open catalogue is
        returned as it is

    Raises ValueError where there is no such file.
    """
    galsim = import_galsim()
    if isinstance(folder, galsim.RealGalaxyCatalog):
        return folder
    path = Path(folder)
    if path.is_dir():
        path = path / CATALOGUE_FILE
    if not path.is_file():
        raise ValueError(f"folder {folder} holds no galaxy catalogue: {path} does not exist")
    return galsim.RealGalaxyCatalog(path.name, dir=str(path.parent))


def random_galaxy(rng, *, catalogue=None, i_galaxy=None, turn=True, smoothing_arcsec=0.0):
    """A galaxy of unit flux, centred on the origin: one of the catalogue, or a parametric one.

    rng: `numpy.random.Generator`
    catalogue: folder or open catalogue of real galaxies; None for bulge + disk + knots
    i_galaxy: row of the catalogue; None draws one
    turn: rotate by a random angle, and flip every other galaxy
    smoothing_arcsec [arcsec]: sigma of a Gaussian that limits the galaxy's band; 0 for none

    Raises ValueError for a row that the catalogue does not have, or a negative smoothing.
    """
    galsim = import_galsim()
    if smoothing_arcsec < 0:
        raise ValueError(f"smoothing_arcsec is {smoothing_arcsec}, must be 0 or more")
    if catalogue is None:
        galaxy = parametric_galaxy(rng)
    else:
        catalogue = open_catalogue(catalogue)
        if i_galaxy is None:
            i_galaxy = rng.integers(catalogue.nobjects)
        if not 0 <= i_galaxy < catalogue.nobjects:
            raise ValueError(f"i_galaxy is {i_galaxy}, the catalogue has {catalogue.nobjects} rows")
        galaxy = galsim.RealGalaxy(catalogue, index=int(i_galaxy), flux=1.0)
    if turn:
        galaxy = galaxy.rotate(rng.uniform(0, 360) * galsim.degrees)
        galaxy = galaxy.transform(rng.choice([-1, 1]), 0, 0, 1)
    if smoothing_arcsec > 0:
        galaxy = galsim.Convolve(galaxy, galsim.Gaussian(sigma=smoothing_arcsec))
    return galaxy


def parametric_galaxy(rng):
    """Bulge (Sersic n = 4), exponential disk and star-forming knots in it, at unit flux.

    rng: `numpy.random.Generator`
    """
    galsim = import_galsim()
    size = HALF_LIGHT_ARCSEC * np.exp(HALF_LIGHT_SCATTER * rng.standard_normal())
    bulge_fraction = rng.uniform(*BULGE_FRACTION)
    knot_fraction = rng.uniform(*KNOT_FRACTION)
    axis_ratio = rng.uniform(*AXIS_RATIO)
    position_angle = rng.uniform(0, 180) * galsim.degrees
    knots_rng = galsim.BaseDeviate(int(rng.integers(1, 2**31)))
    n_knots = int(rng.integers(N_KNOTS[0], N_KNOTS[1], endpoint=True))

    disk = galsim.Exponential(half_light_radius=size)
    knots = galsim.RandomKnots(n_knots, profile=disk, rng=knots_rng)
    disk = (1 - knot_fraction) * disk + knot_fraction * knots
    disk = disk.shear(q=axis_ratio, beta=position_angle)
    bulge_size = BULGE_SIZE * size
    bulge = galsim.Sersic(4, half_light_radius=bulge_size, trunc=BULGE_CUT * bulge_size)
    bulge = bulge.shear(q=np.sqrt(axis_ratio), beta=position_angle)
    return bulge_fraction * bulge + (1 - bulge_fraction) * disk


def draw(galaxy, grid, *, psf_sigma_arcsec=0.0, position_arcsec=(0.0, 0.0)):
    """GalSim's direct drawing of a galaxy under a Gaussian PSF and the grid's own pixel.

    galaxy: `galsim.GSObject` on the flat sky, GalSim's (u, v) being its (x, y)
    grid: `Grid.flat`, at any angle, flipped or not
    psf_sigma_arcsec [arcsec]: standard deviation of the PSF before the pixel; 0 for the pixel alone
    position_arcsec (2,) [arcsec]: (y, x) where the galaxy's origin goes
    returns (Ny, Nx) [the galaxy's flux per pixel] float64

    Raises ValueError for a grid with a celestial WCS.
    """
    if not grid.is_flat:
        raise ValueError("grid has a celestial WCS; galaxies are drawn on flat grids (Grid.flat)")
    galsim = import_galsim()
    y, x = position_arcsec
    if psf_sigma_arcsec > 0:
        galaxy = galsim.Convolve(galaxy, galsim.Gaussian(sigma=psf_sigma_arcsec))
    galaxy = galaxy.shift(x, y).withGSParams(**DRAWING)
    n_y, n_x = grid.shape
    (y_row, y_col), (x_row, x_col) = grid.jacobian  # [arcsec/px]
    image = galsim.ImageD(n_x, n_y, xmin=0, ymin=0)
    image.wcs = galsim.JacobianWCS(x_col, x_row, y_col, y_row)
    row, col = np.linalg.solve(grid.jacobian, -np.asarray(grid.origin))
    galaxy.drawImage(image, center=galsim.PositionD(col, row))
    return image.array
