"""Weights of observations lowered by the error of the PSF in the light of bright stars.

    1/w = sigma^2 + psf_error^2 sum_s [ L_s^2 + (r . grad L_s)^2 ],      L_s = A_s R S_s

r is the distance from star s: L changes by -(2 L + r . grad L) epsilon if the PSF's width grows by
the fraction epsilon, so that its wings are more uncertain than its core.
"""

from __future__ import annotations

import numpy as np

from ...resampling.plan import Precision
from ..linear.component_batch import StartComponent
from ..linear.linearised_scenes import linearise
from ..profiles import StarProfile
from ..view import WhitenedView, pixel_noise

# [sigma] Stars whose PSF error is below this everywhere do not change the weights.
MIN_PSF_ERROR_SIGMA = 0.05


def allow_for_psf_error(frame, views, stars, psf_error) -> list[WhitenedView]:
    """Views whose weights hold the error of the PSF in the light of bright stars.

    stars: tuples of a StarProfile, the number of its source, its position (2,) [model px] and its
        spectrum (C,) [unit]
    """
    ends = np.cumsum([len(view.data) for view in views])[:-1]
    root = [view.sqrt_weights.max(axis=(1, 2)) for view in views]
    # no pixel has more than all of its light
    most = [psf_error * np.abs(one[3] * np.concatenate(root)).max() for one in stars]
    stars = [one for one, top in zip(stars, most, strict=True) if top >= MIN_PSF_ERROR_SIGMA]
    if not stars:
        return views
    shapes, out = [StarProfile(frame, free=True, sampled=one[0].sampled) for one in stars], []
    components = [
        StartComponent(0, k, source, shape, place, frame.shape)
        for k, (shape, (_, source, place, _)) in enumerate(zip(shapes, stars, strict=True))
    ]
    spectra, noise = np.array([one[3] for one in stars]), pixel_noise(views)
    precision = Precision.of(views[0].op.dtype)
    looking = linearise([views], components, precision, 0.0, fit_sky=False)
    brightness = shapes[0].peak * (spectra / noise).max(axis=1)
    thetas = [shape.mean for shape in shapes]
    looking.render(np.arange(1), thetas, brightness, slopes=True, whiten=False)
    parts = np.split(spectra, ends, axis=1)
    for view, sight, part in zip(views, looking.sights, parts, strict=True):
        square = np.zeros(view.data.shape)
        for k, (window, (light, *slopes)) in zip(looking.at, sight.lit_images(), strict=True):
            at = view.mapping.at(*np.mgrid[window]) + view.op.shift
            away = np.moveaxis(at - stars[k][2], -1, 0)
            # slopes are by the position: minus the gradient
            change = sum(r * slope for r, slope in zip(away, slopes, strict=True))
            found = part[k, :, None, None] ** 2 * (light**2 + change**2)
            largest = np.sqrt(found) * view.sqrt_weights[:, *window]
            if psf_error * largest.max(initial=0) > MIN_PSF_ERROR_SIGMA:
                square[:, *window] += found
        error = psf_error * np.sqrt(square)
        out.append(view.with_model_error(error) if error.any() else view)
    return out
