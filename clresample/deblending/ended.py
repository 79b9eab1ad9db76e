"""Reasons for which fits end."""

from __future__ import annotations

import enum


class Ended(enum.StrEnum):
    """Reason for which a fit ended; as a string its text, as results, files and catalogues hold it.

    CONVERGED: the loss falls no further, at a model that describes the data; or fluxes have settled
        at the limit of iterations, see assessment/unsettled.py
    MISFIT: the loss falls no further, but the model does not describe the data, see
        `Misfit.is_wrong`
    LIMIT: `max_iter` iterations were done; also of a fit that has not ended
    DIVERGED: the loss rose beyond all bounds, or was no number
    INTERRUPTED: by Ctrl-C
    REFIT: another fit has its scene, with more components; no result has this
    FAILED: an exception
    """

    CONVERGED = "converged"
    MISFIT = "misfit"
    LIMIT = "iteration limit"
    DIVERGED = "diverged"
    INTERRUPTED = "interrupted"
    REFIT = "stopped for refit"
    FAILED = "failed"
