"""Light around point sources that is wider than the PSF, as that of a galaxy given as a point.

A source's whitened image is u, in channel c with flux f_c; G u is the same blurred by WIDTH_FWHM.
Of its part that no flux of the point explains, g = G u - u <u, G u> / <u, u>, the residual r holds

    a = sum_c f_c <g, r>_c / sum_c f_c^2 <g, g>_c,    error^2 = 1 / sum_c f_c^2 <g, g>_c

as a part of the source's flux, if its colour is the same. Its fluxes miss at least that much. The
residual filtered with the PSF alone does not show it: two of two galaxies of signal to noise 11 and
21, given as points, had half of their flux at chi2 of 1 (bench.ladder, galaxy_as_point). Below the
significance of a misfit, errors of fluxes hold a.
"""

from __future__ import annotations

import numpy as np

from ...sky.sources import PointSource

# [FWHM] sigma of the Gaussian by which a point is blurred.
WIDTH_FWHM = 1.0
# [sigma of it] Margin about a point's image within which the blurred one is compared.
MARGIN = 3.0
# [sigma] from which a point source is flagged as misfitted: noise reaches it in one of 30,000,
# since it is one test of each source.
WIDE_SIGMAS = 4.0
# [sigma] from which errors hold the light that the point misses, of 2 in 100 true stars. With both
# limits none of 120 galaxies of signal to noise 8 to 40 that were given as points is over 5 sigma
# off without a flag (cases of bench.ladder, on seeds that did not choose them).
DOUBTED_SIGMAS = 2.0


def extended_light(result, remainders) -> tuple[np.ndarray, np.ndarray]:
    """Significance (S,) [sigma] of wider light, and its part of the flux (S,) [1].

    0 of all but point sources. remainders: the Remainder of each observation
    """
    found, power = np.zeros((2, len(result.sources)))
    points = [isinstance(source, PointSource) for source in result.sources]
    parts = [(k, c) for k, c in enumerate(result.components) if points[c.source]]
    for i, (left, channels) in enumerate(zip(remainders, result.channel_slices(), strict=True)):
        for k, component in parts:
            light = component.spectrum[channels, None, None]
            product, square = _products(result, i, k, light, left)
            found[component.source] += product
            power[component.source] += square
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nan_to_num(found / np.sqrt(power)), np.nan_to_num(found / power)


def missed_light(result) -> np.ndarray:
    """Fluxes (S, C) [counts] that point sources miss if they are galaxies, else 0."""
    flux = np.zeros((len(result.sources), len(result.channels)))
    for c in result.components:
        flux[c.source] += c.spectrum * c.morphology.sum()
    misfit = result.misfit
    part = np.where(misfit.wide_sigma > DOUBTED_SIGMAS, misfit.wide_part, 0.0)
    return part[:, None] * np.abs(flux)


def _products(result, i_observation, k, light, left):
    """Sums over an observation's channels of f <g, r> and f^2 <g, g>, in the noise that it has."""
    from scipy.ndimage import gaussian_filter  # 0.1 s, which fits without points need not wait for

    observation, rendered = result.observations[i_observation], result.rendered[i_observation]
    width = WIDTH_FWHM * observation.psf.fwhm_px
    window = rendered.window(k, margin=int(np.ceil(MARGIN * width.max())))
    image = rendered.within(k, window)
    wide = [gaussian_filter(a, s, mode="constant") for a, s in zip(image, width, strict=True)]
    scale = 1 / np.sqrt(left.noise)[:, None, None]
    root = scale * np.sqrt(observation.whitened.weights[:, *window]) * left.used[:, *window]
    u, g = (root * light * observation.whiten(a) for a in (image, np.array(wide)))
    power = (u * u).sum(axis=(1, 2))
    shared = np.divide((u * g).sum(axis=(1, 2)), power, out=np.zeros_like(power), where=power > 0)
    g = g - shared[:, None, None] * u
    return (g * scale * left.residual[:, *window]).sum(), (g * g).sum()
