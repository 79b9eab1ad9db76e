"""Second components for sources with a gradient of colour, kept where the fit gains by them."""

from __future__ import annotations

import time

from ..blend import INTERRUPTED
from ..iterate import iterate
from .second_start import begun

# What a second component must lower the loss by, for each number that it adds: a spectrum and a
# profile's four. Half a unit each is what noise alone gives.
LEAST_GAIN = 1.0
N_PROFILE = 4


def with_second(fits, settings, device, dtype, progress=None):
    """What to keep of finished Fits: each itself, or a second one with more components.

    fits: of one signature; settings, device, dtype: theirs; progress: see `deblend`
    returns Fits, in the order of `fits`
    """
    kept, began = list(fits), time.perf_counter()
    try:
        again = begun(fits)
    except Exception as error:
        _note(fits, error)
        return kept
    for fit in fits:
        fit.note_seconds("components", (time.perf_counter() - began) / len(fits))
    if not again:
        return kept
    shifts = {i: fits[i].shifts for i in again}
    try:
        iterate(list(again.values()), settings, device, dtype, _after(fits, progress))
    except Exception as error:
        _note([fits[i] for i in again], error)
        for i, second in again.items():
            second.shift(shifts[i])
        return kept
    for i, second in again.items():
        if second.status != INTERRUPTED and _is_better(second, kept[i]):
            kept[i] = _following(second, kept[i])
            continue
        second.shift(shifts[i])
        if second.status == INTERRUPTED:
            kept[i].interrupt()
    return kept


def _note(fits, error):
    """Say in the messages of fits what kept them from second components."""
    for fit in fits:
        fit.messages.append(f"second components could not be fitted: {error}")


def _following(second, first):
    """The second fit, with the time of both."""
    for stage, seconds in first.seconds.items():
        second.note_seconds(stage, seconds + second.seconds.get(stage, 0.0))
    return second


def _is_better(second, first):
    """Whether more components lower the loss by more than their numbers cost, and fit the data
    better: one component with stronger structure may do that, at a higher loss."""
    if second.findings is None or _half_chi2(second) > _half_chi2(first):
        return False
    n_more = len(second.state.morph) - len(first.state.morph)
    n_numbers = n_more * (N_PROFILE + first.state.spectra.shape[1])
    return second.losses[-1] < first.losses[-1] - LEAST_GAIN * n_numbers


def _half_chi2(fit):
    """The loss of a finished fit without what its structure costs."""
    free, found = ~fit.scene.fixed, fit.findings
    return fit.losses[-1] - 0.5 * (found.energies[free] / found.strengths[free] ** 2).sum()


def _after(fits, progress):
    """`progress`, with the iterations of the first fits counted."""
    if progress is None:
        return None
    n_first = max(len(fit.losses) for fit in fits)
    return lambda n_steps, loss: progress(n_first + n_steps, loss)
