"""Faults of images as surveys deliver them, each with a size that can be set to 0."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

GAP_PX = 24  # [px] width of a gap between two chips, of either survey, once exposures are added
COSMIC_PX = (3, 15)  # [px] length of a cosmic ray's track
COSMIC_SIGMA = (20.0, 300.0)  # [sigma] height of its pixels, log-uniform
BLEED_DECAY = 0.7  # fraction of a saturated column's surplus passed to the next pixel


@dataclass(frozen=True)
class Spoilers:
    """Sizes of the faults of simulated images; a random seed sets their signs and positions.

    wcs_offset_px [px]: range of the offset of the second instrument's WCS, in its own pixels
    psf_width [1]: range of the relative difference in width between the published PSF and the one
        that drew the image, drawn for each band
    psf_wings [1]: fraction of a star's light in a halo that the published PSF does not have
    sky_sigma [sigma]: level of sky left in each band, of either sign, in units of a pixel's noise
    cosmic_rays [1e6 px]: unmasked tracks in a million pixels
    gaps: chip gaps of each mosaic, whose pixels have no weight
    saturation: True if bright stars saturate and bleed along their columns
    mask_saturated: True if saturated pixels and bleeds are masked

    Raises ValueError for a size below 0.
    """

    wcs_offset_px: tuple[float, float] = (0.1, 0.3)
    psf_width: tuple[float, float] = (0.01, 0.02)
    psf_wings: float = 0.01
    sky_sigma: float = 0.3
    cosmic_rays: float = 10.0
    gaps: int = 1
    saturation: bool = True
    mask_saturated: bool = True

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if not np.all(np.asarray(value, float) >= 0):
                raise ValueError(
                    f"{field.name} is {value}, must be 0 or more: set 0 to leave it out"
                )

    @classmethod
    def none(cls, **kept) -> Spoilers:
        """No faults but those that are named."""
        off: dict = {"saturation": False, "cosmic_rays": 0.0, "gaps": 0, "sky_sigma": 0.0}
        off |= {"wcs_offset_px": (0.0, 0.0), "psf_width": (0.0, 0.0), "psf_wings": 0.0}
        return cls(**(off | kept))

    def scaled(self, factor) -> Spoilers:
        """All sizes times a factor of 0 or more; gaps are rounded, saturation stays unless it is 0.

        Raises ValueError for a factor below 0.
        """
        if not factor >= 0:
            raise ValueError(f"factor is {factor}, must be 0 or more")
        return replace(
            self,
            wcs_offset_px=tuple(factor * v for v in self.wcs_offset_px),
            psf_width=tuple(factor * v for v in self.psf_width),
            psf_wings=factor * self.psf_wings,
            sky_sigma=factor * self.sky_sigma,
            cosmic_rays=factor * self.cosmic_rays,
            gaps=round(factor * self.gaps),
            saturation=self.saturation and factor > 0,
        )


def signed(rng, size, n=1):
    """Values (n,) of a random sign, their size uniform in a range (2,)."""
    return rng.uniform(*size, n) * rng.choice([-1.0, 1.0], n)


def offset_of(rng, size):
    """An offset (2,) (y, x) of a random direction, its length uniform in a range (2,)."""
    length, angle = rng.uniform(*size), rng.uniform(0, 2 * np.pi)
    return length * np.array([np.sin(angle), np.cos(angle)])


def add_cosmic_rays(data, sigma, rng, per_million):
    """Adds tracks to images (C, Ny, Nx) [counts] in place, one band each; sigma (C,) [counts]."""
    n_bands, n_y, n_x = data.shape
    for _ in range(rng.poisson(per_million * n_bands * n_y * n_x / 1e6)):
        band, length = int(rng.integers(n_bands)), rng.uniform(*COSMIC_PX)
        angle, at = rng.uniform(0, np.pi), rng.uniform(0, 1, 2) * (n_y, n_x)
        along = np.arange(0, length, 0.7)[:, None] * [np.sin(angle), np.cos(angle)]
        pixels = np.unique(np.rint(at + along).astype(int), axis=0)
        inside = ((pixels >= 0) & (pixels < (n_y, n_x))).all(axis=1)
        y, x = pixels[inside].T
        heights = np.exp(rng.uniform(*np.log(COSMIC_SIGMA))) * rng.uniform(0.5, 1.5, len(y))
        data[band, y, x] += sigma[band] * heights


def gap_pixels(shape, rng, n):
    """Pixels (Ny, Nx) bool of n gaps, rows or columns by chance."""
    bad = np.zeros(shape, bool)
    for _ in range(n):
        axis = int(rng.integers(2))
        first = int(rng.integers(max(1, shape[axis] - GAP_PX)))
        bad[(slice(None),) * axis + (slice(first, first + GAP_PX),)] = True
    return bad


def saturate(data, level):
    """Clips an image (Ny, Nx) [counts] at a level in place; the surplus flows along its columns.

    returns the pixels (Ny, Nx) bool at the level
    """
    for x in np.flatnonzero((data > level).any(axis=0)):
        column = data[:, x]
        for direction in (1, -1):
            surplus = 0.0
            over = np.maximum(column[::direction] - level, 0) / 2
            for y, own in zip(range(len(column))[::direction], over, strict=True):
                surplus += own
                taken = min(surplus, max(level - column[y], 0.0))
                column[y] += taken
                surplus = (surplus - taken) * (1.0 if taken else BLEED_DECAY if not own else 1.0)
        np.minimum(column, level, out=column)
    return data >= level
