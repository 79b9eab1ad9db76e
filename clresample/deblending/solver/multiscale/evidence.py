"""Strength of each source's structure at each scale, by the evidence of its own data.

Near a source with profile b and spectrum A the curvature of chi2 by structure at frequency nu is
b t(nu), with t = sum_c A_c^2 T_c, where T_c is the transform of the response of R_c^T w R_c to one
pixel. With k_j(nu), the power spectrum of K_j, of mean 1, scale j has

    gamma_j = sum_x mean_nu [ alpha_j^2 k_j b t / (1 + b t sum_i alpha_i^2 k_i) ]

determined parameters, and MacKay's (1992) fixed point under a hyperprior about alpha0 is

    alpha_j^2 <- (|z_j|^2 / max(1, chi2_s) + m alpha0_j^2) / (gamma_j + m),   m = weight / seen_j^2

chi2_s is chi2 per pixel in the source's light, so that misfit does not count as structure. seen_j
is the fraction of scale j's power that the data resolve at the profile's peak, so that strengths
are not extrapolated to unresolved scales. All is computed in float64 on the host.

When the structure of a fit hardly changes any more, a source's structure is *significant* if

    |z_0|^2 / alpha_0^2 - gamma_0 > MIN_SIGNIFICANCE

at the finest scale 0, which no other scale can replace. This is the slope of the logarithm of the
evidence with ln alpha_0. From then on alpha_0 follows the data, without chi2_s and with the
fraction CLEAR_WEIGHT of m, because alpha0 is that of ordinary galaxies, unlike mergers and bright
cores.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d
from scipy.optimize import nnls

from .prior import gaussian

# Number of frequencies along a side of a local spectrum, which is the number of pixels over which
# T_c vanishes. Half of the plane is stored; the other half is its mirror image.
N_FREQUENCIES = 64
# Values of ln b, over 6 decades, in the table by which the sum over pixels is interpolated.
N_LEVELS = 24
# [of the peak] Strength of the structure in `resolved_fraction`: that of galaxies' clumps.
SEEN_STRENGTH = 0.1
MIN_SEEN = 1e-3  # so that m is finite if the data resolve nothing
# Largest factor of a change of strength in one update: the first |z|^2 are not converged.
STEP = 4.0
# Smallest and largest strength: structure of 0.1 % is negligible, and with 100 % the profile is
# irrelevant.
STRENGTHS = 1e-3, 1.0
# Sources of which the data determine fewer parameters at every scale begin with the prior's
# strengths, which the data hardly change. Others begin at the strengths that follow from their
# slopes: at most N_FIRST updates of a predicted structure, until no logarithm changes by more than
# FIRST_CHANGE, at frequencies of more than MIN_SHARPNESS of the largest sharpness.
MIN_DETERMINED, N_FIRST, FIRST_CHANGE, MIN_SHARPNESS = 50.0, 30, 0.02, 1e-6
# [1] Smallest value for significant structure. Of 259 simulated galaxies, which have no structure,
# one exceeds it, the next ones have 12 and less; bright real ones of HST and HSC have 24 to 490.
MIN_SIGNIFICANCE = 20.0
# Fraction of `hyperprior_weight` for significant structure: 10 parameters, compared to hundreds
# that bright cores determine. With all of it the core of a merger in HST's image has residuals of
# 19 sigma.
CLEAR_WEIGHT = 0.1
# The preconditioner's light is the profile blurred by this many sigma of each scale. Its curvature
# is the mean of t with weights P^POWER, where P is k_j broadened by the source's extent. The power
# is between that of the true diagonal (1) and of the curvature of the smoothest structure (2). With
# other values simulations or bright real galaxies need up to 4 times as many iterations.
WIDE, POWER = 3.0, 1.5


class LocalPowerSpectra:
    """The frequencies of local spectra, and the kernels' power there.

    k (J, F): power spectra of the kernels; weight (F,): share of each frequency, sum 1
    """

    def __init__(self, prior):
        n = N_FREQUENCIES
        along = []
        for taps in prior.kernels():
            lag = np.arange(len(taps)) - len(taps) // 2
            along.append((np.cos(2 * np.pi * np.outer(np.fft.fftfreq(n), lag)) @ taps) ** 2)
        self._half = n // 2 + 1
        self.k_plane = np.array([np.outer(a, a[: self._half]) for a in along])
        self.k = self.k_plane.reshape(len(along), -1)
        self._kernel_lags = np.fft.irfft2(self.k_plane, (n, n))
        weight = np.full((n, self._half), 2.0)
        weight[:, [0, -1]] = 1
        self.weight = weight.ravel() / n**2

    def transform(self, lags):
        """Power (..., F) of autocorrelations (..., n, n), lag (0, 0) first; at least 0."""
        power = np.fft.rfft2(lags).real
        return np.maximum(power, 0).reshape(*lags.shape[:-2], -1)

    def from_impulse_responses(self, answers, pixels):
        """T_c (C, F) from the responses (C, Ny, Nx) of R_c^T w R_c to one pixel (C, 2) each."""
        n = N_FREQUENCIES
        lags = np.zeros((len(answers), n, n))
        for lag, answer, pixel in zip(lags, answers, pixels, strict=True):
            y, x = (
                np.arange(max(p - n // 2, 0), min(p + n // 2, size))
                for p, size in zip(pixel, answer.shape, strict=True)
            )
            lag[(y - pixel[0])[:, None] % n, (x - pixel[1]) % n] = answer[y[:, None], x]
        return self.transform(lags)

    def broadened(self, amplitude):
        """P (J, F): the kernels' power under an amplitude (ny, nx), of mean 1."""
        from scipy import fft  # takes 0.05 s

        n = N_FREQUENCIES  # of lags up to half of it, beyond which light may wrap around
        size = [fft.next_fast_len(max(side + n // 2, n), real=True) for side in amplitude.shape]
        extent = fft.irfft2(np.abs(fft.rfft2(amplitude, size)) ** 2, size)
        lag = np.fft.fftfreq(n, 1 / n).astype(int)
        extent = extent[lag[:, None], lag] / max(extent[0, 0], 1e-30)
        power = self.transform(self._kernel_lags * extent)
        return power / np.maximum(power @ self.weight, 1e-30)[:, None]


class SourceEvidence:
    """Inputs of the evidence of one free source.

    spectra: LocalPowerSpectra; prior: MultiscalePrior; profile (ny, nx); response (C, F): T_c
    """

    def __init__(self, spectra, prior, profile, response):
        self.spectra, self.prior, self.response = spectra, prior, response
        b = np.maximum(profile, 1e-30)
        self._levels = np.geomspace(1e-6, 1, N_LEVELS) * b.max()
        self._pixels = _pixels_at(np.log(b.ravel()), np.log(self._levels))
        p = spectra.broadened(prior.amplitude(profile))
        mean = (p ** (POWER - 1)) @ spectra.weight
        self._mean_weights = p**POWER * spectra.weight / np.maximum(mean, 1e-30)[:, None]

    def sharpness(self, spectrum):
        """t (F,) of a spectrum (C,)."""
        return np.square(spectrum) @ self.response

    def curvature(self, spectrum):
        """The preconditioner's curvature (J,) of each scale, where the blurred light is 1."""
        return self._mean_weights @ self.sharpness(spectrum)

    def determined(self, strengths, spectrum):
        """gamma (J,): parameters that the data determine at each scale."""
        w = np.square(strengths)[:, None] * self.spectra.k * self.sharpness(spectrum)
        total = w.sum(0)
        heard = total * self._levels[-1] > 1e-5  # other frequencies determine 1e-5 of a parameter
        w, total, weight = w[:, heard], total[heard], self.spectra.weight[heard]
        shares = self._levels / (1 + self._levels * total[:, None])  # (F, levels)
        return (w * weight) @ shares @ self._pixels

    def resolved_fraction(self, spectrum):
        """Fraction (J,) of each scale's power that the data resolve at the peak."""
        k, x = self.spectra.k, SEEN_STRENGTH**2 * self.sharpness(spectrum) * self.spectra.k
        return np.maximum((k * x / (1 + x)) @ self.spectra.weight, MIN_SEEN)

    def first_strengths(self, powers, spectrum):
        """Strengths (J,) that the slopes |dL/dz_j|^2 (J,) of a source without structure predict.

        Structure of variances a_i^2 gives slopes of the power b t (1 + b t sum_i a_i^2 k_i), and
        |z_j|^2 is then that of their power times alpha_j^4 k_j / (1 + b t sum_i alpha_i^2 k_i)^2.
        """
        strengths = np.array(self.prior.strengths, float)
        is_bright = self.determined(strengths, spectrum).max() >= MIN_DETERMINED
        if not is_bright or not np.isfinite(powers).all():  # a fit whose loss overflows ends later
            return strengths
        k, t = self.spectra.k, self.sharpness(spectrum)
        sharp = t > MIN_SHARPNESS * t.max()
        k, t, weight = k[:, sharp], t[sharp], self.spectra.weight[sharp]
        noise = (k * t) @ weight * (self._levels @ self._pixels)
        both = (k * (t**2 * weight)) @ k.T * (self._levels**2 @ self._pixels)
        scatter = np.sqrt(2 * np.diagonal(both))
        variance, _ = nnls(both / scatter[:, None], (powers - noise) / scatter)
        bt = self._levels[:, None] * t
        power = bt * (1 + bt * (variance @ k)) * (self._pixels[:, None] * weight)
        for _ in range(N_FIRST):
            seen = (power / (1 + bt * (np.square(strengths) @ k)) ** 2).sum(0)
            energies = strengths**4 * (k @ seen)
            before, strengths = strengths, self.learned(strengths, energies, spectrum, 1.0)
            if np.abs(np.log(strengths / before)).max() < FIRST_CHANGE:
                break
        return strengths

    def is_clear(self, strengths, energies, spectrum):
        """Returns True if the finest structure is significant; energies (J,): |z_j|^2."""
        ratio = energies[0] / strengths[0] ** 2
        return (
            ratio > MIN_SIGNIFICANCE
            and ratio - self.determined(strengths, spectrum)[0] > MIN_SIGNIFICANCE
        )

    def learned(self, strengths, energies, spectrum, chi2, *, clear=False):
        """New strengths (J,) from the present ones and |z_j|^2 (J,); see the module's text."""
        m = self.prior.hyperprior_weight / self.resolved_fraction(spectrum) ** 2
        misfit = np.full(len(m), max(chi2, 1.0))
        if clear:
            m[0] *= CLEAR_WEIGHT
            misfit[0] = 1.0
        wanted = energies / misfit + m * np.square(self.prior.strengths)
        new = np.sqrt(wanted / (self.determined(strengths, spectrum) + m))
        return np.clip(np.clip(new, strengths / STEP, strengths * STEP), *STRENGTHS)


def blurred_light(profile, sigma, step):
    """Light (coarse ny, nx) about each coefficient of a scale: b blurred by WIDE sigma [px]."""
    taps = gaussian(WIDE * sigma, int(np.ceil(3 * WIDE * sigma)), unit_sum=True)
    light = np.maximum(profile, 0)
    for axis in (0, 1):
        light = convolve1d(light, taps, axis, mode="constant")
        at = np.arange(0, light.shape[axis] + step - 1, step)
        light = np.take(light, np.minimum(at, light.shape[axis] - 1), axis)
    return light


def _pixels_at(values, levels):
    """Pixels (n levels) that stand for `values` in sums of a function interpolated between."""
    low = np.clip(np.searchsorted(levels, values) - 1, 0, len(levels) - 2)
    part = np.clip((values - levels[low]) / (levels[low + 1] - levels[low]), 0, 1)
    count = np.bincount(low, 1 - part, len(levels))
    return count + np.bincount(low + 1, part, len(levels))
