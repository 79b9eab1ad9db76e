"""Other methods of photometry for blended sources, on the same images at the same positions.

aperture   all bands brought to the broadest band's PSF by our operator, then sums in circles (sep)
forced     profiles from the sharpest band, their fluxes in each band by least squares with that
           band's PSF, all sources of a cutout at once (as TFIT, T-PHOT and tractor's forced mode)

Both are given what only a simulation knows, in their favour: the apertures' radius is the one of
RADII_ARCSEC with the least scatter, and each band's fluxes are scaled so that sources without a
neighbour have the truth in their median.
"""

from __future__ import annotations

import warnings

import numpy as np

from clresample import PSF, Resampler
from clresample.fields.psfs.sampled import ScatteredPSF

RADII_ARCSEC = (0.3, 0.4, 0.6, 0.8, 1.0, 1.5)
HALF_PX = 48  # [px of the sharpest mosaic] half side of the cutout about a source
PROFILE_PX = 24  # reach of a source's profile
MIN_WIDTH_PX = 0.3  # half-light radius below which a source is a point


class Cutout:
    """Data of all mosaics about a place.

    grids, psfs, data: of each mosaic, data (C, ny, nx) with zeros in bad pixels, weights alike
    """

    def __init__(self, mosaics, place):
        sharp = mosaics[0]
        low = np.maximum(np.rint(place).astype(int) - HALF_PX, 0)
        high = np.minimum(np.rint(place).astype(int) + HALF_PX + 1, sharp.grid.shape)
        self.low = low
        self.grids, self.psfs, self.data, self.weights = [], [], [], []
        first = sharp.grid.cutout(*low, tuple(high - low))
        for mosaic in mosaics:
            if mosaic is sharp:
                a, b = low, high
            else:
                edges = [(y, x) for y in (0.0, high[0] - low[0]) for x in (0.0, high[1] - low[1])]
                there = first.positions_in(mosaic.grid, *np.array(edges).T)
                a = np.maximum(np.floor(there.min(axis=0)).astype(int) - 2, 0)
                b = np.minimum(np.ceil(there.max(axis=0)).astype(int) + 3, mosaic.grid.shape)
            box = (slice(a[0], b[0]), slice(a[1], b[1]))
            good = ~mosaic.bad_pixels[box]
            cube = ScatteredPSF(mosaic.psf_images, mosaic.psf_positions)
            self.grids.append(mosaic.grid.cutout(*a, tuple(b - a)))
            self.psfs.append(cube.psf_at(*((a + b - 1) / 2)))
            self.data.append(np.where(good, mosaic.data[(slice(None), *box)], 0.0))
            self.weights.append(np.where(good, mosaic.noise_sigma[:, None, None] ** -2.0, 0.0))


def aperture_fluxes(cutout, place):
    """Sums (n_radii, C) [counts] in circles about a place (2,) [px of the first mosaic].

    All bands are matched to the broadest PSF, which must be the last mosaic's.
    """
    import sep

    target, psfs = cutout.grids[-1], cutout.psfs[-1]
    broadest = _broadest(psfs)
    goal = PSF(psfs.images[broadest : broadest + 1], spacing=psfs.spacing)
    y, x = cutout.grids[0].positions_in(target, *(np.asarray(place) - cutout.low))
    found = []
    for grid, psf, data in zip(cutout.grids, cutout.psfs, cutout.data, strict=True):
        for c, image in enumerate(data):
            own = PSF(psf.images[min(c, len(psf.images) - 1)][None], spacing=psf.spacing)
            if grid is target and c == broadest:
                matched = image
            else:
                op = Resampler(grid, own, target, goal, dtype=np.float32)
                matched = op(image[None].astype(np.float32))[0]
            radii = np.array(RADII_ARCSEC) / target.pixel_scale_arcsec
            image = np.ascontiguousarray(matched, dtype=np.float64)
            found.append([sep.sum_circle(image, [x], [y], r, subpix=5)[0][0] for r in radii])
    return np.array(found).T


def _broadest(psf):
    """The band whose PSF is the broadest: of least summed square."""
    images = psf.images / psf.images.sum(axis=(1, 2), keepdims=True)
    return int(np.argmin((images**2).sum(axis=(1, 2))))


def profiles(cutout, places):
    """Images (S, ny, nx) of unit sum at places (S, 2), under the PSF of the sharpest band.

    Each is an elliptical exponential with the moments of the source's own pixels in that band.
    """
    image, weight = cutout.data[0][0], cutout.weights[0][0]
    sigma = 1 / np.sqrt(weight.max())
    local = np.asarray(places) - cutout.low
    rows, columns = np.indices(image.shape)
    apart = np.hypot(rows - local[:, 0, None, None], columns - local[:, 1, None, None])
    owner = apart.argmin(axis=0)
    psf = cutout.psfs[0]
    widths = _moments(psf.images[0], None, 3.0)
    found = []
    for s, (y, x) in enumerate(local):
        own = np.where((owner == s) & (apart[s] < PROFILE_PX), image, 0.0)
        moments = _moments(own, (y, x), 4.0, sigma)
        found.append(_exponential(image.shape, (y, x), moments - widths, psf))
    return np.array(found)


def _moments(image, centre, sigma_px, noise=0.0):
    """Second moments (2, 2) [px^2] under a Gaussian weight of sigma_px, corrected for it."""
    rows, columns = np.indices(image.shape)
    y, x = centre if centre is not None else (np.array(image.shape) - 1) / 2
    dy, dx = rows - y, columns - x
    weight = np.exp(-0.5 * (dy**2 + dx**2) / sigma_px**2) * np.maximum(image, 0)
    weight[image < 2 * noise] = 0
    total = weight.sum()
    if total <= 0:
        return np.zeros((2, 2))
    m = np.array([[(weight * a * b).sum() for b in (dy, dx)] for a in (dy, dx)]) / total
    inverse = np.linalg.pinv(m) - np.eye(2) / sigma_px**2
    values, vectors = np.linalg.eigh(inverse)
    return vectors @ np.diag(1 / np.maximum(values, 1 / (3 * sigma_px) ** 2)) @ vectors.T


def _exponential(shape, centre, moments, psf):
    """An exponential disk of these moments (before the PSF) convolved with the PSF, of unit sum."""
    from scipy.signal import fftconvolve

    rows, columns = np.indices(shape)
    over = 5  # the disk's peak is sharp: sampled five times a pixel, and binned
    fine = (np.arange(over) - (over - 1) / 2) / over
    values, vectors = np.linalg.eigh(moments)
    # <x^2> of an exponential of scale h is 3 h^2 along each axis
    scale = np.sqrt(np.maximum(values, MIN_WIDTH_PX**2) / 3)
    total = np.zeros(shape)
    for a in fine:
        for b in fine:
            along = np.stack([rows + a - centre[0], columns + b - centre[1]], axis=-1) @ vectors
            total += np.exp(-np.hypot(*(along / scale).transpose(2, 0, 1)))
    seen = fftconvolve(total / total.sum(), psf.images[0], mode="same")
    return seen / seen.sum()


def forced_fluxes(cutout, places):
    """Fluxes (S, C) [counts] of all sources at places (S, 2), profiles of the sharpest band."""
    shapes = profiles(cutout, places).astype(np.float32)
    sharp = PSF(cutout.psfs[0].images[:1], spacing=cutout.psfs[0].spacing)
    found = []
    for i, (grid, psf) in enumerate(zip(cutout.grids, cutout.psfs, strict=True)):
        if i:
            seen = Resampler(cutout.grids[0], sharp, grid, psf, dtype=np.float32).render(shapes)
        else:
            seen = shapes[:, None]
        for c, (image, weight) in enumerate(zip(cutout.data[i], cutout.weights[i], strict=True)):
            root = np.sqrt(weight).ravel()
            design = seen[:, c].reshape(len(shapes), -1) * root
            found.append(np.linalg.lstsq(design.T, image.ravel() * root, rcond=None)[0])
    return np.array(found).T


def compared(mosaics, places, judged, truth):
    """Fluxes over truth of judged sources by both methods.

    mosaics: of a SimulatedField, the sharpest first, the broadest last; places (R, 2) [px]: of all
        rows of the catalogue; judged: rows of those that are judged; truth (J, C) [uJy]
    returns {"aperture": (n_radii, J, C), "forced": (J, C)}
    """
    zero = np.concatenate([m.survey.zero_points_mag for m in mosaics])
    unit = 10 ** (-0.4 * (zero - 23.9))  # [uJy] of one count
    apertures, forced = [], []
    for row, true in zip(judged, truth, strict=True):
        cutout = Cutout(mosaics, places[row])
        inside = ((places >= cutout.low) & (places < cutout.low + 2 * HALF_PX)).all(axis=1)
        others = np.flatnonzero(inside)
        apertures.append(aperture_fluxes(cutout, places[row]) * unit / true)
        fluxes = forced_fluxes(cutout, places[others])[np.flatnonzero(others == row)[0]]
        forced.append(fluxes * unit / true)
    n_channels = len(unit)
    return {
        "aperture": np.array(apertures).reshape(-1, len(RADII_ARCSEC), n_channels).swapaxes(0, 1),
        "forced": np.array(forced).reshape(-1, n_channels),
    }


def point_errors(mosaics):
    """Error (C,) [uJy] of a point source's flux in each channel of a SimulatedField's mosaics."""
    found = []
    for m in mosaics:
        middle = m.psf_images[len(m.psf_images) // 2]
        counts = m.noise_sigma / np.sqrt((middle**2).sum(axis=(1, 2)))
        found.append(counts * 10 ** (-0.4 * (np.array(m.survey.zero_points_mag) - 23.9)))
    return np.concatenate(found)


def least_scatter(ratios, alone, scatter):
    """Scatter of flux over truth (J, C), the least of several radii's (n, J, C).

    Each channel is scaled first so that sources without a neighbour, `alone` (K, C) or (n, K, C),
    have the truth in their median.
    """
    stacks, singles = (r if r.ndim == 3 else r[None] for r in (ratios, alone))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a channel without any is NaN
        scales = [np.nanmedian(r, axis=0) for r in singles]
    return min(scatter(r / by - 1) for r, by in zip(stacks, scales, strict=True))
