"""The initial scene of a fit, and the best of several starts.

A scene has the start's profiles in the boxes of their light.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...sky.sources import PointSource
from ..linear.rendered_models import model_of, solve_models
from ..solver.scene import Scene, State
from .boxes import component_box


def first_scene(fit) -> tuple[Scene, State]:
    """The Scene of a Fit that has its StartingPoint, and its State."""
    begin = fit.start
    boxes = [
        component_box(begin, i, fit.frame.shape, (spectrum / fit.noise).max())
        for i, spectrum in enumerate(begin.spectra)
    ]
    morphs = [image for *_, image in boxes]
    scene = Scene(
        shape=fit.padded.shape,
        unpadded_shape=fit.frame.shape,
        ops=[v.op for v in fit.views],
        data=[v.data for v in fit.views],
        weights=[v.weights for v in fit.views],
        origin=np.array([low for low, *_ in boxes]),
        center=np.array([center for _, _, center, _ in boxes]),
        profile=morphs,
        fixed=np.array([isinstance(fit.sources[fit.fitted[i]], PointSource) for i in begin.source]),
        coefficients=[
            None if v.coefficients is None else v.coefficients[begin.source] for v in fit.views
        ],
        spectrum_curvature=begin.spectrum_curvature,
        fit_sky=fit.settings.fit_sky,
        sky_precision=fit.sky_precision,
        ties=fit.ties,
    )
    return scene, State([m.copy() for m in morphs], begin.spectra, begin.sky)


def best_starts(starts, fit_sky, n_kept=0):
    """Selects of each scene's Fits at their starts the one with the lowest chi2 + 2 n_kept.

    All scenes have equally many starts, compared with their best spectra and sky.
    n_kept (scenes, starts): parameters of their structure that the data determined, which lower
        chi2 as much if they are noise (Akaike 1974, IEEE Trans. Autom. Control 19, 716)
    """
    fits = [fit for of_scene in starts for fit in of_scene]
    solved, chi2 = solve_models([model_of(fit) for fit in fits], fit_sky=fit_sky), []
    for fit, (spectra, sky, own) in zip(fits, solved, strict=True):
        chi2.append(own)
        fit.state = replace(fit.state, spectra=spectra, sky=sky)
    best = (np.reshape(chi2, (len(starts), -1)) + 2 * n_kept).argmin(axis=1)
    return [of_scene[k] for of_scene, k in zip(starts, best, strict=True)]
