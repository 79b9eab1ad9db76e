"""Sources that are found late: in the residuals of a first fit."""

from __future__ import annotations

from dataclasses import replace

from ..deblending.blend import Failure
from ..deblending.ended import Ended
from ..deblending.settings import Settings
from ..deblending.solver.multiscale.prior import MultiscalePrior

# Iterations of a first look: by then the sources that were found are fitted to a few percent; more
# would find the same ones later.
LOOK_ITERATIONS = 30
# Structure of a model pixel alone: larger scales would take up unknown neighbours' light. Much
# weaker structure leaves clumps of bright galaxies in the residuals, which are taken for sources.
LOOK_PRIOR = MultiscalePrior(scales_px=(0.8,), strengths=(0.1,))


def look_settings(settings, *, sources=True):
    """Settings of a first look before a fit with these; sources: if it is to find sources."""
    look = replace(settings, max_iter=min(LOOK_ITERATIONS, settings.max_iter))
    if sources and isinstance(settings, Settings):
        return replace(look, prior=LOOK_PRIOR, errors=False)
    return look


def fit_with_late_sources(blends, fit, find, *, look=None):
    """Fits blends, and again those in whose residuals sources are found.

    blends: of any kind that `fit` and `find` take
    fit: called with a list of blends, returns their Results and Failures; find: called with a blend
        and its Result, returns the blend to fit again, None where nothing is found
    look: a rougher `fit` for the first time, None = `fit`
    returns (blend, Result or Failure) of each; the first fit stands where the second one fails
    """
    fitted, again = list(zip(blends, (look or fit)(blends), strict=True)), []
    for i, (blend, result) in enumerate(fitted):
        if isinstance(result, Failure) or result.status == Ended.INTERRUPTED:
            continue
        more = find(blend, result)
        if more is not None:
            again.append((i, more))
    results = fit([blend for _, blend in again]) if again else []
    for (i, blend), result in zip(again, results, strict=True):
        if not isinstance(result, Failure):
            fitted[i] = blend, result
    return fitted
