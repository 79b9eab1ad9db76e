"""Names exposures whose counts differ from those of the others of their band.

The light of two exposures, each convolved with the other's PSF, is the same but for a factor,

    V = b + a U - a t . grad U,    V = P_A * d_B,    U = P_B * d_A,

which least squares give for all sources together, whatever their shapes and neighbours.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from .disagreement import Blur, ImagePlane, Matched
from .shifted import sharpest

# [1], [sigma] Smallest difference that is named, and its significance; smallest error of a factor,
# because of errors of PSFs: one that is 25 % too narrow changes it by 4 to 8 %.
MIN_PART, MIN_SIGMAS, FLOOR = 0.05, 5.0, 0.01
# [FWHM of the wider PSF] Radius of the pixels about a source that are compared.
RADIUS_FWHM = 2.0
MIN_PIXELS = 50  # number of them
MAX_SOURCES = 3  # the brightest


def count_lines(images) -> list[str]:
    """A message about each channel with other counts than most of its band, after zero points."""
    bands: dict[str, list] = {}
    for image in images:
        for c, band in enumerate(image.observation.bands):
            bands.setdefault(band, []).append((image, c))
    lines = []
    for band, exposures in bands.items():
        if len(exposures) < 2:
            continue
        first = sharpest([image for image, _ in exposures])
        pairs = [_factor(*exposures[first], *exposure) for exposure in exposures]
        logs, errors = np.array(pairs).T
        logs[first], errors[first] = 0.0, 0.0
        known = np.isfinite(errors)
        # of two the sharper one is right
        middle = np.median(logs[known]) if known.sum() > 2 else 0.0
        others = known & (np.arange(len(errors)) != first)
        if not others.any():
            continue
        errors[first] = np.median(errors[others])
        apart = np.expm1(logs - middle)
        least = np.maximum(MIN_PART, MIN_SIGMAS * np.hypot(errors, FLOOR))
        for i in np.flatnonzero(known & (np.abs(apart) > least)):
            image, c = exposures[i]
            lines.append(
                f"{image.observation.label}: counts in channel {image.observation.channels[c]} "
                f"differ from those of its band: {1 + apart[i]:.3g} +- {errors[i]:.1g} times as "
                f"many as in other exposures of {band}; its zero point, its gain or its PSF is "
                "wrong, or a source varies; correct it, or give it a band of its own"
            )
    return lines


def _factor(one, c_one, other, c_other):
    """Log of the ratio of fluxes in a channel of image `other` to those in `one`, and its error."""
    chosen = one.brightest[other.inside[one.brightest]][:MAX_SOURCES]
    if one is other or not len(chosen):
        return 0.0, np.inf
    planes = ImagePlane.of(one, c_one), ImagePlane.of(other, c_other)
    pair = Matched.of(*planes, one.model_places(chosen), RADIUS_FWHM)
    if np.count_nonzero(pair.good) < MIN_PIXELS:
        return 0.0, np.inf
    good, light, there = pair.good[pair.window], pair.light(planes[0].data), pair.there()
    slopes = [slope[good] for slope in np.gradient(light)]
    design = np.stack([np.ones(np.count_nonzero(good)), light[good], *slopes])
    estimator = np.linalg.pinv(design.T)
    factor = float(estimator[1] @ there[good])
    # noise is correlated by the convolutions
    weight = np.zeros(pair.good.shape)
    weight[pair.good] = estimator[1]
    own = Blur(planes[1], planes[1].psf, np.eye(2))
    behind = map_coordinates(one.variance[c_one], pair.at, order=1, mode="nearest")
    variance = (pair.smear_there.of(weight) ** 2 * other.variance[c_other]).sum()
    variance += factor**2 * pair.area * (own.of(weight) ** 2 * behind).sum()
    if not factor > MIN_SIGMAS * np.sqrt(variance):
        return 0.0, np.inf
    units = [
        image.sigma[c] * (1.0 if (scale := image.observation.flux_scale) is None else scale[c])
        for image, c in ((one, c_one), (other, c_other))
    ]
    return float(np.log(factor * units[1] / units[0])), float(np.sqrt(variance) / factor)
