"""Measures PSFs of single stars from their own light, beyond the PSF passed by the user.

A saturated star shows its PSF farther out than any PSF image: far wings, spikes, ghosts. That
light belongs to the star, not to its neighbours. Around each star with a masked core, the part of
the light that persists along rays is the star's own PSF. The core comes from the PSF of the
observation, P:

    P_s(r, t) ~ B(r) + G(r, t),    B: median of d over angles,    G: median of d - B along rays

beyond the core and away from the light of listed sources, and a P inside the core, where the mean
of a P equals B at the rim. Behind a listed source G is that on the opposite side of the star, as
spikes and haloes of a mirror are alike there. Of a star with a small core, a P is all that lies
within the PSF's image, and a that of least squares.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import (
    distance_transform_edt,
    gaussian_filter,
    map_coordinates,
    median_filter,
    uniform_filter1d,
)

from ...sky.observation import with_psf_field
from ...sky.psf import PSF, SIGMAS_A_FWHM
from ...sky.sources import PointSource, is_open
from ...sky.varying_psf.field import PSFField
from .psf_samples import inscribed_radius, psf_at, ring_mean
from .spoilt import GROW_PX
from .star_cores import star_cores
from .star_profile import RadialProfile

# [FWHM of the PSF] Length of the medians along rays, where the star's light is over so many sigma.
# Unlisted sources are narrower than half of it, or fainter than such light.
MEDIANS_FWHM = {-np.inf: 8.0, 30.0: 3.0, 100.0: 1.0}
# [sigma], [distance from the star] Light of a listed source ends where the median of a ring around
# it is fainter, or at this part of the distance: beyond both it is taken for the star's.
LIGHT_SIGMAS, REACH_PART = 0.25, 0.75
# [its error] Smallest departure of a median along a ray from that of all rays: smaller ones are
# noise and wings of galaxies. Those of listed sources are as faint as LIGHT_SIGMAS, one error.
MIN_LASTING = 4.0
# Iterations in which the smoothed remainder is added, so that gradients are preserved.
N_ROUNDS = 5
# [FWHM of the PSF] Radius of a core from which a source listed as a galaxy is fitted as a star: no
# galaxy's light falls like that of a PSF at such radii. Stars with smaller cores keep the PSF of
# the observation: light beside these falls too steeply for a profile. In `simulate field --sky
# bright`, seed 2, the star's fluxes are 0.92 to 1.00 of the truth, with profiles 0.8 to 10.
MIN_STAR_RADIUS_FWHM = 1.0
# [px] Margin around such a core: chi2 of a real one is 1.10 to 1.29 in six exposures, 1.13 to 1.38
# with one pixel less (bench.real, decam_star).
WIDE_GROW_PX = 3
# [px] Tolerance in the comparison of positions with those of stars, because of rounding.
SAME_PLACE_PX = 0.5
# [sigma] Smallest rise of light outwards that is a ring of diffraction: a profile that falls cannot
# have it, and the PSF passed has. Medians of rings are noisy by a tenth of that. With 30, for the
# ring's own light, stars of Euclid just over saturation had twice their flux.
MIN_RISE_SIGMAS = 3.0
# [sigma] Smallest light of a halo at the edge of the PSF's image: fainter ones are not worth the
# time that a PSF of its own takes in each window of a start.
MIN_HALO_SIGMAS = 0.25
# Largest side of the PSF of a star with a halo: that of a star in 400 px, with 10 samples a pixel,
# would take 9 s and 1.4 GB.
MAX_HALO_SAMPLES = 1200
# [1] Largest ratio of a halo to the PSF at the edge of its image: more light is of galaxies.
MAX_HALO_RATIO = 2.0
MIN_USABLE_WEIGHT = 0.99  # [1] of the weights of interpolation between pixels


@dataclass(frozen=True, eq=False)
class StarPSFs(PSFField):
    """PSFs of an observation, replaced at single stars by the stars' own.

    psf: PSF at all other places, or field: PSFField of them; places (K, 2) [px] of the stars
    own (K): PSFs of the stars
    flux_error (K, C) [1]: relative flux error of each star, beyond that of the PSF's width
    measured_px (K, C): radius beyond which the light of each star is extrapolated
    keeps_core (K,): bool, stars with the PSF passed and wings of their own beyond its image
    """

    psf: PSF
    field: PSFField | None
    places: np.ndarray
    own: tuple[PSF, ...]
    flux_error: np.ndarray
    measured_px: np.ndarray
    keeps_core: np.ndarray

    @property
    def n_bands(self):
        return self.psf.n_bands

    def number_at(self, y, x):
        """Number of the star at (y, x) [px], or None."""
        away = np.hypot(*(self.places - (y, x)).T)
        return int(away.argmin()) if away.min() < SAME_PLACE_PX else None

    def psf_at(self, y, x):
        star = self.number_at(y, x)
        return self.passed_at(y, x) if star is None else self.own[star]

    def passed_at(self, y, x):
        """The PSF at (y, x) [px] as the user passed it."""
        return self.psf if self.field is None else self.field.psf_at(y, x)


def with_star_psfs(image, sources, sky, sky_beside_wide):
    """The InspectedImage with own PSFs for masked stars, and two numbers of channels (S,) of each.

    Those in which it has a wide core, from MIN_STAR_RADIUS_FWHM, and those of them in which it does
    not keep the PSF's core. A source listed as a galaxy with a wide core is a star in all channels.

    The masked pixels of wide cores grow by WIDE_GROW_PX, of others by `spoilt.GROW_PX`; see
    `StarCore.grown`. Without any core the image is returned unchanged.

    sources: those of `image.places`; sky, sky_beside_wide: True if a sky level is fitted,
        without and with wide cores
    """
    may_be_star = np.array([isinstance(s, PointSource) or is_open(s) for s in sources], bool)
    stars = np.flatnonzero(may_be_star & image.inside).tolist()
    found, (n_wide, n_own) = {}, np.zeros((2, len(sources)), int)
    if not stars or image.usable.all():
        return image, n_wide, n_own
    for c, usable in enumerate(image.usable):
        for core in star_cores(image.brightness[c], usable, image.observation.psf, c):
            away = np.hypot(*(image.places[stars] - core.place).T)
            if away.min() < max(core.radius, 1.0):
                is_wide = core.radius > MIN_STAR_RADIUS_FWHM * image.observation.psf.fwhm_px[c]
                found.setdefault(stars[int(away.argmin())], {}).setdefault(c, (core, is_wide))
    for i, cores in list(found.items()):
        n_wide[i] = sum(is_wide for _, is_wide in cores.values())
        if not n_wide[i] and not isinstance(sources[i], PointSource):
            del found[i]
    grown = np.zeros(image.usable.shape, bool)
    for c, (core, is_wide) in (pair for cores in found.values() for pair in cores.items()):
        given = image.brightness[c], image.usable[c], WIDE_GROW_PX if is_wide else GROW_PX
        grown[c] |= image.usable[c] & core.grown(*given)
    image = image.without(grown) if grown.any() else image
    sky = sky_beside_wide if n_wide.any() else sky
    for i, cores in found.items():
        own = {c: _measure_psf(image, c, i, *core, sky) for c, core in cores.items()}
        found[i] = {c: measured for c, measured in own.items() if measured is not None}
        n_own[i] = sum(not measured.keeps_core for measured in found[i].values())
    found = {i: own for i, own in found.items() if own}
    if not found:
        return image, n_wide, n_own
    o, numbers = image.observation, sorted(found)
    psfs = tuple(_combine_psfs(listed_psf(o, image.listed[i]), found[i]) for i in numbers)
    flux_error = np.zeros((len(numbers), len(grown)))
    measured_px = np.full(flux_error.shape, np.inf)
    for k, i in enumerate(numbers):
        for c, measured in found[i].items():
            flux_error[k, c], measured_px[k, c] = measured.flux_error, measured.measured_px
    keeps_core = n_own[numbers] == 0
    places, own = image.listed[numbers], (flux_error, measured_px, keeps_core)
    field = StarPSFs(o.psf, o.psf_field, places, psfs, *own)
    return dataclasses.replace(image, observation=with_psf_field(o, field)), n_wide, n_own


def replace_by_stars(sources, numbers, still):
    """Replaces the sources with these numbers by PointSources; those in `still` are fixed.

    The PSFs of sources in `still` were measured about their positions.
    """
    found = list(sources)
    for i in numbers:
        keys = ("sky_deg", "position_px", "observation", "name", "sky_frame", "group")
        given = {key: getattr(sources[i], key) for key in keys}
        free = i not in still and getattr(sources[i], "free_position", True)
        found[i] = PointSource(**given, free_position=free)
    return tuple(found)


def listed_psf(observation, place):
    """The PSF of an observation at a place (2,) [px], as the user passed it."""
    if observation.psf_field is None:
        return observation.psf
    return observation.psf_field.psf_at(*place)


def _combine_psfs(given, own):
    """Replaces bands of a PSF by {band: MeasuredPSF}."""
    shape = np.max([given.images.shape[1:], *(one.image.shape for one in own.values())], axis=0)
    images, centers = np.zeros((given.n_bands, *shape)), given.center.copy()
    for c, image in enumerate(given.images):
        if c in own:
            image, centers[c] = own[c].image, own[c].center
        images[c, : image.shape[0], : image.shape[1]] = image
    return PSF.restore(images, spacing=given.spacing, center=centers)


@dataclass(frozen=True, eq=False)
class MeasuredPSF:
    """A star's own PSF in a channel.

    image (ny, nx): its samples, center (2,) [samples]; flux_error, measured_px, keeps_core: see
        StarPSFs
    """

    image: np.ndarray
    center: np.ndarray
    flux_error: float
    measured_px: float
    keeps_core: bool


def _measure_psf(image, c, i, core, is_wide, sky):
    """The MeasuredPSF of star i in channel c.

    None if the star's light does not fall from the core outwards, or that of a star which keeps the
    PSF's core has no halo beyond the PSF's image. The samples' sum is 1 less the light left out of
    the core.
    i: number of the model's star; core: StarCore; is_wide: see `with_star_psfs`; sky: True if a
        sky level is fitted
    """
    o, fwhm, place = image.observation, float(image.observation.psf.fwhm_px[c]), image.places[i]
    psf, (n_y, n_x) = listed_psf(o, place), image.usable.shape[1:]
    # the fit has no sky level, or a fitted one
    data = np.where(image.usable[c], o.data[c] - sky * image.level[c], 0.0)
    middle, radius = core.place, core.radius + WIDE_GROW_PX
    away = np.hypot(np.arange(n_y)[:, None] - middle[0], np.arange(n_x) - middle[1])
    beside = image.usable[c] & (away >= radius)
    profile = RadialProfile.measure(data, beside, away, image.sigma[c]) if is_wide else None
    keeps_core = profile is None or profile.rise > MIN_RISE_SIGMAS * image.sigma[c]
    if keeps_core:
        middle, radius = place, inscribed_radius(psf, c)
        away = np.hypot(np.arange(n_y)[:, None] - middle[0], np.arange(n_x) - middle[1])
        beside = image.usable[c] & (away >= radius - fwhm)
    measured = data, beside, away, image.sigma[c]
    profile = _measure_profile(*measured, radius, keeps_core)
    if profile is None:
        return None
    others = np.delete(image.places, i, axis=0)[np.delete(image.inside, i)]
    rest = (data - profile.at(away)) / image.sigma[c]
    free = ~_near_sources(rest, image.usable[c], others, middle, fwhm)
    measured = data, beside & free, away, image.sigma[c]
    profile = _measure_profile(*measured, radius, keeps_core) or profile
    if keeps_core:
        scale = _amplitude(psf, c, data, image.usable[c] & free & (away < radius), middle)
    else:
        scale = _scale(psf, c, profile, radius)
    rest = (data - profile.at(away)) / image.sigma[c]
    rays, seen, free = _rays(rest, image.usable[c], free, middle, radius)
    if not scale or not (seen & free).any():
        return None
    light = profile.at(np.arange(len(rays))) / image.sigma[c]
    lasting = _lasting(rays, seen & free, seen & ~free, light, int(np.ceil(radius)), fwhm)
    # samples at the PSF's spacing about the star, over all of the image that its halo reaches
    step, low, high = psf.spacing, -middle, np.array([n_y - 1, n_x - 1]) - middle
    if keeps_core:
        at_edge = _scale(psf, c, profile, radius)
        if profile.at(radius) < MIN_HALO_SIGMAS * image.sigma[c] or (
            not at_edge or at_edge > MAX_HALO_RATIO * scale
        ):
            return None
        lit = np.flatnonzero(light > LIGHT_SIGMAS).max(initial=0)
        reach = max(min(float(lit), MAX_HALO_SAMPLES * step / 2), radius + fwhm)
        low, high = np.maximum(low, -reach), np.minimum(high, reach)
    y, x = (
        np.arange(np.floor(a / step), np.ceil(b / step) + 1) * step
        for a, b in zip(low, high, strict=True)
    )
    away, turn = np.hypot(y[:, None], x), np.arctan2(y[:, None], x) / (2 * np.pi)
    n_angles = lasting.shape[1] - 1
    more = map_coordinates(lasting, [away, turn % 1 * n_angles], order=1, mode="nearest")
    more = image.sigma[c] * _smooth(more, fwhm / SIGMAS_A_FWHM / step)
    taken = np.clip((radius - away) / fwhm, 0, 1)  # of the PSF given, none beside the core
    if keeps_core:
        more *= 1 - taken
    whole = taken * scale * _within_image(psf, c, y, x) + (1 - taken) * profile.at(away) + more
    total = whole.sum()
    if not total > 0:
        return None
    # the model's star lies at `place`, its light about the middle
    center = np.array([-y[0], -x[0]]) / step + (place - middle) / step
    if keeps_core:
        return MeasuredPSF(whole / total, center, 0.0, np.inf, keeps_core)
    own = profile.with_core(away, radius) + more
    flux_error = abs(profile.power(radius) - 2)
    return MeasuredPSF(own / total, center, flux_error, profile.end, keeps_core)


def _measure_profile(data, usable, away, sigma, radius, keeps_core):
    """RadialProfile of a star, of the halo beyond a radius if it keeps the PSF's core; or None."""
    profile = RadialProfile.measure(data, usable, away, sigma)
    if not keeps_core or (profile is not None and profile.end > radius):
        return profile
    return RadialProfile.measure_halo(data, usable, away, sigma, radius)


def _near_sources(rest, usable, places, star, fwhm):
    """Selects the pixels (My, Mx) of the light of listed sources, which is not the star's.

    Around each place, up to the ring where the median of the rest is below LIGHT_SIGMAS.
    rest (My, Mx) [sigma]: data without the star's mean profile; places (S, 2), star (2,) [px]
    """
    found = np.zeros(rest.shape, bool)
    for place in places:
        end = max(fwhm, REACH_PART * np.hypot(*(place - star)))
        low = np.maximum(np.floor(place - end).astype(int), 0)
        high = np.ceil(place + end).astype(int) + 1
        near = np.s_[low[0] : max(high[0], 0), low[1] : max(high[1], 0)]
        away = np.hypot(*(np.indices(found[near].shape) + (low - place)[:, None, None]))
        radius, light = fwhm, np.where(usable[near], rest[near], np.nan)
        while radius < end:
            ring = light[np.abs(away - radius) < 0.5]
            ring = ring[np.isfinite(ring)]
            if not ring.size or np.median(ring) < LIGHT_SIGMAS:
                break
            radius += 1.0
        found[near] |= away < radius
    return found


def _rays(data, usable, free, place, radius):
    """Samples an image (My, Mx) along rays from a place: (radii, angles).

    Also returns the samples on usable pixels from the radius [px] on, and those on free ones, bool.
    """
    corners = np.array([(y, x) for y in (0, data.shape[0] - 1) for x in (0, data.shape[1] - 1)])
    end = int(np.ceil(np.hypot(*(corners - place).T).max())) + 1
    n_angles = 2 * int(np.ceil(np.pi * end))  # even, so that each ray has an opposite one
    angles, radii = np.arange(n_angles) * 2 * np.pi / n_angles, np.arange(end + 1.0)[:, None]
    at = [place[0] + radii * np.sin(angles), place[1] + radii * np.cos(angles)]
    rays = map_coordinates(np.where(usable, data, 0.0), at, order=1, mode="constant")
    seen, free = (
        map_coordinates(pixels.astype(float), at, order=1, mode="constant") > MIN_USABLE_WEIGHT
        for pixels in (usable, free)
    )
    return rays, seen & (radii >= radius), free


def _scale(psf, band, profile, radius):
    """Factor that scales a PSF to the light of a RadialProfile at a radius [px].

    None if the PSF has no light there.
    """
    end = min(radius, inscribed_radius(psf, band))
    if end < 1:
        return None
    ring = ring_mean(psf, band, end)
    return float(profile.at(end)) / ring if ring > 0 else None


def _amplitude(psf, band, data, chosen, place):
    """Factor that scales a PSF about a place (2,) [px] to the chosen pixels (My, Mx) of data.

    None if the PSF has no light there.
    """
    y, x = np.nonzero(chosen)
    if not len(y):
        return None
    ys, xs = np.arange(y.min(), y.max() + 1), np.arange(x.min(), x.max() + 1)
    light = psf_at(psf, band, ys - place[0], xs - place[1])[y - ys[0], x - xs[0]]
    power = light @ light
    return float(light @ data[chosen] / power) if power > 0 else None


def _lasting(rest, known, hidden, light, first, fwhm):
    """Light above the mean that persists along rays: (radii, angles + 1), first angle repeated.

    Where it departs from the median of all rays by less than MIN_LASTING errors it is that median,
    or 0 if that is positive: the mean may be too bright where it is extrapolated, and wings of
    galaxies are in all rays.

    rest (radii, angles) [sigma]: light above the mean; known, hidden: its valid samples, and those
        of the light of listed sources, bool
    light (radii,) [sigma]: the mean
    first: number of the core's last ring, within which the result falls to 0
    """
    half = rest.shape[1] // 2
    behind = hidden & np.roll(known, half, axis=1)
    rest = np.where(behind, np.roll(rest, half, axis=1), rest)
    nearest = distance_transform_edt(~(known | behind), return_distances=False, return_indices=True)
    rest = rest[tuple(nearest)]
    lasting = np.zeros_like(rest)
    for least, length in MEDIANS_FWHM.items():
        over = light > least
        size = _odd(length * fwhm)
        median = median_filter(rest, (size, 1), mode="reflect")
        n = size * uniform_filter1d((known | behind).astype(float), size, axis=0, mode="constant")
        error = np.sqrt(np.pi / 2 / np.maximum(n, 1.0))
        level = np.minimum(np.median(median, axis=1, keepdims=True), 0.0)
        clear = np.abs(median - level) > MIN_LASTING * error
        lasting[over] = np.where(clear, median, level)[over]
    lasting = lasting[tuple(nearest)]
    lasting[:first] = np.arange(first)[:, None] / max(first, 1) * lasting[first]
    return np.concatenate([lasting, lasting[:, :1]], axis=1)


def _smooth(image, sigma):
    """Smooths an image (n, m) like light behind a Gaussian PSF of `sigma` [samples]."""
    found = np.zeros(image.shape)
    for _ in range(N_ROUNDS):
        found += gaussian_filter(image - found, sigma, mode="nearest")
    return found


def _within_image(psf, band, y, x):
    """Values (n, m) of a PSF at y (n,), x (m,) [px] from its centre, 0 beyond its image."""
    sides = zip((y, x), psf.images.shape[1:], psf.center[band], strict=True)
    on_y, on_x = ((d / psf.spacing > -c) & (d / psf.spacing < n - 1 - c) for d, n, c in sides)
    return psf_at(psf, band, y, x) * (on_y[:, None] & on_x)


def _odd(n):
    return 2 * int(n / 2) + 1
