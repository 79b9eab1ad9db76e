"""Determines the status of a finished fit by how well its model describes the data."""

from __future__ import annotations

import numpy as np

from ..ended import Ended
from ..result import noted
from .misfit import MAX_SCATTER
from .photon_noise import photon_noise_lines

# Sources and channels that a message names.
MAX_NAMED = 5


def with_misfit_status(result):
    """The result, with the status "misfit" and a message if it converged at a wrong model.

    A wrong model does not describe the data, see `Misfit.is_wrong`.
    """
    if result.status != Ended.CONVERGED or not result.misfit.is_wrong:
        return result
    return noted(result, status=Ended.MISFIT, messages=(*result.messages, _message(result)))


def misfitted_sources(result) -> np.ndarray:
    """Selects sources (S,) flagged as misfits, by their residual light (`Misfit.sources`).

    If a result has the status "misfit" and no source has a significant residual, all fitted sources
    are selected.
    """
    fitted = np.zeros(len(result.sources), bool)
    fitted[[c.source for c in result.components]] = True
    if result.status == Ended.MISFIT and not (result.misfit.significant() & fitted).any():
        return fitted
    return result.misfit.sources() & fitted


def with_source_misfit_status(result):
    """The result of a piece of a larger image, with light of other sources around it.

    Its status becomes "converged" again if the model describes its own sources.
    """
    misfit = result.misfit
    if result.status != Ended.MISFIT or misfit.is_wrong_on_sources or misfit.is_noisier:
        return result
    message = _message(result)
    kept = tuple(line for line in result.messages if line != message)
    return noted(result, status=Ended.CONVERGED, messages=kept)


def _message(result):
    misfit = result.misfit
    loud = np.flatnonzero(misfit.scatter > MAX_SCATTER)
    noise = ", ".join(f"{misfit.scatter[c]:.2g} ({result.channels[c]})" for c in loud[:MAX_NAMED])
    if loud.size:
        noise = (
            f"pixels scatter about the model by {noise} times what the weights say: errors are too "
            "small by as much; scale weights or variance"
        )
    if not misfit.is_unlike_noise:
        return noise
    largest = np.nan_to_num(misfit.whole_chi2).max(axis=0)
    worst = np.argsort(-largest, kind="stable")[:MAX_NAMED]
    chi2 = ", ".join(f"{largest[c]:.2f} in {result.channels[c]}" for c in sorted(worst))
    text = f"the model does not describe the data: chi2 per pixel, over that of the noise, {chi2}"
    fraction = misfit.fraction()
    named = [s for s in np.argsort(-fraction, kind="stable")[:MAX_NAMED] if fraction[s] > 0]
    parts = ", ".join(f"source {s} leaves {100 * fraction[s]:.1f} % of its flux" for s in named)
    return "; ".join(filter(None, (text, parts, *photon_noise_lines(result), noise)))
