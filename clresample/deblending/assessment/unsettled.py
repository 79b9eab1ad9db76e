"""Fluxes that still change in fits that end at their largest number of iterations.

L-BFGS approaches the minimum of a large scene slowly: a flux mostly changes about as much in all
further iterations as it did in the last half. Five large blends of `simulate field --sky bright`,
seed 1, were stopped after 100 iterations and went on for 300: fluxes of three quarters of their 89
sources had settled by MAX_CHANGE_SIGMA, of which 95 % changed by less than 0.5 errors and all by
less than 0.7. All fluxes changed by less than the errors that hold the estimated changes.
"""

from __future__ import annotations

import numpy as np

from ..ended import Ended

# Parts of `max_iter` after which fluxes are kept, and the smallest number of iterations of the
# first: before, strengths have not settled.
KEPT_AFTER, MIN_ITERATIONS = (0.5, 0.75), 40
# [errors] Largest change of a settled flux: those of converged fits end as close to the minimum.
MAX_CHANGE_SIGMA = 0.2


def keeps_fluxes(before, now, max_iter) -> bool:
    """Returns True if fluxes are kept after iterations `before` to `now` of `max_iter`."""
    if KEPT_AFTER[0] * max_iter < MIN_ITERATIONS or now >= max_iter:
        return False
    return any(before < part * max_iter <= now for part in KEPT_AFTER)


def fluxes_of(fit, state) -> np.ndarray:
    """Fluxes (S, C), in the views' units, of the fitted sources of a Fit at a State."""
    found = np.zeros((len(fit.fitted), state.spectra.shape[1]))
    light = np.array([morph.sum(dtype=float) for morph in state.morph])
    np.add.at(found, fit.start.source, light[:, None] * state.spectra)
    return found


def unsettled_fluxes(fit) -> np.ndarray:
    """Changes (S, C, k) [counts] of fluxes since each time they were kept; infinite if never."""
    shape = len(fit.sources), len(fit.unit)
    if fit.status != Ended.LIMIT:
        return np.zeros((*shape, 0))
    changes = np.zeros((*shape, max(len(fit.kept_fluxes), 1)))
    now = fluxes_of(fit, fit.state)
    kept = [(now - fluxes) * fit.unit for fluxes in fit.kept_fluxes]
    changes[fit.fitted] = np.stack(kept, axis=2) if kept else np.inf
    return changes


def largest_changes(changes, unit) -> np.ndarray:
    """The largest of the changes (S, C, k) of each source, 0 for its others and unknown ones.

    Changes since one time keep their signs, and with them correlations of channels and sources.

    unit (C,) [counts]: of the norm by which the changes of a source are compared
    """
    known = np.where(np.isfinite(changes), changes, 0)
    norm = np.linalg.norm(known / unit[:, None], axis=1, keepdims=True)
    return np.where(norm == norm.max(axis=2, keepdims=True, initial=0), known, 0)


def unsettled_sources(result) -> np.ndarray:
    """Selects sources (S,) whose fluxes may still change by over MAX_CHANGE_SIGMA errors.

    All of those of a model that does not describe the data, since nothing else says so of it.
    """
    n = len(result.sources)
    if result.status in (Ended.CONVERGED, Ended.MISFIT):
        return np.zeros(n, bool)
    if result.status != Ended.LIMIT or result.errors is None or result.misfit.is_wrong:
        return np.ones(n, bool)
    error = np.sqrt(np.diagonal(result.errors.colour, axis1=1, axis2=2))
    return ~(result.errors.unsettled <= MAX_CHANGE_SIGMA * error).all(axis=1)
