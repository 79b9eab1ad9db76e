"""The initial scene of a fit: the start's profiles in the boxes of their light."""

from __future__ import annotations

import numpy as np

from ...sky.sources import PointSource
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
