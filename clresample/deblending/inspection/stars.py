"""Width of the sources in an observation against its PSF: wrong PSFs, and stars."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...sky.sources import PointSource
from .psf_samples import inscribed_radius, psf_at
from .star_psfs import listed_psf

# [sigma] Light of a source, in one channel, whose width is then known to a few percent.
STAR_SIGMAS = 50.0
# Smallest relative width error of a PSF that is reported: 5 % changes fluxes by 2.5 sigma beside
# sources of signal to noise 100 (real HSC images), and is the accuracy of measured PSFs.
WIDTH_PART = 0.05
# [sigma] significance of that
WIDTH_SIGMAS = 5.0
# [FWHM] Half-width of the pixels compared; nearer neighbours widen a star.
REACH_FWHM, NEIGHBOUR_FWHM = 1.5, 4.0
# [1] Smallest part of them that is usable; all are within a FWHM of the star.
MIN_USABLE = 0.75
# Stars measured in an image at most.
MAX_STARS = 3
# [1], [px] Steps of the slopes by width and by position: small against the PSF's core.
WIDTH_STEP, SHIFT_STEP = 0.05, 0.1
# [sigma] Light of a source, in one channel, that is a star if it looks like its PSF: a galaxy as
# bright is far wider. Under a PSF of 1.6 or 2 px no galaxy profile is as sharp as a star on pixels
# of the model, and stars of signal to noise 1200, photon noise included, ended as misfits.
POINT_SIGMAS = 100.0
# [its error], [Settings.psf_error] Largest excess of its width, whichever is more: it is more often
# a compact galaxy's than the PSF's error. With 5 and 1 in sum 23 of 64 galaxies of r_e .08 to .16"
# under a PSF of .7", signal to noise 60 to 800, were flagged as misfits.
MAX_WIDE_SIGMAS, MAX_WIDE_PART = 2.0, 0.5
# [its error] Largest level about such a star: more is of a host or a neighbour. [scatter of chi2]
# What noise may leave.
MAX_LEVEL_SIGMAS, NOISE_SIGMAS = 5.0, 3.0
# [FWHM] Radius up to which, and sigma of the Gaussian with which, light of a host is looked for;
# [sigma] its smallest significance. A nucleus of signal to noise 300 in a host of 0.3 of its light,
# 8 FWHM wide, had 0.80 of all light, 6 errors, as a star.
HOST_FWHM, HOST_SIGMA_FWHM, HOST_SIGMAS = 8.0, 3.0, 4.0
# Rounds in which the PSF is moved to the light, and [px] its largest move in one: a star 1 px from
# its place under a PSF of 2.3 px FWHM was named 15 % wider than it.
MAX_ROUNDS, MAX_MOVE_PX = 6, 0.7


class Width(NamedTuple):
    """A source's light in one channel, as a moved PSF of another width on a level.

    part [1]: relative excess of the light's width over the PSF's, negative if it is narrower;
        error: of it, infinite where it cannot be measured
    sigmas: of the light; level: over its error
    place (2,) [px]: of the PSF
    rest [1]: norm of the remaining light, beyond what noise leaves, over that of all
    """

    channel: int
    part: float = 0.0
    error: float = np.inf
    sigmas: float = 0.0
    level: float = 0.0
    rest: float = 0.0
    place: tuple[float, ...] = ()


def point_sources(images, listed, psf_error):
    """Selects those of the sources `listed` (S,) bool that look like the PSF: stars.

    By the sharpest of InspectedImages that shows POINT_SIGMAS of their light, or less and that they
    are wider. psf_error [1]: of the PSF's width, see Settings; light may be narrower by as much,
    and wider by MAX_WIDE_PART of it
    """
    found, left = np.zeros_like(listed), listed.copy()
    for image in sorted(images, key=lambda one: one.width_arcsec):
        for i in np.flatnonzero(left & image.inside & (image.light > STAR_SIGMAS)):
            w = _width(image, i)
            is_wide = w.part - WIDTH_SIGMAS * w.error > psf_error
            if w.sigmas < POINT_SIGMAS and not is_wide:
                continue
            unlike = max(-w.part - WIDTH_SIGMAS * w.error, w.rest)
            found[i] = unlike <= psf_error and abs(w.level) <= MAX_LEVEL_SIGMAS
            found[i] &= w.part <= max(MAX_WIDE_SIGMAS * w.error, MAX_WIDE_PART * psf_error)
            found[i] &= _host_light(image, i, w, psf_error) < HOST_SIGMAS
            left[i] = False
    return found


def _host_light(image, i, width, psf_error):
    """Light [sigma] about source i beyond a point's, away from other sources; width: its Width.

    Without what the PSF's error may leave of the point's.
    """
    c, (y0, x0) = width.channel, width.place
    psf = listed_psf(image.observation, image.listed[i])
    reach = min(HOST_FWHM * image.width_px, inscribed_radius(psf, c))
    (y,), (x,), (on,) = image.patches(np.array([i]), int(np.ceil(reach)))
    away = np.hypot(y - y0, x - x0)
    others = _others(image, i)
    good = on & image.usable[c, y, x] & (away < reach)
    for place in others[np.hypot(*(others - image.places[i]).T) < 2 * reach]:
        good &= np.hypot(y - place[0], x - place[1]) > NEIGHBOUR_FWHM * image.width_px
    beyond = good & (away > REACH_FWHM * image.width_px)
    weight = image.observation.weights[c, y, x] * image.sigma[c] ** 2
    point = psf_at(psf, c, y[:, 0] - y0, x[0] - x0)
    core = weight * point * (good & ~beyond)
    light = image.brightness[c, y, x]
    point *= (core * light).sum() / max((core * point).sum(), 1e-30)
    host = weight * np.exp(-0.5 * (away / (HOST_SIGMA_FWHM * image.width_px)) ** 2) * beyond
    left = (host * (light - point)).sum() - psf_error * (host * np.abs(point)).sum()
    return left / np.sqrt(max((host**2 / np.where(weight > 0, weight, 1)).sum(), 1e-30))


def misfitting_widths(image, sources):
    """Sources whose width disagrees with an image's PSF: [(source, channel, part, error)].

    part [1]: relative excess of the light's width over the PSF's, negative if it is narrower.
        PointSources without neighbours within 4 FWHM are reported in both cases. Other sources are
        reported only if narrower, which no source convolved with this PSF can be.
    """
    found = []
    stars = np.array([isinstance(source, PointSource) for source in sources], bool)
    bright = image.brightest[image.light[image.brightest] > STAR_SIGMAS]
    # of the other sources the brightest suffices
    for i in [*bright[stars[bright]][:MAX_STARS], *bright[~stars[bright]][:1]]:
        star = stars[i]
        if star and not _alone(image, i):
            continue
        c, part, error, *_ = _width(image, i)
        if abs(part) < max(WIDTH_PART, WIDTH_SIGMAS * error) or (part > 0 and not star):
            continue
        found.append((int(i), c, part, error))
    return found


def _alone(image, i):
    """Returns True if no other source lies near to source i."""
    away = np.hypot(*(_others(image, i) - image.places[i]).T)
    return not (away < NEIGHBOUR_FWHM * image.width_px).any()


def _others(image, i):
    """Places (n, 2) [px] of the sources but source i."""
    others = np.delete(image.places, i, axis=0)
    return others[np.isfinite(others).all(axis=1)]


def _width(image, i):
    """The Width of source i in its channel of most light.

        d = b + a P(x - p) - a t . grad P + a part dP/dpart,   P wider by part: P(x / (1 + part))

    by least squares with the weights of the pixels.
    """
    reach = int(np.ceil(REACH_FWHM * image.width_px)) + 1
    y, x, on = image.patches(np.array([i]), reach)
    y, x, on = y[0], x[0], on[0]
    light = image.significance[:, y, x]
    c = int(light.sum(axis=(1, 2)).argmax())
    good = on & image.usable[c, y, x]
    place = image.places[i]
    core = np.hypot(y - place[0], x - place[1]) <= image.width_px
    if not good[core].all() or good.mean() < MIN_USABLE:
        return Width(c)
    psf = listed_psf(image.observation, image.listed[i])
    root = np.where(good, np.sqrt(image.observation.weights[c, y, x]), 0).ravel() * image.sigma[c]
    z = np.where(good, light[c], 0).ravel().astype(float)
    for _ in range(MAX_ROUNDS):
        away = y[:, 0] - place[0], x[0] - place[1]
        design = _columns(psf, c, *away) * root
        inverse = np.linalg.pinv(design @ design.T)
        found = inverse @ (design @ z)
        sigmas = found[1] * np.sqrt((design[1] ** 2).sum())
        if not sigmas > STAR_SIGMAS:
            break
        shift = -found[2:4] / found[1]
        if np.abs(shift).max() < SHIFT_STEP:
            rest, n_free = z - found @ design, good.sum() - len(found)
            spread = max(1.0, float(rest @ rest) / n_free)
            error = np.sqrt(np.diagonal(inverse) * spread)
            more = (spread - 1) * n_free - NOISE_SIGMAS * np.sqrt(2 * n_free)
            return Width(
                channel=c,
                part=found[4] / found[1],
                error=error[4] / found[1],
                sigmas=sigmas,
                level=found[0] / error[0],
                rest=np.sqrt(max(more, 0.0)) / sigmas,
                place=tuple((place + shift).tolist()),
            )
        place = place + np.clip(shift, -MAX_MOVE_PX, MAX_MOVE_PX)
    return Width(c)


def _columns(psf, c, dy, dx):
    """Level, PSF, slopes along y and x, and slope by width (5, n m) at dy (n,), dx (m,) [px].

    All but the level in units of the PSF's brightest pixel.
    """
    e, s, n = WIDTH_STEP, SHIFT_STEP, len(dy)
    steps_y = [dy, dy + s, dy - s, dy, dy, dy / (1 + e), dy / (1 - e)]
    steps_x = [dx, dx, dx, dx + s, dx - s, dx / (1 + e), dx / (1 - e)]
    values = psf_at(psf, c, np.concatenate(steps_y), np.concatenate(steps_x)).reshape(7, n, 7, n)
    here, up, down, right, left, wide, narrow = (values[k, :, k] for k in range(7))
    slope = (wide / (1 + e) ** 2 - narrow / (1 - e) ** 2) / (2 * e)
    columns = (here, (up - down) / (2 * s), (right - left) / (2 * s), slope)
    level = np.ones(here.size)
    return np.stack([level, *(column.ravel() / here.max() for column in columns)])
