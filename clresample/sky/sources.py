"""Sources of a scene: point sources and extended sources at given positions."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from astropy.coordinates import ICRS, BaseCoordinateFrame, SkyCoord

from .observation import observation_index
from .validation.checks import as_float_array, check_integer


class SourceWarning(UserWarning):
    """A source without light in the images: its position is probably wrong."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A source at one position, given on the sky, in an observation's or in the model's pixels.

    sky_deg (2,) [deg]: right ascension and declination (for a flat sky: y, x [arcsec]), or
        longitude and latitude in the WCS's own frame. Or a SkyCoord of one position, in any frame,
        which is stored in degrees, with `sky_frame`
    position_px (2,) [px]: (y, x), the centre of the first pixel at (0, 0). Exactly one of sky_deg
        and position_px must be passed
    observation: the name (or label, if it has no name) of the Observation whose pixels position_px
        refers to; None = those of the model frame. By default the model frame is the union of all
        footprints (see `model_frame`), whose first pixel few users know: pass the frame too, or
        the observation's name. Sources of a Result are in pixels of its frame: pass that with them
    name: its name in the catalogue, unique in a fit; None = its number
    group: number of the sources that may be pieces of one galaxy with it, as `detect` gives it, of
        one detection; the catalogue then has their total fluxes too. None = it is no piece
    sky_frame: "icrs" where sky_deg was a SkyCoord; None = numbers in the frame of the grid's WCS

    Raises ValueError unless there is exactly one position, which must be finite, and for an
    observation together with sky_deg.
    """

    sky_deg: tuple[float, float] | None = None
    position_px: tuple[float, float] | None = None
    observation: str | None = None
    name: str | None = None
    sky_frame: str | None = None
    group: int | None = None

    def __post_init__(self):
        if self.group is not None:
            check_integer("group", self.group)
        if (self.sky_deg is None) == (self.position_px is None):
            raise ValueError(
                "a source takes either sky_deg or position_px, "
                f"not sky_deg={self.sky_deg} with position_px={self.position_px}"
            )
        name = "sky_deg" if self.position_px is None else "position_px"
        if name == "sky_deg" and isinstance(self.sky_deg, BaseCoordinateFrame | SkyCoord):
            object.__setattr__(self, "sky_deg", _icrs(self.sky_deg))
            object.__setattr__(self, "sky_frame", ICRS.name)
        if self.sky_frame not in (None, ICRS.name):
            raise ValueError(f"sky_frame is {self.sky_frame!r:.80}, must be {ICRS.name!r} or None")
        given = getattr(self, name)
        position = as_float_array(name, given, "deg" if name == "sky_deg" else "pix")
        plain = isinstance(given, list | tuple) and all(type(v) in (int, float) for v in given)
        if not plain and position.shape == (2,):
            object.__setattr__(self, name, tuple(map(float, position)))
        if position.shape != (2,) or not np.isfinite(position).all():
            raise ValueError(f"{name} is {getattr(self, name)}, must be two finite numbers")
        if self.observation is not None and self.position_px is None:
            raise ValueError(
                f"observation is {self.observation!r}, but the position is on the sky: "
                "it goes with position_px"
            )

    def pixel(self, grid, observations=(), shifts=None) -> np.ndarray:
        """Position (2,) [px]: (y, x) on the model's grid; NaN outside its projection.

        observations: among which `observation` is looked up
        shifts (n_observations, 2) [model px]: of their pixels, None = none
        Raises ValueError if `observation` names none of them, or more than one.
        """
        if self.sky_deg is not None:
            a, b = self.sky_deg
            if self.sky_frame is None:
                return grid.pixel(a, b)
            return grid.pixel(SkyCoord(a, b, unit="deg", frame=self.sky_frame))
        if self.observation is None:
            return np.asarray(self.position_px, dtype=np.float64)
        i = observation_index(observations, self.observation)
        observations[i].grid.check_like(grid, "frame")
        y, x = np.asarray(self.position_px, dtype=np.float64)
        position = observations[i].grid.positions_in(grid, y, x)
        return position if shifts is None else position + shifts[i]

    def on_frame(self, position) -> Source:
        """This source at a position (2,) [px] of the model frame, if it was one of an observation.

        Raises ValueError for a position that is not finite, outside the frame's projection.
        """
        if self.observation is None:
            return self
        if not np.isfinite(position).all():
            raise ValueError(
                f"position_px {self.position_px} of observation {self.observation!r} has no place "
                "in the model frame's projection"
            )
        y, x = map(float, position)
        return replace(self, position_px=(y, x), observation=None)


def check_unique_names(sources):
    """Raises ValueError if several sources have one name."""
    for name, n in Counter(s.name for s in sources if s.name).items():
        if n > 1:
            raise ValueError(
                f"name {name!r} is that of {n} sources, must be unique: give each its own, or none"
            )


def _icrs(coordinate):
    """Right ascension and declination [deg] of a SkyCoord of one place.

    Raises ValueError for several places.
    """
    if coordinate.shape != ():
        raise ValueError(
            f"sky_deg is a SkyCoord of shape {coordinate.shape}, must be of one place: give each "
            "source its own, [ExtendedSource(sky_deg=c) for c in coordinates]"
        )
    sky = SkyCoord(coordinate).icrs
    return float(sky.ra.deg), float(sky.dec.deg)


@dataclass(frozen=True, kw_only=True)
class PointSource(Source):
    """A star: the model's PSF at the position, one spectrum. For the position see `Source`.

    free_position: let the position move by a sub-pixel shift in the fit
    """

    free_position: bool = False


@dataclass(frozen=True, kw_only=True)
class ExtendedSource(Source):
    """A galaxy: `n_components` morphologies about one centre, each with a spectrum of its own.

    For the position see `Source`.

    n_components: None = one, or two if the galaxy's core differs significantly in colour from the
        rest, or lies in light that is far wider, which only fits with a MultiscalePrior test. A
        source that looks like the PSF is fitted as a PointSource, unless this or a profile is given
    profile (Ny, Nx) [1]: expected image of its only morphology under the model's PSF, on the
        frame's pixels, non-negative; None = a smooth profile fitted to the data
    """

    n_components: int | None = None
    profile: np.ndarray | None = field(default=None, compare=False, repr=False)

    def __post_init__(self):
        super().__post_init__()
        n_components = 1 if self.n_components is None else self.n_components
        check_integer("n_components", n_components, 1)
        if self.profile is None:
            return
        if n_components > 1:
            raise ValueError(
                f"profile is given for n_components = {self.n_components}: it serves one component"
            )
        profile = as_float_array("profile", self.profile)
        if profile.ndim != 2 or not (np.isfinite(profile) & (profile >= 0)).all():
            raise ValueError(
                f"profile with shape {profile.shape} must be (Ny, Nx), finite and not negative"
            )
        if not profile.any():
            raise ValueError("profile is zero everywhere")


def group_rows(sources) -> list[int]:
    """Number of the first source of each one's group, its own where it is in none."""
    first: dict = {}
    return [i if s.group is None else first.setdefault(s.group, i) for i, s in enumerate(sources)]


def join_groups(sources, more, hosts) -> tuple:
    """Sources and more of them, in the groups of their hosts.

    hosts (k,): number of the source of which each one of `more` may be a piece, -1 for none
    """
    found = list(sources)
    for source, host in zip(more, hosts, strict=True):
        if host >= 0:
            group = found[host].group
            if group is None:
                group = 1 + max((s.group for s in found if s.group is not None), default=-1)
                found[host] = replace(found[host], group=group)
            source = replace(source, group=group)
        found.append(source)
    return tuple(found)


def is_open(source) -> bool:
    """Returns True for a galaxy of which only the position is given: data choose its components."""
    return (
        isinstance(source, ExtendedSource)
        and source.n_components is None
        and source.profile is None
    )
