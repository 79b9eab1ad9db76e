"""Finds pairs of sources whose light the data cannot assign: they may exchange it."""

from __future__ import annotations

import numpy as np

# Part of a source's variance that its covariance with another one cancels in their sum, from which
# on its error is that of dividing their light. Two equal sources have it with a correlation of
# -0.8: their difference has three times the error of their sum.
EXCHANGED = 0.8
# Part of a flux that is its error at least: within two errors there may be half as much or half as
# much again.
UNDETERMINED = 0.25
# [sigma] Least signal to noise of the sum: what is no light at all has no owner.
DETECTED = 5.0


def is_ambiguous(flux, covariance) -> np.ndarray:
    """Returns for two sources (2,) True if its light may be the other one's.

    In the channel that determines a source best its flux is uncertain by more than UNDETERMINED of
    itself, that error is one of exchange, since the other source has what this one lacks, and the
    sum of both is detected. Noise and the own errors of a bright neighbour make none ambiguous.

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
        c = int(np.argmax(snr))
        together = max(covariance[c].sum(), 0.0)
        found[one] = (
            UNDETERMINED * snr[c] < 1
            and -shared[c] > EXCHANGED * own[c]
            and flux[c].sum() > DETECTED * np.sqrt(together)
        )
    return found


def partners(flux, covariance) -> np.ndarray:
    """Partner of each source with which its light may be exchanged, -1 without one: (S,) int.

    Of several candidates, the one whose covariance takes the most from its variance in some
    channel. flux (S, C) [counts]; covariance (C, S, S) [counts^2]
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
