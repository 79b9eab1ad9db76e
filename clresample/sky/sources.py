"""What a scene is made of: point sources and extended sources at given positions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Source:
    """A source at one position, given on the sky or in model pixels.

    sky_deg (2,) [deg]: right ascension and declination (for a flat sky: y, x [arcsec])
    position_px (2,) [px]: (y, x) in the model frame; exactly one of the two is given
    name: how the catalogue calls it; None numbers it

    Raises ValueError where not exactly one finite position is given.
    """

    sky_deg: tuple[float, float] | None = None
    position_px: tuple[float, float] | None = None
    name: str | None = None

    def __post_init__(self):
        if (self.sky_deg is None) == (self.position_px is None):
            raise ValueError(
                "a source takes either sky_deg or position_px, "
                f"not sky_deg={self.sky_deg} with position_px={self.position_px}"
            )
        name = "sky_deg" if self.position_px is None else "position_px"
        position = np.asarray(getattr(self, name), dtype=np.float64)
        if position.shape != (2,) or not np.isfinite(position).all():
            raise ValueError(f"{name} is {getattr(self, name)}, it takes two finite numbers")

    def pixel(self, grid) -> np.ndarray:
        """Position (2,) [px]: (y, x) on the model's grid."""
        if self.position_px is not None:
            return np.asarray(self.position_px, dtype=np.float64)
        return grid.pixel(*self.sky_deg)


@dataclass(frozen=True, kw_only=True)
class Point(Source):
    """A star: the model's PSF at the position, one spectrum.

    free: let the position move by a sub-pixel shift in the fit
    """

    free: bool = False


@dataclass(frozen=True, kw_only=True)
class Extended(Source):
    """A galaxy: `n_components` morphologies about one centre, each with a spectrum of its own.

    profile (Ny, Nx) [1]: what its one morphology is expected to look like under the model's PSF, on
        the frame's pixels, non-negative; None = a smooth profile fitted to the data
    """

    n_components: int = 1
    profile: np.ndarray | None = field(default=None, compare=False, repr=False)

    def __post_init__(self):
        super().__post_init__()
        if self.n_components < 1:
            raise ValueError(f"n_components is {self.n_components}, must be 1 or more")
        if self.profile is None:
            return
        if self.n_components > 1:
            raise ValueError(
                f"profile is given for n_components = {self.n_components}: it serves one component"
            )
        profile = np.asarray(self.profile, dtype=np.float64)
        if profile.ndim != 2 or not (np.isfinite(profile) & (profile >= 0)).all():
            raise ValueError(
                f"profile with shape {profile.shape} must be (Ny, Nx), finite and not negative"
            )
        if not profile.any():
            raise ValueError("profile is zero everywhere")
