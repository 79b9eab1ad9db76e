"""Represents the PSFs of many positions as sums of a few, to a stated tolerance."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ..psf import PSF
from ..psf_checks import PSFWarning
from .field import PSFField

# Fraction of a PSF's norm below which differences are rounding errors, and terms are useless.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class PSFBasis:
    """PSFs B of C bands and T terms, whose sums are the PSFs at S positions.

        P[s, c] = sum_t shares[s, c, t] B[c, t],     sum_t shares[s, c, t] = 1

    Each term is the PSF at one of the positions, so that it is as narrow and smooth as the others,
    and all sums have flux 1.

    psf: PSF of C * T bands, the terms of a band in turn; shares (S, C, T); n_terms: T
    max_variation (C,): largest distance |P[s] - P[r]| / |P[r]| of a PSF from that of position r in
        the middle, the norm being the root of the sum of squared samples
    max_error (C,): largest such distance between a PSF and its sum
    """

    psf: PSF
    coefficients: np.ndarray
    n_terms: int
    max_variation: np.ndarray
    max_error: np.ndarray

    @classmethod
    def of(cls, field: PSFField, places, tolerance) -> PSFBasis:
        """Basis of a PSFField at places (S, 2) [px], S > 0, to `tolerance` [1].

        `max_error` is at most the tolerance; with 0 the PSFs are exact.

        For a star of signal to noise N, in uniform noise, a PSF error of epsilon leaves residuals
        of N epsilon sigma in all pixels together.
        Raises ValueError if the PSFs differ in the distance of their samples.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PSFWarning)  # the PSF in the middle has warned
            psfs = [field.psf_at(*place) for place in places]
        spacings = {psf.spacing for psf in psfs}
        if len(spacings) > 1:
            raise ValueError(
                f"psf has samples {sorted(spacings)} px apart in places of an image: give one"
            )
        shape = np.max([psf.images.shape[1:] for psf in psfs], axis=0)
        middle = np.mean(places, axis=0)
        first = int(((np.asarray(places) - middle) ** 2).sum(axis=1).argmin())
        found = [_terms(_spectra(psfs, c, shape), first, tolerance) for c in range(field.n_bands)]
        n_terms = max(len(chosen) for chosen, *_ in found)
        shares = np.zeros((len(psfs), field.n_bands, n_terms))
        images, centers = [], []
        for c, (chosen, part, *_) in enumerate(found):
            shares[:, c, : len(chosen)] = part
            for s in chosen + [first] * (n_terms - len(chosen)):
                images.append(np.zeros(shape))
                n_y, n_x = psfs[s].images.shape[1:]
                images[-1][:n_y, :n_x] = psfs[s].images[c]
                centers.append(psfs[s].center[c])
        psf = PSF.restore(np.stack(images), spacing=spacings.pop(), center=np.stack(centers))
        variation, error = np.array([rest[2:] for rest in found]).T
        return cls(psf, shares, n_terms, variation, error)


def _spectra(psfs, band, shape):
    """Transforms (S, n) of a band's samples about their centres, real and imaginary parts.

    Sums of squares are those of the samples, wherever the centres lie.
    """
    nu_y, nu_x = np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1])
    out = []
    for psf in psfs:
        y, x = psf.center[band]
        turns = np.exp(2j * np.pi * (nu_y[:, None] * y + nu_x * x))
        found = np.fft.fft2(psf.images[band], s=tuple(shape)) * turns
        out.append(np.concatenate([found.real.ravel(), found.imag.ravel()]))
    return np.array(out)


def _terms(spectra, first, tolerance):
    """Selects positions (T) whose spectra span all of (S, n) within the tolerance, from `first` on.

    Each further position is the one farthest from the span of the previous ones. Also returns the
    coefficients (S, T), the largest distance from the first spectrum and the largest distance from
    the span, both relative to the norm of the first.
    """
    size = np.linalg.norm(spectra[first])
    rest = (spectra - spectra[first]) / size
    chosen, directions = [], []
    distance = np.linalg.norm(rest, axis=1)
    variation = distance.max()
    while distance.max() > max(tolerance, ROUNDING) and len(chosen) < len(spectra) - 1:
        chosen.append(int(distance.argmax()))
        direction = rest[chosen[-1]] / distance[chosen[-1]]
        along = rest @ direction
        directions.append(along)
        rest = rest - along[:, None] * direction
        rest[chosen[-1]] = 0
        distance = np.linalg.norm(rest, axis=1)
    shares = np.ones((len(spectra), 1))
    if chosen:
        along = np.stack(directions, axis=1)  # (S, T - 1), triangular in the rows chosen
        more = np.linalg.solve(along[chosen].T, along.T).T
        shares = np.concatenate([1 - more.sum(axis=1, keepdims=True), more], axis=1)
    return [first, *chosen], shares, variation, distance.max()
