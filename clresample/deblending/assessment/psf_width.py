"""Errors of fluxes by the width of the PSF, of sources whose model does not describe the data."""

from __future__ import annotations

import numpy as np

from ...sky.psf import SIGMAS_A_FWHM
from ..posterior.residuals import MISFIT_SIGMAS


def width_errors(result) -> np.ndarray:
    """Errors (S, C) [counts] of fluxes by an error of the PSF's width, independent by band.

        psf_error w sigma^2 <|grad M|^2> / <M^2> flux,    w = min(1, max(0, m / 5 - 1))

    of a source with the image M, under a PSF of width sigma, that leaves m sigma (`own_sigma`). If
    the width grows by the fraction epsilon, M changes by epsilon sigma^2 laplace M, and the flux of
    an unchanged morphology by the ratio above, 1 for a point and small for large galaxies. Where
    nothing is left, the PSF is as good as the data, and errors have no such part.
    """
    found = np.zeros((len(result.sources), len(result.channels)))
    left = result.misfit.own_sigma().max(axis=1, initial=0.0) / MISFIT_SIGMAS - 1
    weight = result.psf_error * np.clip(left, 0.0, 1.0)
    for i, (o, channels) in enumerate(
        zip(result.observations, result.channel_slices(), strict=True)
    ):
        variance = (o.psf.fwhm_px / SIGMAS_A_FWHM) ** 2
        for k, c in enumerate(result.components):
            if not weight[c.source]:
                continue
            image = result.rendered[i].images[k]
            steep = sum((np.diff(image, axis=axis) ** 2).sum(axis=(1, 2)) for axis in (1, 2))
            power = np.maximum((image**2).sum(axis=(1, 2)), 1e-300)
            flux = np.abs(c.spectrum[channels]) * c.morphology.sum()
            change = np.minimum(variance * steep / power, 1.0)
            found[c.source, channels] += weight[c.source] * change * flux
    return found
