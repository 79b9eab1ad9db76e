"""Smooth profiles of sources on model pixels, to which the prior adds structure.

A source has one ComponentProfile for each of its components: a GalaxyProfile, a FixedProfile or a
StarProfile. A profile is drawn from a few parameters theta (n,), which `start` fits to the data.

    S(x) = sum_k a_k N(x - c; C_k),   C_k = v_k sigma^2 [[1 + e1, e2], [e2, 1 - e1]] + C_psf

is a galaxy of Sersic's index n with half of its light within an ellipse of sigma sqrt(2 ln 2),
behind a Gaussian of C_psf, the second moment of the model's PSF; rows and columns (y, x). a_k and
v_k are those of n = 1/2 + 1 / (beta + BETA_0), see sersic.py. beta -> infinity is a Gaussian, small
beta has a cusp and wings, and sigma -> 0 is as wide as a star. Stars are the model's PSF itself,
see `draw_psf`.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy import ndimage

from ..sky.box import box_slices
from ..sky.psf import PSF
from ..sky.sources import ExtendedSource, PointSource
from .sampled_psf import alias_tables, reach_px
from .sersic import gaussians

# Number of cached OTFs of model PSFs: the stars of a frame share one, of 1 MB at 256 pixels.
N_OTFS = 8
# [px^2] Least second moment with which `draw_psf` divides a PSF's waves: that of the default PSF of
# frames. Noise in the wings of a frame's own PSF may leave a smaller one, or a negative one.
MIN_MOMENT = 0.64
# [px^2] Least second moment of the PSF behind which galaxies lie, of a Gaussian half a pixel wide.
MIN_GALAXY_MOMENT = 0.25
# Prior on a galaxy (start/population.py updates it from the scene's other galaxies): Gaussian sigma
# 0.25" (half-light radius 0.3") with a scatter of 0.4 in its logarithm, as in deep fields; round,
# with a scatter of 0.17 per component, or of any shape; n of 0.52 to 0.85. Real ones scatter by
# 0.26 (Leauthaud et al. 2007). With that scatter models of faint galaxies follow the noise: median
# SDRs of simulated COSMOS galaxies, 0.22" wide or more, are 0.1 to 0.3 dB lower in Euclid's or
# Rubin's images alone. Without that smoothing they are equal. With WINGS of 25 and 60 mean SDRs of
# COSMOS galaxies are 0.02 and 0.04 dB higher jointly, 0.1 and 0.15 dB in Rubin's images (40 scenes,
# seeds from 83001), but stars at the middle of compact hosts have the light of these: one of signal
# to noise 100 in a host of 100, n = 2.5, r_e = 0.4", 1.45 of its flux at 8 errors, and 1.22 at 2.6
# with these. With 6 they are 0.06 dB lower.
SIZE_ARCSEC, SIZE_SCATTER = 0.25, 0.4
ELLIPTICITY_SCATTER = 0.17
WINGS, WINGS_SCATTER = 12.0, 1.5
# Several components of a source start this far apart in ln(size), as a bulge and a disk do.
COMPONENT_SPREAD = 1.0
# Exponent of a Gaussian beyond which it has no light, as in kernels/draw.cl.
NO_LIGHT = 46
# Newton's steps to the distance of a brightness.
N_NEWTON = 6
# Galaxies whose Gaussians are kept, of 5 KB each: those of the blends of a batch.
N_GALAXIES = 1024
# [px] Scatter of a free star's position about the listed one.
STAR_SCATTER_PX = 0.5
# Aliased waves of a star are drawn down to this multiple of the light at which galaxies end, a
# tenth of a pixel's noise.
ALIAS_THRESHOLDS = 10.0
# [px] Distances to which they are searched, the second for stars bright enough: they reach far
# along both axes, and boxes that cut those of a saturated star at 33 px left rows of false sources.
ALIAS_PX = 12, 128
# [1] Least part of a component's light on pixels with weight of a band that determines its flux.
# Of galaxies in simulated images that lack a band beside them (144 scenes) 18 of 205 fluxes with
# less than 1 % are over 5 errors off, up to 3e5 times the truth, as errors of wings far below the
# noise are unknown; one of 49 with 1 to 5 %, of which three have a signal to noise over 5; none of
# 25 with 5 to 20 %, of which eleven have.
MIN_LIGHT = 0.05
# The same of a star, whose wings are its PSF's: fluxes of stars with masked cores that leave 0.2 to
# 17 % of the light are within two errors.
MIN_STAR_LIGHT = 1e-3


def covariance(parameters, psf_moment):
    """C (..., 2, 2) [px^2] and its derivatives (..., 3, 2, 2) by (ln sigma [px], g1, g2).

    parameters (..., 3 or more), psf_moment (..., 2, 2)
    e = g / sqrt(1 + g^2), so that |e| stays under 1
    """
    parameters = np.asarray(parameters)
    sigma2, g = np.exp(2 * parameters[..., 0])[..., None, None], parameters[..., 1:3]
    root = np.sqrt(1 + (g**2).sum(axis=-1))[..., None]
    shape = np.array([[[1.0, 0], [0, -1]], [[0, 1], [1, 0]]])
    e = g / root
    de = (np.eye(2) - e[..., :, None] * e[..., None, :]) / root[..., None]  # de_i / dg_j
    own = sigma2 * (np.eye(2) + np.einsum("...k,kij->...ij", e, shape))
    by_g = sigma2[..., None] * np.einsum("...kj,kab->...jab", de, shape)
    return own + psf_moment, np.concatenate([2 * own[..., None, :, :], by_g], axis=-3)


class GalaxyGaussians:
    """The Gaussians of galaxies, of second moments v_k (C - C_psf) + C_psf; arrays (n, K).

    parameters (n, 4); psf_moment (n, 2, 2)

    part: of the light, a_k;  moment (..., 3) and inverse (..., 3): yy, yx, xx of each
    root: of the determinants of the moments;  peak: of each, a_k / (2 pi root)
    """

    def __init__(self, parameters, psf_moment):
        parameters = np.asarray(parameters)
        own, by = covariance(parameters, 0.0)
        matrices = np.concatenate([by, own[..., None, :, :]], axis=-3)
        self._entries = matrices[..., [0, 0, 1], [0, 1, 1]].swapaxes(-1, -2)  # of own, by slope
        self.part, ln_v, self._part_slope, self._ln_v_slope = gaussians(parameters[..., 3])
        self._v = np.exp(ln_v)
        psf = psf_moment[..., [0, 0, 1], [0, 1, 1]]
        self.moment = self._v[..., None] * self._entries[..., None, :, 3] + psf[..., None, :]
        yy, yx, xx = np.moveaxis(self.moment, -1, 0)
        determinant = yy * xx - yx**2
        self.inverse = np.stack([xx, -yx, yy], axis=-1) / determinant[..., None]
        self.root = np.sqrt(determinant)
        self.peak = self.part / (2 * np.pi * self.root)

    def slopes(self):
        """Factors (n, K, 4, 4) of y^2, y x, x^2 and 1 times Gaussians in slopes by parameters."""
        a, b, c = np.moveaxis(self.inverse, -1, 0)
        scale = self.peak * self._v
        aa, bb, cc = (scale * one * one / 2 for one in (a, b, c))
        ab, bc, mixed = scale * a * b, scale * b * c, scale * a * c + 2 * bb
        a, b, c = scale * a / 2, scale * b, scale * c / 2
        factors = np.empty((*self.peak.shape, 4, 4))
        for i in range(4):
            # entries of I D I / 2 and - tr(I D) / 2, for the inverse I and the slope D of a moment
            yy, yx, xx = np.moveaxis(self._entries[..., None, :, i], -1, 0)
            one = factors[..., i, :]
            one[..., 0] = aa * yy + ab * yx + bb * xx
            one[..., 1] = ab * yy + mixed * yx + bc * xx
            one[..., 2] = bb * yy + bc * yx + cc * xx
            one[..., 3] = -(a * yy + b * yx + c * xx)
        factors[..., 3, :] *= self._ln_v_slope[..., None]
        factors[..., 3, 3] += self._part_slope / (2 * np.pi * self.root)
        return factors

    def at(self, y, x):
        """Brightness [1/px^2] of the first galaxy at distances y, x [px] of one shape from it."""
        light = np.zeros(np.shape(y))
        for peak, (yy, yx, xx) in zip(self.peak[0], self.inverse[0], strict=True):
            light += peak * np.exp(-(yy * y * y / 2 + yx * y * x + xx * x * x / 2))
        return light

    def reach(self, threshold):
        """Distance (n, 2) along y and x where profiles fall to a part (n,) of their peaks."""
        level = threshold * self.peak.sum(axis=-1)
        along = [_distance(self.moment[..., i], self.peak, level) for i in (0, 2)]
        return np.stack(along, axis=-1)

    def outside(self, r):
        """Part (n,) of the light beyond ellipses of the area of circles of radius r (n,) [px]."""
        return (self.part * self._fall(r)).sum(axis=-1)

    def threshold(self, outside):
        """Part (n,) of the peak beyond which lies a part (n,) of the light."""
        r = _distance(self.root, self.part, outside)
        return (self.peak * self._fall(r)).sum(axis=-1) / self.peak.sum(axis=-1)

    def _fall(self, r):
        return np.exp(-np.square(r)[..., None] / (2 * self.root))


def one_galaxy(parameters, psf_moment):
    """The GalaxyGaussians (1, K) of a galaxy, kept: its box, image and errors need them in turn.

    parameters (4,), psf_moment (2, 2)
    """
    return _one_galaxy(*(np.asarray(a, float).tobytes() for a in (parameters, psf_moment)))


@functools.lru_cache(maxsize=N_GALAXIES)
def _one_galaxy(parameters, psf_moment):
    return GalaxyGaussians(
        np.frombuffer(parameters)[None], np.frombuffer(psf_moment).reshape(1, 2, 2)
    )


def _distance(variance, part, level):
    """Distance r (n,) where the sum of part exp(-r^2 / (2 variance)) over K falls to `level`.

    The logarithm of the sum is convex in r^2 and not below that of one Gaussian: from where the
    first of these falls to the level Newton's steps come near the distance from inside.
    """
    part, level = np.maximum(part, 1e-30), np.broadcast_to(level, part.shape[:1])
    x = (2 * variance * np.log(part / level[:, None])).max(axis=-1, initial=0)  # r^2
    for _ in range(N_NEWTON):
        each = part * np.exp(-x[:, None] / (2 * variance))
        whole = each.sum(axis=-1)
        x += np.maximum(np.log(whole / level), 0) * whole / (each / (2 * variance)).sum(axis=-1)
    return np.sqrt(x)


def galaxy_reach(parameters, psf_moment, threshold):
    """Distance (n, 2) [px] along y and x within which profiles exceed a fraction of their peaks.

    parameters (n, 4); psf_moment (n, 2, 2); threshold (n,)
    """
    return GalaxyGaussians(parameters, psf_moment).reach(threshold)


def wave_light(parameters, psf_moment, nu):
    """Largest transform (n,) of profiles of unit integral at frequencies nu (n,) [1/px].

    parameters (n, 4); psf_moment (n, 2, 2)
    """
    some = GalaxyGaussians(parameters, psf_moment)
    yy, yx, xx = np.moveaxis(some.moment, -1, 0)
    least = (yy + xx) / 2 - np.hypot((yy - xx) / 2, yx)
    return (some.part * np.exp(-2 * np.pi**2 * np.reshape(nu, (-1, 1)) ** 2 * least)).sum(axis=-1)


def profile(parameters, position, shape, psf_moment, *, slopes=True, moved=False):
    """Profile of unit integral and its derivatives by (ln sigma, g1, g2, ln beta), (5, ny, nx).

    The profile alone (1, ny, nx) without `slopes`; if `moved`, those by the position (y, x) [px]
    too, (7, ny, nx).
    """
    some = one_galaxy(parameters, psf_moment)
    (peak,), (inverse,) = some.peak, some.inverse
    y, x = (np.arange(n) - p for n, p in zip(shape, position, strict=True))
    y, x = (a.ravel() for a in np.broadcast_arrays(y[:, None], x))
    terms = np.stack([y * y, y * x, x * x, np.ones(len(y))])
    exponent = (inverse * [0.5, 1, 0.5]) @ terms[:3]
    lit, drawn = exponent < NO_LIGHT, np.zeros_like(exponent)  # (K, pixels)
    np.exp(-exponent, where=lit, out=drawn)
    parts = [(peak @ drawn)[None]]
    if slopes:
        factors = some.slopes()[0].transpose(2, 1, 0)  # terms, slopes, Gaussians
        parts.append(sum((f @ drawn) * term for f, term in zip(factors, terms, strict=True)))
    if moved:
        by_place = (peak[:, None] * inverse).T[[[0, 1], [1, 2]]] @ drawn
        parts.append(by_place[:, 0] * y + by_place[:, 1] * x)
    return np.concatenate(parts).reshape(-1, *shape)


@functools.lru_cache(maxsize=N_OTFS)
def psf_second_moment(psf: PSF) -> np.ndarray:
    """Second moment (2, 2) [px^2] of the first band's image about its centre, rows (y, x).

    It is at least MIN_GALAXY_MOMENT along each axis: negative wings may leave less than nothing.
    """
    image = psf.images[0]
    y, x = (
        (np.arange(n) - c) * psf.spacing for n, c in zip(image.shape, psf.center[0], strict=True)
    )
    yy, xx, yx = (y**2) @ image.sum(1), (x**2) @ image.sum(0), y @ image @ x
    moments, axes = np.linalg.eigh(np.array([[yy, yx], [yx, xx]]))
    return axes * np.maximum(moments, MIN_GALAXY_MOMENT) @ axes.T


def draw_psf(psf: PSF, position, shape, *, slopes=True, sampled=()):
    """The PSF at a sub-pixel position and its derivatives by (y, x) (3, ny, nx), unit integral.

        S(x) = K^-2 sum_nu P^(nu) e(nu, c) exp(2 pi i nu.x),         K > n + its extent
        e(nu, c) = sum_m w_m(nu) exp(-2 pi i (nu + m).c),    m = -1, 0, 1 along y and x

    slopes: with the derivatives; else (1, ny, nx)
    sampled: PSFs of the observations on whose pixels the image lies, see `sampled_psfs`

    On a frame's pixels waves of nu and nu + m are one. Their parts w_m are those of `sampled`, so
    that the star is exact in these observations. Without any they are those of a Gaussian G of the
    PSF's second moment, w_m ~ G^(nu + m). With the wave of nu alone, e jumps at Nyquist's
    frequency, and a star between two pixels has lines of alternating sign along both axes, as far
    as the frame: at 60 px, 20 sigma of a saturated star of Euclid.
    """
    extent = int(np.ceil(max(psf.images.shape[1:]) * psf.spacing)) + reach_px(sampled)
    n_fft = max(shape) + 2 * extent + 1
    n_fft += 1 - n_fft % 2
    nu_y, nu_x = np.fft.fftfreq(n_fft), np.fft.rfftfreq(n_fft)
    moments = np.maximum(np.diag(psf_second_moment(psf)), MIN_MOMENT)
    pairs = zip((nu_y, nu_x), position, moments, strict=True)
    (along_y, slope_y), (along_x, slope_x) = (_shift(*one) for one in pairs)
    chosen = [(along_y, along_x), (slope_y, along_x), (along_y, slope_x)][: 3 if slopes else 1]
    waves = np.array([y[0][:, None] * x[0] for y, x in chosen])
    if sampled:
        tables, rest = alias_tables(sampled, n_fft)
        waves *= rest
        for wave, (y, x) in zip(waves, chosen, strict=True):
            for m, n in np.ndindex(3, 3):
                wave += tables[m, n] * (y[1][m][:, None] * x[1][n])
    images = np.fft.irfft2(_otf(psf, n_fft) * waves, s=(n_fft, n_fft))
    return images[:, : shape[0], : shape[1]].copy()


def _shift(nu, c, variance):
    """Waves of `draw_psf` along an axis, and their derivatives by c.

    Each is a pair, (K,) with the parts of the Gaussian and (3, K) of all m; variance [px^2]: of
    the PSF along this axis
    """
    at = nu + np.array([-1, 0, 1])[:, None]
    part = np.exp(-2 * np.pi**2 * variance * (at**2 - nu**2))
    waves, part = np.exp(-2j * np.pi * at * c), part / part.sum(axis=0)
    return tuple(((part * w).sum(axis=0), w) for w in (waves, -2j * np.pi * at * waves))


@functools.lru_cache(maxsize=N_OTFS)
def _otf(psf, n_fft):
    """P^ of the first band (n_fft, n_fft // 2 + 1) in the order of a real FFT."""
    return psf.otf(np.fft.fftfreq(n_fft), np.fft.rfftfreq(n_fft))[0]


@functools.lru_cache(maxsize=N_OTFS)
def _light_beside(psf, sampled, n):
    """Largest light (n + 1,) [peak] of a star on each square of pixels about it; see `draw_psf`."""
    shape = (2 * n + 1, 2 * n + 1)
    image = draw_psf(psf, (n, n), shape, slopes=False, sampled=sampled)[0]
    away = np.abs(np.indices(shape) - n).max(axis=0)
    return ndimage.maximum(np.abs(image), away, np.arange(n + 1)) / image.max()


class ComponentProfile:
    """The smooth profile of a component.

    mean, scatter (n,): of the prior on theta
    draw(theta, position, shape): (1 + n, Ny, Nx), the profile of unit integral for a source at a
        position (2,) [px], and its slopes by theta: on the frame, or on a box of a `shape`
    light: integral of the profile; min_light [1]: see MIN_LIGHT
    """

    mean = scatter = np.zeros(0)
    light, min_light = 1.0, MIN_LIGHT

    def draw(self, theta, position, shape=None):
        """The profile and its slopes."""
        raise NotImplementedError

    def draw_box(self, theta, position, origin, size, *, slopes=True):
        """The same in a box of the frame, (1 + n, ny, nx); (1, ny, nx) without `slopes`."""
        drawn = self.draw(theta, np.subtract(position, origin), tuple(size))
        return drawn if slopes else drawn[:1]

    def bounding_box(self, theta, position, threshold):
        """Middle (2,) and half size (2,) [px] of the pixels above a part of the peak."""
        raise NotImplementedError

    def center(self, theta, position):
        """Position of the component (2,) [px]."""
        return position


class GalaxyProfile(ComponentProfile):
    """A smooth elliptical profile; theta = (ln sigma [px], g1, g2, ln beta), see profiles.py.

    frame: the model's Frame; i_component of n_components: of its source, from compact to wide
    widened: factor of its expected size

    whole: True if it is the only component of its source
    """

    def __init__(self, frame, i_component=0, n_components=1, *, widened=1.0):
        scale_arcsec = float(np.mean(frame.grid.pixel_scale_arcsec))
        spread = COMPONENT_SPREAD * (i_component - (n_components - 1) / 2)
        size = np.log(SIZE_ARCSEC / scale_arcsec) + spread + np.log(widened)
        self.shape, self.psf_moment = frame.shape, psf_second_moment(frame.psf)
        self.whole = n_components == 1
        self.mean = np.array([size, 0, 0, np.log(WINGS)])
        self.scatter = np.array([SIZE_SCATTER, *[ELLIPTICITY_SCATTER] * 2, WINGS_SCATTER])

    def draw(self, theta, position, shape=None, *, moved=False):
        """The profile and its four slopes (5, Ny, Nx), if `moved` those by the position too."""
        return profile(theta, position, shape or self.shape, self.psf_moment, moved=moved)

    def draw_box(self, theta, position, origin, size, *, slopes=True):
        """The same in a box of the frame."""
        place = np.subtract(position, origin)
        return profile(theta, place, tuple(size), self.psf_moment, slopes=slopes)

    def bounding_box(self, theta, position, threshold):
        """Its ellipse where the profile falls to the threshold."""
        return position, one_galaxy(theta, self.psf_moment).reach(np.array([threshold]))[0]


class FixedProfile(ComponentProfile):
    """A profile (Ny, Nx) passed with the source; no parameters."""

    def __init__(self, image):
        self.image = np.asarray(image) / np.sum(image)

    def draw(self, theta, position, shape=None):
        """The profile (1, Ny, Nx), over the frame."""
        return self.image[None]

    def draw_box(self, theta, position, origin, size, *, slopes=True):
        """A part of it."""
        return self.image[None, *box_slices(origin, size)]

    @property
    def peak(self) -> float:
        """Its largest value."""
        return float(self.image.max())

    def bounding_box(self, theta, position, threshold):
        """The box of all pixels above the threshold."""
        lit, ends = np.abs(self.image) > threshold * np.abs(self.image).max(), []
        for axis in (0, 1):
            along = np.flatnonzero(lit.any(axis=1 - axis))
            ends.append((along[0], along[-1]))
        low, high = np.array(ends).T
        return (low + high) / 2, (high - low) / 2 + 1


class StarProfile(ComponentProfile):
    """The model's PSF; theta (2,) [px]: its offset from the listed position, if free.

    sampled: PSFs of the observations on whose pixels the frame lies, see `sampled_psfs`
    """

    min_light = MIN_STAR_LIGHT

    def __init__(self, frame, *, free, sampled=()):
        self.shape, self.psf, self.free, self.sampled = frame.shape, frame.psf, free, sampled
        self.mean = np.zeros(2 if free else 0)
        self.scatter = np.full(len(self.mean), STAR_SCATTER_PX)

    def draw(self, theta, position, shape=None):
        """The PSF and, if free, its two slopes, (3, Ny, Nx); else (1, Ny, Nx)."""
        center = self.center(theta, position)
        return draw_psf(
            self.psf, center, shape or self.shape, slopes=self.free, sampled=self.sampled
        )

    @property
    def peak(self) -> float:
        """The PSF's largest value."""
        return float(self.psf.images[0].max())

    def bounding_box(self, theta, position, threshold):
        """Its image, and the aliased waves around it that are above a multiple of the threshold."""
        half = max(self.psf.images.shape[1:]) * self.psf.spacing / 2
        end = half
        for n in ALIAS_PX if self.sampled else ():
            light = _light_beside(self.psf, self.sampled, n)
            end = np.flatnonzero(light > ALIAS_THRESHOLDS * threshold).max(initial=0)
            if end < n:
                break
        return self.center(theta, position), np.full(2, max(half, end) + 1)

    def center(self, theta, position):
        """Position of the component (2,) [px]."""
        return position + theta if self.free else position


def components_of(source, frame, sampled=()):
    """The components of a Source, at least one; sampled: see StarProfile."""
    if isinstance(source, PointSource):
        return [StarProfile(frame, free=source.free_position, sampled=sampled)]
    if isinstance(source, ExtendedSource) and source.profile is not None:
        return [FixedProfile(source.profile)]
    n = (source.n_components if isinstance(source, ExtendedSource) else None) or 1
    return [GalaxyProfile(frame, i, n) for i in range(n)]
