"""Mosaics of simulated scenes, as Observations: exposures drawn on their own grids, then added.

A scene's image and its mosaic have the same exposure time and the same sources. Noise is drawn
again for each exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ..sky.grid import Grid
from ..sky.observation import Observation
from .galaxies import draw
from .mosaics import MosaicOperator, drizzle, lanczos
from .scenes import SimulatedImage, SimulatedScene

# [deg] Rotation between exposures and mosaic, so that the sub-pixel phases, on which the noise
# depends, change from pixel to pixel.
ANGLE_DEG = 20.0
# [px] Dithers of drizzled exposures: a box of half pixels. Then their drops [px], and the pixel of
# the mosaic in units of theirs: common choices for HST.
DITHERS_PX = (0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)
PIXFRAC, SHRINK = 0.8, 0.7


@dataclass(frozen=True, eq=False)
class MosaicImage(SimulatedImage):
    """A SimulatedImage whose `observation` is a mosaic of the same sources.

    mosaic: that Observation; grid, data and all others are those of the image without it
    """

    mosaic: Observation | None = None

    def observation(self):
        """The mosaic."""
        return self.mosaic

    def with_noise(self, rng):
        """Raises ValueError: the noise of a mosaic is drawn with its exposures."""
        raise ValueError("the noise of a mosaic comes of its exposures: make another mosaic")


def resampled(image, *, noise="correlated", order=3, grid=None) -> MosaicImage:
    """A SimulatedImage with its light and noise Lanczos-resampled to another `Grid.flat`.

    noise: "correlated" = with the NoiseCorrelation; "white" = without it, as in most analyses
    grid: None = the image's pixel scale, without rotation, on the same sky
    """
    grid = grid or _upright(image.grid, 1.0)
    return _mosaic(image, lanczos(image.grid, grid, order), [image.data], noise)


def mosaic_scene(scene, rng, *, kind, noise="correlated") -> SimulatedScene:
    """The scene with mosaics of newly drawn exposures in place of its images.

    rng: of the noise
    kind: how exposures, turned by 20 degrees, become upright pixels of 0.7 of their size:
        "lanczos", one exposure of each instrument is interpolated; or "drizzle", four dithered ones
        are drizzled with drops of 0.8 pixels
    noise: as for `resampled`

    Raises ValueError for another kind, another noise, and scenes with a celestial WCS.
    """
    if kind not in ("lanczos", "drizzle"):
        raise ValueError(f'kind is {kind!r}, must be "lanczos" or "drizzle"')
    images = {}
    for name in ("euclid", "rubin"):
        image = getattr(scene, name)
        grids = _exposed(image.grid, DITHERS_PX if kind == "drizzle" else DITHERS_PX[:1])
        finer = _upright(image.grid, SHRINK)
        exposures = _expose(image, scene.profiles, scene.positions_arcsec, grids, rng)
        if kind == "drizzle":
            mosaicking = drizzle(grids, finer, PIXFRAC)
        else:
            mosaicking = lanczos(grids[0], finer)
        images[name] = _mosaic(image, mosaicking, exposures, noise)
    return replace(scene, **images)


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


def _mosaic(image, mosaicking: MosaicOperator, exposures, noise):
    """The MosaicImage of an image; noise: "correlated" or "white"."""
    if noise not in ("correlated", "white"):
        raise ValueError(f'noise is {noise!r}, must be "correlated" or "white"')
    variance = mosaicking.variance() * len(exposures)
    inverse = np.divide(1, variance, out=np.zeros(variance.shape), where=variance > 0)
    mosaic = Observation(
        mosaicking.images(exposures),
        mosaicking.psf(image.psf),
        mosaicking.grid,
        weights=inverse / image.survey.noise_sigma[:, None, None] ** 2,
        channels=image.survey.bands,
        zero_points=image.survey.zero_points_mag,
        noise=mosaicking.correlation() if noise == "correlated" else None,
        name=image.survey.name,
    )
    kept = {field.name: getattr(image, field.name) for field in fields(SimulatedImage)}
    return MosaicImage(**kept, mosaic=mosaic)
