"""The model's own pixels and PSF, in which all sources are described."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from astropy.coordinates import SkyCoord

from .extent import bounding_boxes_overlap, grid_intersection, grid_union, grids_overlap
from .grid import Grid, as_grid
from .observation import as_observations, check_observations
from .psf import PSF
from .validation.observed import as_psf

# [sigma] Half-width of the model PSF's image: less than 1e-16 of the light, float64's rounding,
# lies beyond. Larger images only cost time.
REACH = 8.5
# Number of model pixels along a pixel where dithered images resolve more than one of them. A PSF of
# one pixel has 3 % of its transform left at the limit of half pixels.
REFINEMENT = 2
# [cycles / model px], [1] Frequency and least transform there of a PSF that the model's own PSF, of
# 0.41, hardly resolves: Moffat PSFs (beta = 3.5) of up to 2 pixels FWHM.
NARROW_FREQUENCY, MIN_NARROW_TRANSFORM = 0.25, 0.25
# [1] Part of a star's image in a band that may be wrong where the mean PSF of several bands is
# aliased in another way, see `_alias_differently`. Fluxes of stars of signal to noise 1000 under
# two Airy PSFs are right at 0.007, 7 and 10 % off at 0.011 (FWHM of 1.1 and 1.2 px), and 20 % at
# 0.03 (1.1 and 1.4 px). Two bands of Roman have 0.03.
MAX_ALIASED = 0.01
N_WAVES = 33  # along an axis, to measure that
# [1] of the smallest pixels: images of larger ones, which are not dithered, do not have the same.
COARSER = 1.5
# [1] Transfer below which a PSF's waves are noise.
MIN_TRANSFER = 1e-3
# [px] Distance between the pixels of two images from which they are dithered.
MIN_DITHER_PX = 0.1
# [FWHM of the widest PSF], [1] of the frame's shorter side: distance from the frame up to which
# listed sources have room in it, the lesser of the two. Without room four galaxies near sources as
# far outside had 0.01 to 0.72 of their flux, at up to 4 errors and without a flag. [1] Of that
# distance, the frame's margin around these sources.
REACH_FWHM, REACH_PART, MARGIN_PART = 3.0, 0.25, 0.67
# Relative difference below which two pixel scales are equal: the precision of headers.
SAME_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class Frame:
    """Pixels and PSF of the model.

    grid: Grid of the model's pixels (Ny, Nx), or a WCS with a shape
    psf: PSF of one band in these pixels, pixel response included; see `model_frame`

    Raises ValueError for anything else.
    """

    grid: Grid
    psf: PSF

    def __post_init__(self):
        object.__setattr__(self, "grid", as_grid("grid", self.grid))
        object.__setattr__(self, "psf", as_psf("psf", self.psf))

    @property
    def shape(self) -> tuple[int, int]:
        """(Ny, Nx) [px]."""
        return self.grid.shape

    def positions_of(self, sources, observations=(), shifts=None) -> np.ndarray:
        """Positions (S, 2) [px] of the sources: (y, x); NaN outside the projection.

        observations: Observations that sources may refer to; shifts (n_observations, 2) [model px]:
            of these; see `Source.pixel`
        """
        found, of_frame = np.full((len(sources), 2), np.nan), defaultdict(list)
        for i, source in enumerate(sources):
            if source.sky_deg is None:
                found[i] = source.pixel(self.grid, observations, shifts)
            else:
                of_frame[source.sky_frame].append(i)
        for sky_frame, rows in of_frame.items():  # together, as a SkyCoord takes milliseconds
            a, b = np.array([sources[i].sky_deg for i in rows], float).T
            if sky_frame is not None:
                a, b = SkyCoord(a, b, unit="deg", frame=sky_frame), None
            found[rows] = self.grid.pixel(a, b)
        return found

    def contains(self, positions) -> np.ndarray:
        """Selects positions (..., 2) [px] on a pixel of the frame: -1/2 <= x < N - 1/2.

        A position on the edge of a pixel belongs to pixel floor(x + 1/2). A fit omits a source
        outside the frame, with a warning: its centre, from which morphologies decrease, is not in
        the frame, nor is most of its light. A source inside is fitted, however near to the edge,
        with the part of its light that falls on the frame.

        returns (...) bool; False for NaN
        """
        positions = np.asarray(positions, dtype=np.float64)
        return ((positions >= -0.5) & (positions < np.array(self.shape) - 0.5)).all(axis=-1)


def model_frame(observations, *, grid=None, psf_sigma_px=0.8, shared=False) -> Frame:
    """Frame on pixels as the observations need them, with a Gaussian PSF.

    observations: what will be fitted; see `check_observations`
    grid: Grid to use unchanged; None = the pixels and orientation of the observation with the
        smallest pixels (the first if several are equal), as many pixels as needed; its pixels
        halved if two or more observations, dithered or rotated, have a PSF of less than about two
        of them: together these resolve more than each does. Halved also for two or more PSFs
        that the same pixels alias differently, as those of Roman's bands
    psf_sigma_px [model px]: standard deviation of the PSF before its convolution with the pixel;
        no more than the frame has pixels along a side
    shared: cover the intersection of the observations' footprints instead of their union

    Footprints are bounding boxes along the frame's axes. The box of a rotated observation has
    corners that the observation does not cover, so that some pixels of the frame may be covered by
    no observation, also if `shared`. Observed pixels outside the frame have no model and must get
    weight 0 (`Resampler.covered`).

    Raises ValueError if only one of grid and observations has a WCS, if an observation does not
    overlap the others or the frame, and as `check_observations` does.
    """
    observations = as_observations(observations)
    check_observations(observations)
    if not 0 < psf_sigma_px < math.inf:
        raise ValueError(f"psf_sigma_px must be a positive number of pixels, not {psf_sigma_px}")
    if grid is None:
        scales = np.array([o.grid.pixel_scale_arcsec for o in observations])
        like = observations[int(np.argmax(scales <= (1 + SAME_SCALE) * scales.min()))].grid
        _check_connected(observations, like)
        if _resolve_more(observations, like):
            like = like.refined(REFINEMENT)
        extent = grid_intersection if shared else grid_union
        grid = extent([o.grid for o in observations], like=like)
    grid = as_grid("grid", grid)
    for observation in observations:
        if observation.grid.is_flat != grid.is_flat:
            raise ValueError(
                f"grid is {grid.sky_description}, observation {observation.label!r} "
                f"{observation.grid.sky_description}: give both a WCS (Grid.to_wcs)"
            )
        if not grids_overlap(observation.grid, grid):
            raise ValueError(
                f"observation {observation.label!r} does not overlap the model frame: "
                f"none of its {observation.grid.shape} pixels lies on the frame's "
                f"{grid.shape}"
            )
    if psf_sigma_px > max(grid.shape):
        raise ValueError(
            f"psf_sigma_px is {psf_sigma_px:g} px, must be at most the longer side of the model "
            f"frame {grid.shape}"
        )
    return Frame(grid, model_psf(float(psf_sigma_px)))


def grow_to_sources(frame, observations, sources, shifts=None) -> Frame:
    """The frame with room for sources just outside of it, whose light is in the images.

    These lie within REACH_FWHM of the widest PSF of the frame, or a quarter of its shorter side.
    The frame stays as it is if no source is inside, and if one has its position or its profile on
    the frame's pixels.

    observations: Observations, for their PSFs; shifts: see `Frame.positions_of`
    """
    if not all(s.sky_deg is not None and getattr(s, "profile", None) is None for s in sources):
        return frame
    at, last = frame.positions_of(sources, observations, shifts), np.array(frame.shape) - 1
    inside = frame.contains(at)
    if inside.all() or not inside.any():
        return frame
    widths = [o.psf.fwhm_px.max() * o.grid.pixel_scale_arcsec for o in observations]
    reach = REACH_FWHM * max(widths) / frame.grid.pixel_scale_arcsec
    reach = min(reach, REACH_PART * min(frame.shape))
    away = np.hypot(*np.maximum(np.maximum(-at, at - last), 0).T)
    near = at[(away <= reach) & ~inside]
    if not len(near):
        return frame
    low, high, margin = near.min(axis=0), near.max(axis=0), MARGIN_PART * reach
    low = np.where(low < -0.5, np.floor(low - margin), 0).astype(int)
    high = np.where(high >= last + 0.5, np.ceil(high + margin), last).astype(int)
    shape = tuple((high - low + 1).tolist())
    return Frame(frame.grid.cutout(*low.tolist(), shape), frame.psf)


@lru_cache(maxsize=4)
def model_psf(sigma_px=0.8):
    """The Gaussian of this standard deviation [model px] in model pixels."""
    # the pixel adds its own variance, 1/12, to the Gaussian's
    radius = math.ceil(REACH * math.hypot(sigma_px, 1 / math.sqrt(12)))
    return PSF.gaussian(sigma_px, n_pixels=2 * radius + 1)


def _resolve_more(observations, like):
    """Returns True if observations together resolve more than the pixels of `like` show."""
    narrow = [o for o in observations if _is_narrow(o, like)]
    if not narrow:
        return False
    first, *others = (o.grid for o in narrow)
    largest = COARSER * like.pixel_scale_arcsec
    # only samples finer than the pixels have waves that these alias
    on_like = [o.psf for o in narrow if o.grid.pixel_scale_arcsec < largest and o.psf.spacing < 1]

    def is_dithered(grid):
        ends = [(0, n - 1) for n in grid.shape]
        away = grid.positions_in(first, *np.meshgrid(*ends, indexing="ij"))
        return bool((np.abs(away - np.rint(away)) > MIN_DITHER_PX).any())

    return any(is_dithered(grid) for grid in others) or _alias_differently(on_like)


def _alias_differently(psfs):
    """Returns True if pixels alias PSFs in ways that one image of a star cannot show.

    Waves nu + m of a PSF appear as nu on pixels. An image with the part of them that the mean PSF
    has is wrong in a band by

        sum_nu,m |P(nu) T_m(nu) - P(nu + m)|^2 / sum_nu |P(nu)|^2

    along each axis, m = -1, 1, with T_m(nu) = mean P(nu + m) / mean P(nu) where that is no noise.
    """
    if sum(psf.n_bands for psf in psfs) < 2:
        return False
    nu, none = np.array([[0], [-1], [1]]) + np.linspace(-0.5, 0.5, N_WAVES), np.zeros(1)
    for axes in (nu, none), (none, nu):
        waves = np.concatenate([psf.otf(*axes).reshape(-1, *nu.shape) for psf in psfs])
        mean, own = waves.mean(axis=0), waves[:, :1]
        parts = mean[1:] * mean[0].conj() / (np.abs(mean[0]) ** 2 + MIN_TRANSFER**2)
        wrong, power = np.abs(own * parts - waves[:, 1:]) ** 2, np.abs(own) ** 2
        if (wrong.sum(axis=(1, 2)) > MAX_ALIASED**2 * power.sum(axis=(1, 2))).any():
            return True
    return False


def _is_narrow(observation, like):
    """Returns True if one of an observation's PSFs has too much transform for pixels of `like`."""
    scale = observation.grid.pixel_scale_arcsec / like.pixel_scale_arcsec
    nu = NARROW_FREQUENCY * scale  # [cycles / observed px]
    along = observation.psf.otf([nu], [0.0]), observation.psf.otf([0.0], [nu])
    return bool((np.abs(along).mean(axis=0) > MIN_NARROW_TRANSFORM).any())


def _check_connected(observations, like):
    """Raises ValueError unless overlaps connect all observations, directly or through others."""
    near, far = [observations[0]], list(observations[1:])
    while far:
        met = [o for o in far if any(bounding_boxes_overlap(o.grid, n.grid, like) for n in near)]
        if not met:
            raise ValueError(
                f"observation {far[0].label!r} does not overlap "
                f"{', '.join(repr(o.label) for o in near)}: these are not images of "
                "one patch of sky"
            )
        near += met
        far = [o for o in far if o not in met]
