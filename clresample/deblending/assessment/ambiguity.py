"""Finds pairs of sources whose light the data cannot assign: they may exchange it."""

from __future__ import annotations

import numpy as np

# Fraction of a source's variance cancelled by its covariance with another source in the sum of
# both, above which its error is dominated by the division of their light. For two equal sources it
# means a correlation of -0.8: their difference then has three times the error of their sum.
EXCHANGED = 0.8
# Smallest relative error of the flux of an ambiguous source: with two such errors the flux is half
# as large, or larger by a half.
UNDETERMINED = 0.25
# [sigma] Smallest signal to noise of the sum of both: undetected light is not ambiguous.
DETECTED = 5.0


def is_ambiguous(flux, covariance) -> np.ndarray:
    """Returns for two sources (2,) True if its light may be the other one's.

    Criteria: its relative flux error is more than UNDETERMINED in the channel that determines it
    best; and in some channel the error is dominated by the division of light, since it cancels in
    the sum of both fluxes, and the sum is detected. Noise alone, or the errors of a bright
    neighbour, do not suffice.

    flux (C, 2) [counts]; covariance (C, 2, 2) [counts^2]: of the two fluxes in each channel, those
        of channels without coverage infinite
    """
    flux, covariance = np.asarray(flux, float), np.asarray(covariance, float)
    found = np.zeros(2, bool)
    for one in (0, 1):
        own, shared = covariance[:, one, one], covariance[:, 0, 1]
        usable = (
            np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(flux).all(axis=1) & (own > 0)
        )
        if not usable.any():
            continue
        snr = np.where(usable, flux[:, one] / np.sqrt(np.where(usable, own, 1.0)), -np.inf)
        together = np.maximum(covariance.sum(axis=(1, 2), where=usable[:, None, None]), 0.0)
        exchanged = usable & (-shared > EXCHANGED * own)
        detected = flux.sum(axis=1, where=usable[:, None]) > DETECTED * np.sqrt(together)
        found[one] = UNDETERMINED * snr.max() < 1 and (exchanged & detected).any()
    return found


def partners(flux, covariance) -> np.ndarray:
    """Partner of each source with which its light may be exchanged, -1 without one: (S,) int.

    Of several candidates, the one whose covariance cancels the largest part of its variance in
    some channel. flux (S, C) [counts]; covariance (C, S, S) [counts^2]
    """
    found, most = np.full(len(flux), -1), np.zeros(len(flux))
    for s, t in np.argwhere(np.triu((covariance < 0).any(axis=0), 1)):
        pair = [s, t]
        both = covariance[:, pair][:, :, pair]
        for k in np.flatnonzero(is_ambiguous(flux[pair].T, both)):
            usable = np.isfinite(both).all(axis=(1, 2)) & (both[:, k, k] > 0)
            share = (-both[usable, 0, 1] / both[usable, k, k]).max()
            if share > most[pair[k]]:
                found[pair[k]], most[pair[k]] = pair[1 - k], share
    return found
