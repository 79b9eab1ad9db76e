"""The status of a finished fit: whether its model describes the data, beside how it ended."""

from __future__ import annotations

import numpy as np

from ..blend import CONVERGED, MISFIT
from ..result import noted

# Sources and channels that a message names.
MOST_NAMED = 5


def judged(result):
    """The result, with the status "misfit" and a message if it has converged at a model that does
    not describe the data, see `Misfit.is_wrong`."""
    if result.status != CONVERGED or not result.misfit.is_wrong:
        return result
    return noted(result, status=MISFIT, messages=(*result.messages, _message(result)))


def _message(result):
    misfit = result.misfit
    worst = np.argsort(-np.nan_to_num(misfit.whole_chi2), kind="stable")[:MOST_NAMED]
    chi2 = ", ".join(f"{misfit.whole_chi2[c]:.2f} in {result.channels[c]}" for c in sorted(worst))
    text = f"the model does not describe the data: chi2 per pixel, over that of the noise, {chi2}"
    fraction = misfit.fraction()
    named = [s for s in np.argsort(-fraction, kind="stable")[:MOST_NAMED] if fraction[s] > 0]
    parts = ", ".join(f"source {s} leaves {100 * fraction[s]:.1f} % of its flux" for s in named)
    return f"{text}; {parts}" if parts else text
