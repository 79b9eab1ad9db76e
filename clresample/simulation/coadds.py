"""Mosaics of simulated scenes, as Observations: exposures drawn on grids of their own, then added.

A scene's image and its mosaic hold the same exposure time and the same sources; noise is drawn
anew, exposure by exposure.
"""

from __future__ import annotations

import numpy as np

from ..sky.grid import Grid
from ..sky.observation import Observation
from .galaxies import draw
from .mosaics import Mosaicking, drizzle, lanczos

# [deg] Pixels of exposures are turned against those of the mosaic, so that the sub-pixel phases,
# of which the noise depends, change from pixel to pixel.
ANGLE_DEG = 20.0
# [px] Dithers of drizzled exposures: a box of half pixels. Then their drops [px], and the pixel of
# the mosaic in units of theirs: common choices for HST.
DITHERS_PX = (0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)
PIXFRAC, SHRINK = 0.8, 0.7


def resampled(image, *, noise="correlated", order=3, grid=None) -> Observation:
    """A SimulatedImage with the noise that it has, Lanczos-resampled to another `Grid.flat`.

    noise: "correlated" states the noise's correlation, "white" leaves it out, as most do
    grid: None has the image's pixel scale, upright, within the image
    """
    grid = grid or _upright(image.grid, 1.0)
    return _observation(image, lanczos(image.grid, grid, order), [image.data], noise)


def resampled_exposure(image, profiles, positions_arcsec, rng, *, noise="correlated"):
    """The Observation of a scene's sources from one exposure, turned by 20 degrees, by Lanczos.

    image: SimulatedImage, upright, of whose survey, exposure time and grid it is
    profiles (S), positions_arcsec (S, 2): as in `scenes.observe`; rng: of the noise
    """
    (grid_in,) = _exposed(image.grid, DITHERS_PX[:1])
    exposures = _expose(image, profiles, positions_arcsec, [grid_in], rng)
    return _observation(image, lanczos(grid_in, image.grid), exposures, noise)


def drizzled(image, profiles, positions_arcsec, rng, *, noise="correlated"):
    """The Observation of a scene's sources drizzled from 4 dithered exposures to finer pixels.

    Arguments as of `resampled_exposure`
    """
    grids = _exposed(image.grid, DITHERS_PX)
    exposures = _expose(image, profiles, positions_arcsec, grids, rng)
    mosaicking = drizzle(grids, _upright(image.grid, SHRINK), PIXFRAC)
    return _observation(image, mosaicking, exposures, noise)


def _upright(grid, shrink):
    """Pixels of `shrink` times the size on the same sky, upright."""
    scale = grid.pixel_scale_arcsec * shrink
    shape = tuple(int(n / shrink) for n in grid.shape)
    return Grid.flat(shape, scale, center_arcsec=_middle(grid))


def _exposed(grid, dithers_px):
    """Grids of exposures, turned, which hold all of `grid`; dithers (n, 2) along their axes."""
    n = int(np.ceil(max(grid.shape) * np.sqrt(2))) + 8
    scale, middle = grid.pixel_scale_arcsec, _middle(grid)
    first = Grid.flat((n, n), scale, angle_deg=ANGLE_DEG, center_arcsec=middle)
    origins = first.origin + np.array(dithers_px) @ first.jacobian.T
    return [Grid.from_jacobian(first.shape, first.jacobian, origin) for origin in origins]


def _middle(grid):
    """The sky (y, x) [arcsec] in the middle of a flat grid."""
    return grid.sky(*((np.array(grid.shape) - 1) / 2))


def _expose(image, profiles, positions_arcsec, grids, rng):
    """Exposures (C, ny, nx) [counts, as if of the whole time] on these grids, with their noise."""
    survey, exposures = image.survey, []
    sigma = survey.noise_sigma[:, None, None] * np.sqrt(len(grids))
    for grid in grids:
        light = sigma * rng.standard_normal((survey.n_bands, *grid.shape))
        for profile, at, counts in zip(profiles, positions_arcsec, image.counts, strict=True):
            for band, (width, n) in enumerate(zip(survey.psf_sigma_arcsec, counts, strict=True)):
                light[band] += n * draw(profile, grid, psf_sigma_arcsec=width, position_arcsec=at)
        exposures.append(light)
    return exposures


def _observation(image, mosaicking: Mosaicking, exposures, noise):
    """The Observation of a mosaic; noise: "correlated" or "white"."""
    if noise not in ("correlated", "white"):
        raise ValueError(f'noise is {noise!r}, it takes "correlated" or "white"')
    variance = mosaicking.variance() * len(exposures)
    inverse = np.divide(1, variance, out=np.zeros(variance.shape), where=variance > 0)
    return Observation(
        mosaicking.images(exposures),
        mosaicking.psf(image.psf),
        mosaicking.grid,
        weights=inverse / image.survey.noise_sigma[:, None, None] ** 2,
        channels=image.survey.bands,
        zero_points=image.survey.zero_points_mag,
        noise=mosaicking.correlation() if noise == "correlated" else None,
        name=image.survey.name,
    )
