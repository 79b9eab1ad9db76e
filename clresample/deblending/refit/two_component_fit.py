"""Fits second components to sources with a colour gradient; keeps them unless the fit is worse."""

from __future__ import annotations

import time
from dataclasses import replace

from ..ended import Ended
from ..iterate import iterate
from .colour_gradient import run_gradient_tests
from .two_component_start import start_refits

# By how much half chi2 of a second fit may be higher than that of the first one where it stays, as
# the test of colours has found a gradient. In 20 simulated galaxies of bulges, rings, bars
# and gradients (signal to noise 200 to 1000) it had better colours in all, 1.8 instead of 4.2
# errors off in the mean, but 11 had a higher loss, or more structure than Akaike's criterion allows
# for the fall of chi2. What is far worse has ended elsewhere.
MAX_WORSE = 20.0
# Decrease of the loss that a second fit must reach for each of its parameters, a spectrum and four
# of a profile, over a first fit that was stopped for it.
MIN_GAIN = 1.0
N_PROFILE = 4
# [loss] Additional decrease, beyond MIN_GAIN, of a second fit over such a first fit; if it is not
# reached, the first fit is continued to its end before both are compared. The value is twice the
# largest gain of continued fits of HST and HSC, and of a bright blend of HSC.
MIN_DECISIVE_GAIN = 200.0
# Largest number of iterations of a second fit in units of `max_iter`. A first fit that was stopped
# has not used all of its own, and one in 40 fits of a bright blend of HSC needs more than 1.5.
REFIT_ITER_FACTOR = 2.0


def needs_second_component(fit):
    """Returns True if a source of a running Fit needs a second component.

    Returns False also if the test fails; `refit_two_components` repeats it and reports the error.
    """
    try:
        (asked,) = run_gradient_tests([fit])
    except Exception:
        return False
    return asked is not None and len(asked.significant) > 0


def refit_two_components(fits, settings, device, dtype, progress=None):
    """Returns for ended Fits each itself, or a second fit with more components.

    fits: of one signature; those stopped for a refit are continued to their end, unless the second
        fit is better than they can become; settings, device, dtype: theirs; progress: see `deblend`
    returns Fits, in the order of `fits`
    """
    before = [fit.shifts for fit in fits]
    again = _second_fits(fits, settings, device, dtype, progress)
    after = {i: second.shifts for i, second in again.items()}
    for i in again:
        fits[i].shift(before[i])
    if not any(second.status == Ended.INTERRUPTED for second in again.values()):
        sure = [i for i, second in again.items() if _is_far_better(second, fits[i])]
        going = [fit for i, fit in enumerate(fits) if i not in sure and fit.status == Ended.REFIT]
        _go_on(going, settings, device, dtype, _after(list(again.values()), _after(fits, progress)))
    kept = list(fits)
    for i, second in again.items():
        if second.status != Ended.INTERRUPTED and _is_kept(second, fits[i]):
            second.shift(after[i])
            kept[i] = _following(second, fits[i])
        elif second.status == Ended.INTERRUPTED:
            kept[i].interrupt()
    for fit in kept:
        if fit.status == Ended.REFIT:
            fit.interrupt()
    return kept


def _second_fits(fits, settings, device, dtype, progress):
    """{index: finished Fit} with more components, for fits that need them.

    None for fits that fail, which their messages report.
    """
    began, shifts = time.perf_counter(), [fit.shifts for fit in fits]
    asked = fits
    try:
        again = start_refits(fits)
        for fit in fits:
            fit.note_seconds("components", (time.perf_counter() - began) / len(fits))
        asked = [fits[i] for i in again]
        if again:
            longer = replace(settings, max_iter=int(REFIT_ITER_FACTOR * settings.max_iter))
            iterate(list(again.values()), longer, device, dtype, _after(fits, progress))
    except Exception as error:
        for fit, shift in zip(fits, shifts, strict=True):
            fit.shift(shift)
        for fit in asked:
            fit.messages.append(f"second components could not be fitted: {error}")
        return {}
    return again


def _go_on(fits, settings, device, dtype, progress):
    """Continues fits that were stopped for a refit to their end.

    They are not tested again.
    """
    if not fits:
        return
    before = [fit.seconds["fit"] for fit in fits]
    for fit in fits:
        fit.status = Ended.LIMIT
        del fit.losses[-1]  # that of the present state, with which the continuation begins
    iterate(fits, settings, device, dtype, progress)
    for fit, seconds in zip(fits, before, strict=True):
        fit.note_seconds("fit", seconds + fit.seconds["fit"])


def _following(second, first):
    """The second fit, with the time of both."""
    for stage, seconds in first.seconds.items():
        second.note_seconds(stage, seconds + second.seconds.get(stage, 0.0))
    return second


def _is_kept(second, first) -> bool:
    """Returns True unless a second fit describes the data worse than a first one by MAX_WORSE."""
    if second.strength_estimates is None:
        return False
    return _half_chi2(second) < _half_chi2(first) + MAX_WORSE


def _is_far_better(second, first) -> bool:
    """Returns True if a second fit is better than a first one that was stopped can become."""
    n_more = len(second.state.morph) - len(first.state.morph)
    n_spectra = first.state.spectra.shape[1] if first.ties is None else first.ties.n_bands
    cost = MIN_GAIN * n_more * (N_PROFILE + n_spectra) + MIN_DECISIVE_GAIN
    return _is_kept(second, first) and second.losses[-1] < first.losses[-1] - cost


def _half_chi2(fit):
    """Half chi2 of a finished fit, as if its structure did not follow the noise.

    Each parameter of structure that the data determine lowers half chi2 by 0.5 if there is none.
    """
    free, found = ~fit.scene.fixed, fit.strength_estimates
    prior = (found.energies[free] / found.strengths[free] ** 2).sum()
    return fit.losses[-1] - 0.5 * prior + 0.5 * found.n_effective[free].sum()


def _after(fits, progress):
    """`progress`, with the iterations of the first fits counted."""
    if progress is None:
        return None
    n_first = max((len(fit.losses) for fit in fits), default=0)
    return lambda n_steps, loss: progress(n_first + n_steps, loss)
