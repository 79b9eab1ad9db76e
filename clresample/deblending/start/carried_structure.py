"""Structure of an earlier fit of the same sources, from which a fit goes on."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from ..solver.multiscale.prior import MultiscalePrior, kernel_rows, without_profile
from ..solver.multiscale.structure import coarse_count, no_structure
from ..solver.scene import StructureState
from .first_scene import best_starts
from .profile_start import by_size


def carry_structure(fits):
    """Adds the structures of `Blend.structures` to Fits at their start, with the best spectra.

    A scene that its profiles alone describe better starts without structure.

    fits: of one signature
    Raises ValueError for structure of another number of scales than the prior's.
    """
    starts = []
    for fit in fits:
        if isinstance(getattr(fit.settings, "prior", None), MultiscalePrior):
            known = _of_components(fit)
            if known:
                going_on = copy(fit)
                going_on.state = _with_structure(fit, known)
                starts.append((fit, going_on))
    if starts:
        best = best_starts(starts, fits[0].settings.fit_sky)
        for (fit, _), chosen in zip(starts, best, strict=True):
            fit.go_on_from(chosen.state)


def _of_components(fit):
    """{component: its ComponentStructure} of sources with as many components as before.

    Of several the most compact one is first, as in the start's profiles.
    """
    known, n_scales = {}, len(fit.settings.prior.steps)
    for i in np.unique(fit.start.source):
        places, at = np.flatnonzero(fit.start.source == i), fit.fitted[i]
        given, thetas = fit.blend.structures[at] or (), fit.blend.thetas[at] or ()
        if not len(places) == len(given) == len(thetas):
            continue
        for k, one in zip(places.tolist(), (given[j] for j in by_size(thetas)), strict=True):
            if one is not None and not fit.scene.fixed[k]:
                if len(one.coefficients) != n_scales:
                    raise ValueError(
                        f"structures[{at}] has {len(one.coefficients)} scales, the prior has "
                        f"{n_scales}: pass Result.structures of a fit with the same prior"
                    )
                known[k] = one
    return known


def _with_structure(fit, known):
    """The State of a Fit at its start with known structures {component: ComponentStructure}."""
    scene, prior, morphs, structure = fit.scene, fit.settings.prior, [], []
    strengths = np.tile(np.array(prior.strengths, float), (len(scene.profile), 1))
    clear = np.zeros(len(strengths), bool)
    for k, (profile, morph) in enumerate(zip(scene.profile, fit.state.morph, strict=True)):
        if k in known:
            structure.append(moved_structure(known[k], scene.origin[k], profile.shape, prior))
            morph = morphology(profile, structure[-1], prior)
            strengths[k], clear[k] = known[k].strengths, known[k].clear
        else:
            structure.append(no_structure(profile.shape, prior.steps))
        morphs.append(morph)
    return replace(fit.state, morph=morphs, learned=StructureState(structure, strengths, clear))


def moved_structure(known, origin, shape, prior):
    """Coefficients (J) of a ComponentStructure in a box of a shape from another origin [px] on.

    They are interpolated by cubic splines where the lattices differ, and 0 beyond the former box.
    """
    moved = []
    for z, step in zip(known.coefficients, prior.steps, strict=True):
        at = [
            (new - old) / step + np.arange(coarse_count(n, step))
            for new, old, n in zip(origin, known.origin, shape, strict=True)
        ]
        moved.append(map_coordinates(z.astype(float), np.meshgrid(*at, indexing="ij"), order=3))
    return moved


def morphology(profile, structure, prior):
    """The morphology (ny, nx) of coefficients (J) about a profile, see MultiscalePrior."""
    u = np.zeros(profile.shape)
    for j, z in enumerate(structure):
        along_y, along_x = (kernel_rows(prior, j, n) for n in profile.shape)
        u += along_y.T @ z @ along_x
    u *= prior.amplitude(profile)
    return np.maximum(profile + without_profile(u, profile), 0)
