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
from ..device.multi_device import (
    distribute,
    host_threads,
    iterate_threads,
    one_blas_thread,
    prefetch,
)
from ..device.tuning import Tuning
from ..drawing.bar import ProgressBar
from ..sky.observation import as_observations
from ..sky.sources import SourceWarning
from ..sky.validation.checks import check_dtype, check_instance, check_integer, check_sequence
from .blend import Blend, Failure
from .ended import Ended
from .fit import Fit, data_bytes, render_fits, scene_bytes, start_fits
from .inspection.inspect import InputWarning, warn_of_many
from .iterate import iterate
from .processes import MAX_BLENDS, can_be_sent, n_processes
from .refit.two_component_fit import needs_second_component, refit_two_components
from .result import Result
from .settings import FitSettings, Settings
from .start.profile_start import LIGHT_SIGMAS

LOG = logging.getLogger("clresample")
# [px] Frames and observations of blends of several sizes are padded to multiples of this number, so
# that they share batches. A smaller one gives more batches, a larger one more padding to compute.
PAD_PX = 16
# Largest number of components in a batch: each is a group of work-items along the third axis of a
# launch, and this is the limit of GPUs.
MAX_SOURCES = 65_535
# Largest number of blends sent to one of several devices at a time: a full batch of a GPU.
SCENES_A_PORTION = 1024
# Errors of a blend whose message is sufficient; for others the status names the class too. In
# either case the other blends continue.
ERRORS = (ValueError, DeviceError, np.linalg.LinAlgError)

# A blend without warnings: no sources far from any light, and no problems.
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

        min 1/2 sum_o |sqrt(w_o) (R_o sum_s A_s S_s - d_o)|^2 + 1/2 |z|^2,  A >= 0, S >= 0

    observations, sources, frame, shifts: see Blend; observations may include astropy's NDData and
        CCDData that have a PSF
    settings: Settings, or PaperSettings; device: see get_device
    dtype: float32 or float64, of the fit
    progress: called every few iterations with their number so far and the loss (1,)
    Raises ValueError as `check_observations`, `model_frame` and `Source` do, and if no source lies
    inside the frame. Issues a SourceWarning for sources far from any light, and an InputWarning for
    problems of the observations and of the list of sources (inspection/); the result has them in
    its messages. Ctrl-C ends the fit with the best state so far.
    """
    blend = Blend(as_observations(observations), check_sequence("sources", sources), frame, shifts)
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
    if fit.status != Ended.INTERRUPTED:
        (fit,) = refit_two_components([fit], settings, device, dtype, progress)
    result = fit.result(*render_fits([fit]))
    LOG.info("%r in %.2f s", result, sum(result.seconds.values()))
    return result


def deblend_many(
    blends,
    *,
    settings=None,
    device=None,
    dtype=np.float32,
    memory=None,
    processes=None,
    progress=None,
) -> list[Result | Failure]:
    """Fits many blends side by side, each with the result of a fit alone to float accuracy.

    device: see get_device; or a list of such choices, which share the blends by their speed. Each
        device has a process of its own, so a script must call this under
        `if __name__ == "__main__":`. Results equal those of one device. If a device fails, a
        DeviceWarning names it and the others do its work
    blends: Blend, with sizes, sources, PSFs, WCS and instruments of their own
    settings: Settings, or PaperSettings; dtype: float32 or float64, of the fits
    memory [bytes]: of the device for one group of scenes; None = 1 GiB on CPUs and a quarter of all
        memory on GPUs, which need memory for the next group too
    processes: that share one device; None = on CPUs one for each core, where every one gets 50
        sources or more, and 1.5 GiB of free memory. They do not import the caller's script, and
        results do not depend on their speed. 1 = fit in this process, as blends are that need the
        script, such as PSFs by its functions, and those of a process of `multiprocessing`
    progress: called with the number of finished blends, after each group and each failure; True
        shows a progress bar in terminals and notebooks, and prints occasional lines elsewhere
    returns a Result for each blend, in their order, or a Failure, which does not affect the others.
        Ctrl-C ends the fits of the present group with the best state so far; earlier results are
        returned, with Failures of the status "interrupted" for the rest
    Raises ValueError for wrong arguments, among them `processes` with a list of devices. Issues one
    SourceWarning for all sources far from any light, and one InputWarning for all problems with
    observations and lists of sources; the results' messages name them.
    """
    blends = check_sequence("blends", blends)
    if progress is True:
        given = {"settings": settings, "device": device, "dtype": dtype, "memory": memory}
        given["processes"] = processes
        with ProgressBar(len(blends), "blends") as bar:
            return deblend_many(blends, progress=bar, **given)
    settings, dtype = _checked(settings, dtype)
    progress = progress or (lambda n_done: None)
    given = {"settings": settings, "dtype": dtype, "memory": memory}
    # blends of one size are not padded; those of several sizes are, on every device
    given["pad"] = PAD_PX if len({_sizes(b) for b in blends} - {None}) > 1 else 1
    if isinstance(device, (list, tuple)):
        if processes is not None:
            raise ValueError(
                f"processes is {processes}, must be left out with a list of devices: each has a "
                "process; name one several times for several"
            )
        fit_some = functools.partial(_fit_all, **given)
        pairs = distribute(fit_some, blends, device, done=progress, most=SCENES_A_PORTION)
    else:
        pairs = _fit_on_one(blends, get_device(device), processes, progress, given)
    pairs = [
        pair or (Failure(blend, Ended.INTERRUPTED), NOTHING)
        for blend, pair in zip(blends, pairs, strict=True)
    ]
    dark = [sources for _, (sources, _) in pairs if len(sources)]
    if dark:
        _warn_dark(dark, " of blends that were fitted together")
    problems = [lines for _, (_, lines) in pairs if lines]
    if problems:
        warn_of_many(problems)
    return [result for result, _ in pairs]


def _fit_on_one(blends, device, processes, progress, given):
    """Results of `_fit_all`, by several processes if that is quicker; see `deblend_many`."""
    if processes is None:
        n = n_processes(blends, device, given["settings"])
    else:
        n = check_integer("processes", processes, least=1)
        n = n if n == 1 or can_be_sent((blends, given["settings"])) else 1
    if n > 1:
        fit_some = functools.partial(_fit_all, **given)
        most = min(MAX_BLENDS, -(-len(blends) // n))
        run = {"done": progress, "most": most, "equal": True, "imports_main": False}
        # no process could be started, or all have ended
        with contextlib.suppress(DeviceError, OSError):
            return distribute(fit_some, blends, [device] * n, **run)
    return _fit_all(blends, device=device, progress=progress, **given)


@one_blas_thread()
def _fit_all(blends, *, device, progress=lambda n_done: None, **given):
    """(Result or Failure, its warnings: sources far from any light, problems)."""
    many = _BatchRunner(blends, device, **given)
    # the results of unfinished blends have the status
    with contextlib.suppress(KeyboardInterrupt):
        many.run(progress)
    return [
        (Failure(blend, Ended.INTERRUPTED) if done is None else done, many.warned.get(i, NOTHING))
        for i, (blend, done) in enumerate(zip(blends, many.done, strict=True))
    ]


class _BatchRunner:
    """Blends that are fitted in groups that share a batch.

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

        Each comes with the number of blends that it finishes; a group is empty if a blend has
        failed.
        """
        waiting, held = defaultdict(list), defaultdict(lambda: np.zeros(2, int))
        for i, blend in enumerate(self.blends):
            try:
                check_instance("blend", blend, Blend)
                fit = Fit(blend, self.settings, self.device, self.dtype, pad=self.pad)
            except Exception as error:
                self.done[i] = _failure(blend, error)
                yield 1, []
                continue
            key, own = fit.signature, np.array([data_bytes(fit), len(fit.fitted)])
            waiting[key].append((i, fit))
            held[key] += own
            n_bytes, n_sources = held[key] + own  # with another one like this
            full = n_bytes > self.memory or n_sources > MAX_SOURCES
            full |= n_sources - own[1] >= self.tuning.start_sources
            if full or len(waiting[key]) >= self.tuning.n_scenes:
                del held[key]
                yield self._begun(waiting.pop(key))
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
            if any(fit.status == Ended.INTERRUPTED for _, fit in part):
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
            if not any(fit.status == Ended.INTERRUPTED for fit in fits):
                fits = refit_two_components(fits, *run)
            seen = render_fits(fits)
        except Exception as error:
            if len(group) == 1:
                yield group[0][0], _failure(group[0][1].blend, error)
                return
            for _, fit in group:
                fit.restart()
            for half in _halves(group):
                yield from self._try(half)
                if any(fit.status == Ended.INTERRUPTED for _, fit in half):
                    return
            return
        pairs = zip(fits, seen, strict=True)
        results = iterate_threads(host_threads(self.device), _result_or_failure, pairs)
        with contextlib.closing(results):
            yield from zip((i for i, _ in group), results, strict=True)


def _halves(group):
    """The two halves of a group of several."""
    middle = len(group) // 2
    return group[:middle], group[middle:]


def _checked(settings, dtype):
    """Settings, the default ones for None, and the NumPy type. ValueError for anything else."""
    return check_instance(
        "settings", Settings() if settings is None else settings, FitSettings
    ), check_dtype(dtype)


def _result_or_failure(pair):
    """The Result of a Fit and its RenderedModel, or a Failure."""
    fit, seen = pair
    try:
        return fit.result(seen)
    except Exception as error:
        return _failure(fit.blend, error)


def _failure(blend, error):
    """The Failure of a blend that ended with an exception, with that as its reason."""
    kind = "" if isinstance(error, ERRORS) else f"{type(error).__name__}: "
    return Failure(blend, Ended.FAILED, f"{kind}{error}", type(error))


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
