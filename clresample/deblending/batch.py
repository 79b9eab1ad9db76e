"""Joint deblending: one scene fitted to all instruments' images, one blend or thousands."""

from __future__ import annotations

import contextlib
import functools
import logging
import warnings
from collections import defaultdict

import numpy as np

from ..device.device import get_device
from ..device.discovery import DeviceError
from ..device.multi_device import distribute, one_blas_thread, prefetch
from ..device.tuning import Tuning
from ..drawing.bar import ProgressBar
from ..sky.observation import as_observations
from ..sky.sources import SourceWarning
from ..sky.validation.checks import check_dtype, check_instance, described
from .blend import INTERRUPTED, Blend, Failure
from .fit import Fit, data_bytes, render_fits, scene_bytes, start_fits
from .inspection.inspect import InputWarning, warn_of_many
from .iterate import iterate
from .refit.two_component_fit import needs_second_component, refit_two_components
from .result import Result
from .settings import Settings
from .start.profile_start import LIGHT_SIGMAS

LOG = logging.getLogger("clresample")
# [px] Blends of several sizes have their frames and observations padded to multiples of this, so
# that they share batches: smaller ones make more batches, larger ones more padding to compute.
PAD_PX = 16
# Components of the scenes of one batch: each is a group of work-items along the third axis of a
# launch, of which GPUs take no more.
MAX_SOURCES = 65_535
# Blends that one of several devices is given at a time, at most: what a full batch of a GPU holds.
SCENES_A_PORTION = 1024
# What says by itself what went wrong with one blend; other errors are named by their kind as well.
# None of them is a reason to give up the other blends.
ERRORS = (ValueError, DeviceError, np.linalg.LinAlgError)

# What a blend has that nothing is warned about: sources far from any light, and problems.
NOTHING: tuple = ((), ())


@one_blas_thread()
def deblend(
    observations,
    sources,
    *,
    frame=None,
    shifts=None,
    settings=None,
    device=None,
    dtype=np.float32,
    progress=None,
) -> Result:
    """Fits one scene to all observations at once.

        min 1/2 sum_o |sqrt(w_o) (R_o sum_s A_s S_s - d_o)|^2 + 1/2 |z|^2,  A >= 0, S constrained

    observations, sources, frame, shifts: see Blend; observations may include astropy's NDData and
        CCDData that have a PSF
    settings: see Settings; device: see get_device; dtype: float32 or float64, of the fit
    progress: called every few iterations with their number so far and the loss (1,)
    Raises ValueError for arguments that `check_observations`, `model_frame` and `Source` reject,
    and when no source lies inside the frame. Warns (SourceWarning) of sources far from any light.
    Ctrl-C ends the fit with the best state so far. Warns (InputWarning) of problems of the
    observations and of the list of sources (inspection/); the result has them in its messages.
    """
    blend = Blend(as_observations(observations), _listed("sources", sources), frame, shifts)
    settings, dtype = _checked(settings, dtype)
    device = get_device(device)
    fit = Fit(blend, settings, device, dtype, pad=1)
    settings = fit.settings
    start_fits([fit])
    if len(fit.undetected):
        _warn_dark([fit.undetected], "")
    for problem in fit.problems:
        warnings.warn(problem, InputWarning, stacklevel=3)
    iterate([fit], settings, device, dtype, progress, takes_over=needs_second_component)
    if fit.status != INTERRUPTED:
        (fit,) = refit_two_components([fit], settings, device, dtype, progress)
    result = fit.result(*render_fits([fit]))
    LOG.info("%r in %.2f s", result, sum(result.seconds.values()))
    return result


def deblend_many(
    blends, *, settings=None, device=None, dtype=np.float32, memory=None, progress=None
) -> list[Result | Failure]:
    """Fits many blends side by side, each with the result of a fit alone to float accuracy.

    device: see get_device; or a list of such choices: the blends are dealt to all of them by their
        speed, each with a process of its own, so that a script that calls this must do so under
        `if __name__ == "__main__":`. Results are those of one device. One that fails is named by a
        DeviceWarning, and the others do its part
    blends: Blend, with sizes, sources, PSFs, WCS and instruments of their own
    settings: see Settings; dtype: float32 or float64, of the fits
    memory [bytes]: of the device for one group of scenes; None: 1 GiB on CPUs and a quarter of all
        on GPUs, which hold the next group's data beside it
    progress: called with the number of blends done, after each group and each failure; True draws
        a bar in terminals and notebooks, and prints a line now and then where nobody looks
    returns a Result for each blend, in their order, or a Failure: it does not harm the others.
        Ctrl-C ends the fits of the group that runs with the best state so far; what was done before
        comes back, and Failures with the status "interrupted" for the rest
    Warns once (SourceWarning) of all sources far from any light, and once (InputWarning) of all
    problems with observations and lists of sources; results' messages name them.
    """
    blends = list(blends)
    if progress is True:
        given = {"settings": settings, "device": device, "dtype": dtype, "memory": memory}
        with ProgressBar(len(blends), "blends") as bar:
            return deblend_many(blends, progress=bar, **given)
    settings, dtype = _checked(settings, dtype)
    progress = progress or (lambda n_done: None)
    given = {"settings": settings, "dtype": dtype, "memory": memory}
    # blends of one size keep it; those of several are padded, whoever fits them
    given["pad"] = PAD_PX if len({_sizes(b) for b in blends} - {None}) > 1 else 1
    if isinstance(device, (list, tuple)):
        fit_some = functools.partial(_fit_all, **given)
        pairs = distribute(fit_some, blends, device, done=progress, most=SCENES_A_PORTION)
    else:
        pairs = _fit_all(blends, device=get_device(device), progress=progress, **given)
    pairs = [
        pair or (Failure(blend, INTERRUPTED), NOTHING)
        for blend, pair in zip(blends, pairs, strict=True)
    ]
    dark = [sources for _, (sources, _) in pairs if len(sources)]
    if dark:
        _warn_dark(dark, " of blends that were fitted together")
    problems = [lines for _, (_, lines) in pairs if lines]
    if problems:
        warn_of_many(problems)
    return [result for result, _ in pairs]


@one_blas_thread()
def _fit_all(blends, *, device, progress=lambda n_done: None, **given):
    """(Result or Failure, its warnings: sources far from any light, problems)."""
    many = _BatchRunner(blends, device, **given)
    # the results of what was not done say so
    with contextlib.suppress(KeyboardInterrupt):
        many.run(progress)
    return [
        (Failure(blend, INTERRUPTED) if done is None else done, many.warned.get(i, NOTHING))
        for i, (blend, done) in enumerate(zip(blends, many.done, strict=True))
    ]


class _BatchRunner:
    """Blends on their way through groups of fits that share a batch.

    done: for each blend its Result or Failure, None before that
    warned {blend: (array, list)}: indices of its sources far from any light, and its problems
    """

    def __init__(self, blends, device, *, settings, dtype, memory, pad):
        self.blends, self.settings, self.device, self.dtype = blends, settings, device, dtype
        self.pad, self.tuning = pad, Tuning.of(device, dtype)
        self.memory = self.tuning.group_memory if memory is None else memory
        self.done: list[Result | Failure | None] = [None] * len(blends)
        self.warned = {}

    def run(self, progress):
        """Fits all blends. Raises KeyboardInterrupt if the running group was interrupted."""
        n_done, groups = 0, self._groups()
        with contextlib.closing(
            prefetch(groups) if self.tuning.prefetch_groups else groups
        ) as begun:
            for n, group in begun:
                interrupted = self._fit(group)
                del group  # before the next one is made
                n_done += n
                progress(n_done)
                if interrupted:
                    raise KeyboardInterrupt

    def _groups(self):
        """Groups of (index, Fit) that have begun, as they fill up.

        Each comes with the number of blends that are done with it; a group is empty where a blend
        has failed.
        """
        waiting = defaultdict(list)
        for i, blend in enumerate(self.blends):
            try:
                check_instance("blend", blend, Blend)
                fit = Fit(blend, self.settings, self.device, self.dtype, pad=self.pad)
            except Exception as error:
                self.done[i] = _failure(blend, error)
                yield 1, []
                continue
            group = waiting[fit.signature]
            group.append((i, fit))
            n_sources = [len(f.fitted) for _, f in group]
            full = sum(data_bytes(f) for _, f in group) + data_bytes(fit) > self.memory
            full |= sum(n_sources) >= self.tuning.start_sources
            full |= sum(n_sources) + n_sources[-1] > MAX_SOURCES
            if full or len(group) >= self.tuning.n_scenes:
                yield self._begun(waiting.pop(fit.signature))
        while waiting:
            yield self._begun(waiting.popitem()[1])

    def _begun(self, group):
        return len(group), self._begin(group)

    def _begin(self, group):
        """Starts a group of (index, Fit), by halves if the group fails; returns those started."""
        try:
            start_fits([fit for _, fit in group])
        except Exception as error:
            if len(group) > 1:
                return [item for half in _halves(group) for item in self._begin(half)]
            (i, fit), *_ = group
            self.done[i] = _failure(fit.blend, error)
            return []
        self.warned |= {i: (fit.undetected, fit.problems) for i, fit in group}
        return group

    def _fit(self, group):
        """Fits a started group of (index, Fit). Returns True if Ctrl-C ended it."""
        for part in self._parts(group):
            for i, done in self._try(part):
                self.done[i] = done
            if any(fit.status == INTERRUPTED for _, fit in part):
                return True
        return False

    def _parts(self, group):
        """A group in parts that fit into the memory, now that the boxes are known."""
        part, n_bytes = [], 0
        for item in group:
            if part and n_bytes + scene_bytes(item[1]) > self.memory:
                yield part
                part, n_bytes = [], 0
            part.append(item)
            n_bytes += scene_bytes(item[1])
        if part:
            yield part

    def _try(self, group):
        """Yields (index, Result or Failure) of a group, fitted by halves if the group fails."""
        fits = [fit for _, fit in group]
        run = fits[0].settings, self.device, self.dtype
        try:
            iterate(fits, *run, takes_over=needs_second_component)
            if not any(fit.status == INTERRUPTED for fit in fits):
                fits = refit_two_components(fits, *run)
            seen = render_fits(fits)
        except Exception as error:
            if len(group) == 1:
                yield group[0][0], _failure(group[0][1].blend, error)
                return
            for fit in fits:
                fit.restart()
            for half in _halves(group):
                yield from self._try(half)
                if any(fit.status == INTERRUPTED for _, fit in half):
                    return
            return
        for (i, _), fit, own in zip(group, fits, seen, strict=True):
            try:
                yield i, fit.result(own)
            except Exception as error:
                yield i, _failure(fit.blend, error)


def _halves(group):
    """The two halves of a group of several."""
    middle = len(group) // 2
    return group[:middle], group[middle:]


def _checked(settings, dtype):
    """Settings, the default ones for None, and the NumPy type. ValueError for anything else."""
    return check_instance(
        "settings", Settings() if settings is None else settings, Settings
    ), check_dtype(dtype)


def _listed(name, values):
    """The values as a tuple. Raises ValueError for one alone."""
    try:
        return tuple(values)
    except TypeError:
        raise ValueError(f"{name} is {described(values)}, must be a sequence") from None


def _failure(blend, error):
    """The Failure of a blend that ended with an exception, with that in its status."""
    kind = "" if isinstance(error, ERRORS) else f"{type(error).__name__}: "
    return Failure(blend, f"failed: {kind}{error}")


def _sizes(blend):
    """The shapes of a blend's images and of its frame; None for an invalid blend."""
    try:
        blend.check()
    except (ValueError, TypeError, AttributeError):
        return None
    return tuple(o.data.shape for o in blend.observations), blend.frame and blend.frame.shape


def _warn_dark(dark, where):
    """Warns the caller of `deblend` or `deblend_many` of sources far from any light."""
    n = sum(map(len, dark))
    warnings.warn(
        f"no light above {LIGHT_SIGMAS:g} sigma at or near {n} source position{'s' * (n > 1)}"
        f"{where}: see Result.messages",
        SourceWarning,
        stacklevel=3,
    )
