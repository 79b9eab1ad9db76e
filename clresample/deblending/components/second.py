"""Second components for sources with a gradient of colour, kept where the fit gains by them."""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace

import numpy as np

from ...sky.sources import Extended
from ..blend import INTERRUPTED
from ..iterate import iterate
from ..profiles import Galaxy, Given
from ..solver.learned.structure import coarse
from ..solver.scene import Learned
from ..start.first_scene import first_scene
from ..start.seen import see
from ..start.start import Patch, start
from .gradients import ask, model_of

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
        again = _begun(fits)
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


def _begun(fits):
    """{index: a Fit at its start} of the scenes with sources that clearly need two components.

    Of two starts the one that fits the data better where it begins. One has all else as the first
    fit has left it, structure and strengths too, and smooth profiles of the two components alone,
    fitted to what that leaves of the data: real neighbours are known from then on, but their
    structure may hold what one component could not take. In the other one smooth profiles alone
    share the light, those of all else being the first start's.
    """
    asked = {i: one for i, one in enumerate(ask(fits)) if one is not None and len(one.clear)}
    if not asked:
        return {}
    alone = start([_alone(fits[i], one) for i, one in asked.items()])
    patches = [_together(fits[i], one.clear) for i, one in asked.items()]
    together = start(patches, fit_sky=fits[0].settings.fit_sky)
    begun = []
    for (i, one), own, whole in zip(asked.items(), alone, together, strict=True):
        first = fits[i]
        known = _again(first, _joined(first.start, own, one.clear))
        known.state = _going_on(known.state, first, one.clear)
        begun += [known, _again(first, _as_before(whole, first.start, one.clear))]
    best = np.reshape(_misfits(begun), (-1, 2)).argmin(axis=1)
    return {i: begun[2 * n + k] for n, (i, k) in enumerate(zip(asked, best, strict=True))}


def _misfits(fits):
    """chi2 (n,) of Fits of one signature where they are, with the best spectra."""
    found = []
    images = see([model_of(fit) for fit in fits], fit_sky=fits[0].settings.fit_sky)
    for fit, seen in zip(fits, images, strict=True):
        residuals = seen.residuals(fit.scene.channels(), fit.views)
        pairs = zip(fit.views, residuals, strict=True)
        found.append(sum(((view.root * left) ** 2).sum() for view, left in pairs))
    return found


def _again(fit, point):
    """A fit of the same views, where their shifts are by now, from another StartingPoint."""
    new = copy(fit)
    new.start = point
    new.scene, new.state = first_scene(new)
    new.losses, new.status, new.findings = [], "iteration limit", None
    new.messages, new.seconds = list(fit.messages), {}
    new.last_steps = np.zeros_like(fit.last_steps)
    return new


def _together(fit, chosen):
    """The Patch of a fit whose sources of the components `chosen` (k,) have two each, and other
    galaxies of one component the profiles of its start."""
    begin, sources = fit.start, list(fit.patch.sources)
    for i, source in enumerate(sources):
        own = np.flatnonzero(begin.source == i)
        if own[0] in chosen:
            sources[i] = replace(source, n_components=2)
        elif len(own) == 1 and isinstance(begin.shapes[own[0]], Galaxy):
            profile = begin.drawn(own[0], (0, 0), fit.frame.shape)
            sources[i] = replace(source, profile=profile, n_components=None)
    return replace(fit.patch, sources=sources)


def _as_before(point, begin, chosen):
    """The StartingPoint of `_together`, with the Shapes of the first one for what it was given."""
    before, new = _places(len(begin), chosen)
    drawn = [isinstance(shape, Given) for shape in point.shapes]
    held = np.flatnonzero(~new & drawn)
    shapes, thetas = list(point.shapes), list(point.thetas)
    places, peaks = point.places.copy(), point.peaks.copy()
    for k in held:
        i = before[k]
        shapes[k], thetas[k] = begin.shapes[i], begin.thetas[i]
        places[k], peaks[k] = begin.places[i], begin.peaks[i]
    return replace(point, shapes=shapes, thetas=thetas, places=places, peaks=peaks)


def _alone(fit, asked):
    """The Patch of the sources that need two components, all others' light taken off the data."""
    chosen, begin = asked.clear, fit.start
    spectra = fit.state.spectra.copy()
    spectra[chosen] = 0
    views = []
    for view, seen, part in zip(fit.views, asked.observed, fit.scene.channels(), strict=True):
        others = seen.total(spectra[:, part]) + fit.state.sky[part, None, None]
        own = view.of_sources(begin.source[chosen])
        views.append(replace(own, data=view.data - others))
    positions = begin.positions[begin.source[chosen]]
    sources = [Extended(position_px=tuple(map(float, p)), n_components=2) for p in positions]
    return Patch(fit.frame, sources, positions, views)


def _joined(begin, point, chosen):
    """A StartingPoint with the components of `point`, two each, in place of those `chosen` (k,)."""
    order = []
    for i in range(len(begin)):
        own = 2 * np.flatnonzero(chosen == i)
        order += [(point, own[0]), (point, own[0] + 1)] if len(own) else [(begin, i)]
    source = [begin.source[chosen[k // 2]] if p is point else begin.source[k] for p, k in order]
    parts = {
        name: [getattr(p, name)[k] for p, k in order]
        for name in ("shapes", "thetas", "places", "peaks", "spectra", "power")
    }
    arrays = {name: np.array(parts[name]) for name in ("places", "peaks", "spectra", "power")}
    return replace(begin, source=np.array(source), **(parts | arrays))


def _places(n, chosen):
    """Which of the n components of a first fit each one of the second is, or one of two in place
    of, (n + k,); and whether it is one of two (n + k,); chosen (k,): the components in question."""
    two = np.isin(np.arange(n), chosen)
    return np.repeat(np.arange(n), 1 + two), np.repeat(two, 1 + two)


def _going_on(state, first, chosen):
    """The State of `_joined` components that are not new where the first fit has left it.

    state: at the start of all; first: a finished Fit; chosen (k,): its components that are now two
    """
    end, steps = first.state, first.settings.prior.steps
    known, (before, new) = end.learned, _places(len(end.morph), chosen)
    structure, morph = [], []
    for i, is_new, begin in zip(before, new, state.morph, strict=True):
        nothing = [np.zeros(coarse(begin.shape, step)) for step in steps]
        structure.append(nothing if is_new else known.structure[i])
        morph.append(begin if is_new else end.morph[i])
    return replace(
        state,
        morph=morph,
        spectra=np.where(new[:, None], state.spectra, end.spectra[before]),
        sky=end.sky,
        learned=Learned(structure, known.strengths[before], known.clear[before]),
    )


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
