"""Tests the residuals of a fit for sources whose core differs in colour from the rest.

A fitted source A S may be A S + B b S instead, b its smooth profile with maximum 1: B (C,) is the
change of its spectrum at the core. B and the spectra of all sources and the sky are eliminated from
what the fit has left in each channel, which gives beta_c with precision n_c; then

    beta_c ~ N(lambda A_c, 1/n_c + (CORE_COLOUR_SCATTER A_c)^2)       lambda of any size: S follows
    it

is compared with the same distribution without CORE_COLOUR_SCATTER. The ratio of both evidences, the
likelihoods integrated over lambda, increases with the significance of a gradient, and decreases
with the number of sensitive channels without one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.sources import is_open
from ..component_images import ComponentImages, local_chi2
from ..linear.rendered_models import model_of, render_models

# Relative scatter of the core's spectrum about that of the whole source: 0.3 mag, as between bulges
# and discs. With half or twice that, evidences differ by a few; gradients over 3 % are detected in
# bright galaxies in any case.
CORE_COLOUR_SCATTER = 0.3
# ln of the ratio of evidences from which a second fit is tried: odds of 7 to 1, times the number of
# tested sources, since any of these has all fitted again. Of 254 simulated galaxies of one colour
# each, 3 to 5 reach it, because negative light in COSMOS images, which no model can fit, mimics a
# gradient in instruments of different resolution. With odds of 150 to 1 colours of red bulges in
# blue disks are 2.3 errors off in the mean at signal to noise 200 (r_e = 0.5", Euclid and Rubin).
MIN_LOG_EVIDENCE = 2.0
# Signal to noise from which a source is tested: below it no gradient can be significant.
MIN_SNR = 30.0
# Fraction of a channel's precision without neighbours below which a source is not separable from
# them.
MIN_OWN = 1e-6


@dataclass(frozen=True, eq=False)
class GradientTest:
    """Result of the test of a finished Fit for second components.

    components (k,): the components; evidence (k,): ln of the ratio of evidences for a gradient
    power (k, C): sum u^2 of their cores' whitened images u
    """

    components: np.ndarray
    evidence: np.ndarray
    power: np.ndarray

    @property
    def significant(self):
        """The components that significantly need a second one."""
        least = MIN_LOG_EVIDENCE + np.log(max(len(self.components), 1))
        return self.components[self.evidence > least]


def run_gradient_tests(fits):
    """GradientTests (n) of Fits of one signature; None for fits without candidates."""
    which = [_candidates(fit) for fit in fits]
    going = [i for i, own in enumerate(which) if len(own)]
    out: list[GradientTest | None] = [None] * len(fits)
    if going:
        models = [model_of(fits[i], which[i]) for i in going]
        found = render_models(models, fit_sky=fits[0].settings.fit_sky)
        for i, seen in zip(going, found, strict=True):
            out[i] = _asked(fits[i], which[i], seen)
    return out


def _candidates(fit):
    """Components (k,) of a finished Fit that are bright enough for the test."""
    if fit.strength_estimates is None or not np.isfinite(fit.losses[-1:]).all():
        return np.zeros(0, int)
    source = fit.fitted[fit.start.source]
    single = np.bincount(fit.start.source)[fit.start.source] == 1
    free = [is_open(fit.blend.sources[i]) for i in source] & single
    snr = np.sqrt((fit.state.spectra**2 * fit.scene.spectrum_curvature).sum(1))
    seen = (fit.state.spectra > 0) & (fit.scene.spectrum_curvature > 0)
    seen_in = (seen if fit.ties is None else fit.ties.total(seen) > 0).sum(1)
    return np.flatnonzero(free & (snr > MIN_SNR) & (seen_in > 1))


def _asked(fit, which, seen):
    """Tests the rendered images of `model_of` for second components."""
    spectra, sky, n = fit.state.spectra, fit.state.sky, len(fit.state.morph)
    slope, power = seen.slope, seen.power
    bare, residuals, channels = [], [], fit.scene.channels()
    for view, rendered, part in zip(fit.views, seen.observed, channels, strict=True):
        bare.append(
            ComponentImages((n, *rendered.shape[1:]), rendered.low[:n], rendered.images[:n])
        )
        residuals.append(view.data - bare[-1].total(spectra[:, part]) - sky[part, None, None])
    chi2 = local_chi2(bare, fit.views, channels, spectra, residuals)[which]
    covariance, cores = seen.covariance, power[n:]
    if fit.ties is not None:
        slope, power = fit.ties.total(slope), fit.ties.total(power)
        covariance, spectra = covariance[fit.ties.first], spectra[:, fit.ties.first]
    core, precision = _eliminated(covariance, slope, power, len(which))
    precision /= np.maximum(chi2, 1)[:, None]
    error = 1 / np.sqrt(np.maximum(power[which], 1e-30))
    rows = zip(core, precision, np.maximum(spectra[which], error), strict=True)
    return GradientTest(which, np.array([log_evidence_ratio(*row) for row in rows]), cores)


def _eliminated(covariance, slope, power, k):
    """Coefficients (k, C) of the last k images in the residuals of a fit, all others free too.

    Also returns their precisions (k, C); 0 for images without light, or not separable from others.

    covariance (C, n, n): of all n coefficients; slope, power (n, C): their images' products with
    the residuals, and with themselves
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2).T[-k:]
    known = np.where(np.isfinite(covariance), covariance, 0)
    values = np.einsum("cij,jc->ic", known, slope)[-k:]
    precision = np.where(np.isfinite(variance), 1 / np.maximum(variance, 1e-300), 0)
    apart = precision > MIN_OWN * power[-k:]
    return np.where(apart, values, 0), np.where(apart, precision, 0)


def log_evidence_ratio(core, precision, spectrum):
    """Logarithm of the ratio of evidences, of a colour gradient to none.

    Computed from the changes at the core (C,), their precisions (C,) and the spectrum (C,), above
    0. See the module's text.
    """
    seen = precision > 0
    if seen.sum() < 2:
        return -np.inf
    core, a, noise = core[seen], spectrum[seen], 1 / precision[seen]
    return _marginal(core, a, noise + (CORE_COLOUR_SCATTER * a) ** 2) - _marginal(core, a, noise)


def _marginal(values, direction, variance):
    """ln likelihood of values (C,) about lambda `direction` (C,), integrated over lambda."""
    inner = (direction**2 / variance).sum()
    along = (direction * values / variance).sum()
    chi2 = (values**2 / variance).sum() - along**2 / inner
    return -0.5 * (chi2 + np.log(variance).sum() + np.log(inner))
