"""Starting models of two-component fits: the better one of two candidates.

For a bulge with a disc, smooth profiles of two components are the best start. In a merger they
would lose most of the fitted structure: there the fitted component is kept, and a core is added to
it.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from ..ended import Ended
from ..profiles import COMPONENT_SPREAD, FixedProfile, GalaxyProfile
from ..solver.multiscale.structure import no_structure
from ..solver.scene import StructureState
from ..start.first_scene import best_starts, first_scene
from ..start.profile_start import fit_start_profiles, profile_peak
from .colour_gradient import run_gradient_tests

# Ratio of the sigma of an added core to that of its component: that of a Gaussian's square, which
# is the core in the test of colours.
CORE = 0.5**0.5


def start_refits(fits):
    """{index: a Fit at its start} of the scenes with sources that clearly need two components.

    Of two starts the better one where it begins, with the best spectra, see `best_starts`:
    whole   smooth profiles of two components, and those of all other components from the first
            start
    beside  all components from the first fit, and a core added to each component in question: all
            structure is kept, whichever component contains it
    """
    asked = {
        i: one
        for i, one in enumerate(run_gradient_tests(fits))
        if one is not None and len(one.significant)
    }
    if not asked:
        return {}
    fit_sky, tol = fits[0].settings.fit_sky, fits[0].settings.start_tol
    patches = [_together(fits[i], one.significant) for i, one in asked.items()]
    together = fit_start_profiles(patches, fit_sky=fit_sky, tol=tol)
    starts, n_kept = [], []
    for (i, one), all_smooth in zip(asked.items(), together, strict=True):
        first = fits[i]
        point = _as_before(all_smooth, first.start, one.significant)
        whole = _again(first, point)
        beside = _again(first, replace(_with_cores(first, one), flux_estimate=point.flux_estimate))
        beside.state = _going_on(beside.state, first, *_cores(len(first.start), one.significant))
        starts.append((whole, beside))
        n_kept.append([0.0, first.strength_estimates.n_effective.sum()])
    return dict(zip(asked, best_starts(starts, fit_sky, np.array(n_kept)), strict=True))


def _again(fit, point):
    """A fit of the same views, at their present shifts, from another StartingPoint."""
    new = copy(fit)
    new.go_on_from(None)
    new.start = point
    new.scene, new.state = first_scene(new)
    new.losses, new.status, new.strength_estimates = [], Ended.LIMIT, None
    new.messages, new.seconds = list(fit.messages), {}
    new.last_steps = np.zeros_like(fit.last_steps)
    return new


def _together(fit, chosen):
    """The start input of a fit in which the components `chosen` (k,) have two each.

    Other galaxies of one component have the profiles of the first fit's start.
    """
    begin, sources = fit.start, list(fit.patch.sources)
    thetas: list = [None] * len(sources)
    for i, source in enumerate(sources):
        own = np.flatnonzero(begin.source == i)
        thetas[i] = [begin.thetas[k] for k in own]
        if own[0] in chosen:
            sources[i], thetas[i] = replace(source, n_components=2), _split(*thetas[i])
        elif len(own) > 1:
            sources[i] = replace(source, n_components=len(own))
        elif isinstance(begin.shapes[own[0]], GalaxyProfile):
            profile = np.maximum(begin.drawn(own[0], (0, 0), fit.frame.shape), 0)  # rounding
            sources[i] = replace(source, profile=profile, n_components=None)
    return replace(fit.patch, sources=sources, thetas=thetas, given=())


def _split(theta):
    """Parameters of two components of a profile, one smaller and one larger than it."""
    apart = np.array([COMPONENT_SPREAD / 2, 0, 0, 0])
    return theta - apart, theta + apart


def _as_before(point, begin, chosen):
    """The StartingPoint of `_together`, with the first one's profiles for listed components."""
    before, new = _places(len(begin), chosen)
    drawn = [isinstance(shape, FixedProfile) for shape in point.shapes]
    held = np.flatnonzero(~new & drawn)
    shapes, thetas = list(point.shapes), list(point.thetas)
    places, peaks = point.drawn_positions.copy(), point.peaks.copy()
    estimate = begin.flux_estimate.copy()
    estimate[begin.source[list(chosen)]] = 0
    for k in held:
        i = before[k]
        shapes[k], thetas[k] = begin.shapes[i], begin.thetas[i]
        places[k], peaks[k] = begin.drawn_positions[i], begin.peaks[i]
    return replace(
        point,
        shapes=shapes,
        thetas=thetas,
        drawn_positions=places,
        peaks=peaks,
        flux_estimate=estimate,
        flux_doubt=begin.flux_doubt,
    )


def _with_cores(fit, asked):
    """The StartingPoint of a fit's components, and a core after each of those in question."""
    begin, places = fit.start, fit.start.positions[fit.start.source]
    before, new = _cores(len(begin), asked.significant)
    thetas = [begin.thetas[i] for i in before]
    peaks, power = begin.peaks[before], begin.spectrum_curvature[before]
    power[new] = asked.power[np.isin(asked.components, asked.significant)]
    for k, i in zip(np.flatnonzero(new), before[new], strict=True):
        thetas[k] = thetas[k] + np.array([np.log(CORE), 0, 0, 0])
        peaks[k] = profile_peak(
            begin.shapes[i], thetas[k], begin.drawn_positions[i], places[i], fit.frame.shape
        )
    return replace(
        begin,
        source=begin.source[before],
        shapes=[begin.shapes[i] for i in before],
        thetas=thetas,
        drawn_positions=begin.drawn_positions[before],
        peaks=peaks,
        spectra=begin.spectra[before],
        spectrum_curvature=power,
    )


def _places(n, chosen):
    """Maps the components of a second fit to the n of the first: (n + k,), bool (n + k,).

    The second array says which are one of two; chosen (k,): the components that were split.
    """
    two = np.isin(np.arange(n), chosen)
    return np.repeat(np.arange(n), 1 + two), np.repeat(two, 1 + two)


def _cores(n, chosen):
    """Numbers of the components before cores were added to the chosen ones; True for cores."""
    before, two = _places(n, chosen)
    return before, two & (np.diff(before, prepend=-1) == 0)


def _going_on(state, first, before, new):
    """A State whose morphologies, unless new, are those of the first fit.

    state: at the start of all; first: a finished Fit; before, new: see `_cores`
    """
    end, steps = first.state, first.settings.prior.steps
    known, structure, morph = end.learned, [], []
    for i, is_new, begin in zip(before, new, state.morph, strict=True):
        structure.append(no_structure(begin.shape, steps) if is_new else known.structure[i])
        morph.append(begin if is_new else end.morph[i])
    learned = StructureState(structure, known.strengths[before], known.clear[before])
    return replace(state, morph=morph, learned=learned)
