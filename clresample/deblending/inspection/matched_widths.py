"""Names PSFs whose width disagrees with the light of the same sources in a sharper image.

The light of a source in two images, each convolved with the other's PSF, is the same but for a
factor, if both PSFs are right. If the second one's, of width sigma, is too narrow by the part p,

    V = b + a (U - t . grad U + p sigma^2 laplace U),    V = P_A * d_B,    U = P_B * d_A,

whatever the source's shape. Its colour may differ inside it: the size of its own light, from the
same fit of U to a point P_A * P_B, is known in the other band to a part COLOUR only, and a source
with more than MAX_SIZE of it, or of its light in b, tells nothing, as its middle may be a point of
another colour.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import laplace

from ...sky.psf import SIGMAS_A_FWHM
from .disagreement import ImagePlane, Matched
from .psf_samples import psf_at
from .shifted import channels_of_light, sharpest

# [1], [sigma] Smallest part p that is named, and its significance; its smallest error.
MIN_PART, MIN_SIGMAS, FLOOR = 0.05, 5.0, 0.01
COLOUR, MAX_SIZE = 0.3, 0.15
# [sigma] Least light of a source whose width is compared, in either image.
MIN_LIGHT = 100.0
# Sources, the brightest, and channels, those of most light, that are compared.
MAX_SOURCES, MAX_CHANNELS = 3, 3
# [FWHM of the wider PSF] Radius of the pixels compared, and distance of other sources, at least.
RADIUS_FWHM, ALONE_FWHM = 1.5, 3.0
MIN_PIXELS = 20  # number of those pixels


def width_lines(images) -> list[str]:
    """A message about each observation whose light has another width than a sharper one allows."""
    lines, first = [], sharpest(images)
    one, name = images[first], images[first].observation.label
    for i, other in enumerate(images):
        chosen, wrong = _bright_alone(one, other) if i != first else [], {}
        if not len(chosen):
            continue
        c_one = channels_of_light(one)[0]
        for c in channels_of_light(other)[:MAX_CHANNELS]:
            part, error = _mean(*_excess(one, c_one, other, c, chosen))
            if abs(part) > max(MIN_PART, MIN_SIGMAS * error):
                wrong[other.observation.channels[c]] = part
        for how, which, its, sign in (
            ("wider", "narrow", "wide", 1),
            ("narrower", "wide", "narrow", -1),
        ):
            some = {c: 100 * abs(part) for c, part in wrong.items() if sign * part > 0}
            if some:
                shares = ", ".join(f"{c} by {part:.0f} %" for c, part in some.items())
                lines.append(
                    f"{other.observation.label}: light is {how} than its PSF makes that of {name}: "
                    f"in {shares} of the PSF's width; the PSF is too {which}, or that of {name} "
                    f"too {its}: check both, and the sizes of their samples (spacing)"
                )
    return lines


def _mean(parts, errors):
    """Mean of parts (n,) with errors (n,), and its error."""
    known = np.isfinite(errors)
    if not known.any():
        return 0.0, np.inf
    weights = errors[known] ** -2
    mean, error = weights @ parts[known] / weights.sum(), weights.sum() ** -0.5
    return float(mean), max(float(error), float(np.std(parts[known])), FLOOR)


def _bright_alone(one, other):
    """Sources (n,) that are bright in both images and have no neighbour near in the second."""
    both = one.inside & other.inside & (np.minimum(one.light, other.light) > MIN_LIGHT)
    chosen = other.brightest[both[other.brightest]]
    places = other.places[np.isfinite(other.places).all(axis=1)]
    away = np.hypot(*(places - other.places[chosen][:, None]).transpose(2, 0, 1))
    crowded = (away < ALONE_FWHM * other.width_px).sum(axis=1) > 1
    return chosen[~crowded][:MAX_SOURCES]


def _excess(one, c_one, other, c_other, chosen):
    """Parts p (n,) of sources `chosen` (n,) and their errors, infinite where unknown."""
    planes = ImagePlane.of(one, c_one), ImagePlane.of(other, c_other)
    pair = Matched.of(*planes, one.model_places(chosen), RADIUS_FWHM)
    parts, errors = np.zeros(len(chosen)), np.full(len(chosen), np.inf)
    if np.count_nonzero(pair.good) < MIN_PIXELS:
        return parts, errors
    variance = (planes[1].psf.fwhm_px[0] / SIGMAS_A_FWHM) ** 2
    light, there, good = pair.light(planes[0].data), pair.there(), pair.good[pair.window]
    y, x = np.indices(pair.good.shape)[:, *pair.window]
    for k, (place, near) in enumerate(zip(one.places[chosen], pair.near, strict=True)):
        disc = good & (np.hypot(y - near[0], x - near[1]) <= pair.radius)
        if np.count_nonzero(disc) < MIN_PIXELS:
            continue
        factor, parts[k], error, _ = _fitted(light, there, disc, variance)
        if abs(parts[k]) < MIN_PART / 2:  # whatever its error, it names nothing
            errors[k] = FLOOR
        elif factor > 0:
            away = (np.arange(n) - p for n, p in zip(planes[0].data.shape, place, strict=True))
            point = pair.light(psf_at(planes[0].psf, 0, *away))
            _, size, size_error, beyond = _fitted(point, light, disc, variance)
            if max(abs(size), beyond) < MAX_SIZE:
                errors[k] = np.hypot(error, COLOUR * np.hypot(size, size_error))
    return parts, errors


def _fitted(light, there, disc, variance):
    """Factor a and part p of `there` against `light` over a disc, and p's error by what is left.

    The last is the part of `there` in the level b, which light much wider than the disc has.

    variance [px^2]: of the wider PSF, over whose area the residuals are alike
    """
    columns = [light, *np.gradient(light), variance * laplace(light, mode="nearest")]
    design = np.stack([np.ones(np.count_nonzero(disc)), *(column[disc] for column in columns)])
    estimator = np.linalg.pinv(design.T)
    found = estimator @ there[disc]
    if not found[1]:
        return 0.0, 0.0, np.inf, 0.0
    rest = there[disc] - found @ design
    alike = max(1.0, np.pi / 4 * SIGMAS_A_FWHM**2 * variance)
    scatter = alike * (rest @ rest) / max(len(rest) - len(found), 1)
    error = np.sqrt(scatter * (estimator[4] ** 2).sum()) / abs(found[1])
    level = abs(found[0]) * len(rest) / max(there[disc].sum(), 1e-30)
    return float(found[1]), float(found[4] / found[1]), float(error), float(level)
