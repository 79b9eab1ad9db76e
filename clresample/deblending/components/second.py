"""Second components for sources with a gradient of colour, kept where the fit gains by them."""

from __future__ import annotations

import time
from dataclasses import replace

from ..blend import HANDED_OVER, INTERRUPTED, UNFINISHED
from ..iterate import iterate
from .gradients import ask
from .second_start import begun

# What a second component must lower the loss by, for each number that it adds: a spectrum and a
# profile's four. Half a unit each is what noise alone gives.
LEAST_GAIN = 1.0
N_PROFILE = 4
# [loss] By so much more than LEAST_GAIN a second fit must be better than a first one that was taken
# over; else the first one goes on to its end before they are compared. Twice what fits of HST and
# HSC, and of a bright blend of HSC, still gained at most where they went on.
SURE = 200.0
# A second fit may take so many times `max_iter`: the first one, if it was taken over, has left some
# of its own, and one in 40 fits of a bright blend of HSC needs more than 1.5.
LONGER = 2.0


def asks_for_more(fit):
    """Whether a Fit in its present state clearly needs second components. Where that cannot be told
    it goes on: `with_second` asks again, and says in its messages what is wrong."""
    try:
        (asked,) = ask([fit])
    except Exception:
        return False
    return asked is not None and len(asked.clear) > 0


def with_second(fits, settings, device, dtype, progress=None):
    """What to keep of Fits that have ended: each itself, or a second one with more components.

    fits: of one signature; those HANDED_OVER go on to their end, unless a second one is better than
        they can become; settings, device, dtype: theirs; progress: see `deblend`
    returns Fits, in the order of `fits`
    """
    before = [fit.shifts for fit in fits]
    again = _second_fits(fits, settings, device, dtype, progress)
    after = {i: second.shifts for i, second in again.items()}
    for i in again:
        fits[i].shift(before[i])
    if not any(second.status == INTERRUPTED for second in again.values()):
        sure = [i for i, second in again.items() if _is_better(second, fits[i], SURE)]
        going = [fit for i, fit in enumerate(fits) if i not in sure and fit.status == HANDED_OVER]
        _go_on(going, settings, device, dtype, _after(list(again.values()), _after(fits, progress)))
    kept = list(fits)
    for i, second in again.items():
        if second.status != INTERRUPTED and _is_better(second, fits[i]):
            second.shift(after[i])
            kept[i] = _following(second, fits[i])
        elif second.status == INTERRUPTED:
            kept[i].interrupt()
    for fit in kept:
        if fit.status == HANDED_OVER:
            fit.interrupt()
    return kept


def _second_fits(fits, settings, device, dtype, progress):
    """{index: a Fit that has ended} with more components of those that need them; none where that
    fails, which their messages say."""
    began, shifts = time.perf_counter(), [fit.shifts for fit in fits]
    asked = fits
    try:
        again = begun(fits)
        for fit in fits:
            fit.note_seconds("components", (time.perf_counter() - began) / len(fits))
        asked = [fits[i] for i in again]
        if again:
            longer = replace(settings, max_iter=int(LONGER * settings.max_iter))
            iterate(list(again.values()), longer, device, dtype, _after(fits, progress))
    except Exception as error:
        for fit, shift in zip(fits, shifts, strict=True):
            fit.shift(shift)
        for fit in asked:
            fit.messages.append(f"second components could not be fitted: {error}")
        return {}
    return again


def _go_on(fits, settings, device, dtype, progress):
    """Run fits that were HANDED_OVER to their end, from where they are; nobody asks them again."""
    if not fits:
        return
    before = [fit.seconds["fit"] for fit in fits]
    for fit in fits:
        fit.status = UNFINISHED
        del fit.losses[-1]  # that of the present state, which comes first again
    iterate(fits, settings, device, dtype, progress)
    for fit, seconds in zip(fits, before, strict=True):
        fit.note_seconds("fit", seconds + fit.seconds["fit"])


def _following(second, first):
    """The second fit, with the time of both."""
    for stage, seconds in first.seconds.items():
        second.note_seconds(stage, seconds + second.seconds.get(stage, 0.0))
    return second


def _is_better(second, first, more=0.0):
    """Whether more components lower the loss by more than their numbers cost, and `more` than that,
    and fit the data better: one component with stronger structure may do that, at a higher loss."""
    if second.findings is None or _half_chi2(second) > _half_chi2(first):
        return False
    n_more = len(second.state.morph) - len(first.state.morph)
    n_spectra = first.state.spectra.shape[1] if first.ties is None else first.ties.n_bands
    n_numbers = n_more * (N_PROFILE + n_spectra)
    return second.losses[-1] < first.losses[-1] - LEAST_GAIN * n_numbers - more


def _half_chi2(fit):
    """The loss of a finished fit without what its structure costs."""
    free, found = ~fit.scene.fixed, fit.findings
    return fit.losses[-1] - 0.5 * (found.energies[free] / found.strengths[free] ** 2).sum()


def _after(fits, progress):
    """`progress`, with the iterations of the first fits counted."""
    if progress is None:
        return None
    n_first = max((len(fit.losses) for fit in fits), default=0)
    return lambda n_steps, loss: progress(n_first + n_steps, loss)
