"""The initial scene of a fit: the start's profiles in the boxes of their light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...sky.sources import PointSource
from ..resize import component_box
from ..solver.curvature import damping
from ..solver.scene import Scene, State

# A spectrum's step size is its flux error plus this fraction of the flux, so that fluxes of bright
# sources can follow changes of their morphology, which are much larger than their errors.
SPECTRUM_PART = 0.02
# Smallest curvature sum |u|^2 of a component's whitened image u in a channel, whose root is the
# inverse of its spectrum's error; and the error above which the channel does not contain the
# component, so that its spectrum is fixed there. A covered component has errors of at most 1e6.
MIN_POWER, UNSEEN = 1e-30, 1e14


def first_scene(fit) -> tuple[Scene, State]:
    """The Scene of a Fit that has its StartingPoint, and its State."""
    begin = fit.start
    boxes = [
        component_box(begin, i, fit.frame.shape, (spectrum / fit.noise).max())
        for i, spectrum in enumerate(begin.spectra)
    ]
    morphs = [image for *_, image in boxes]
    spectra, power = begin.spectra, begin.spectrum_curvature
    together = power if fit.ties is None else fit.ties.spread(fit.ties.total(power))
    error = 1 / np.sqrt(np.maximum(together, MIN_POWER))
    scene = Scene(
        shape=fit.padded.shape,
        unpadded_shape=fit.frame.shape,
        ops=[v.op for v in fit.views],
        data=[v.data for v in fit.views],
        weights=[v.sqrt_weights**2 for v in fit.views],
        origin=np.array([low for low, *_ in boxes]),
        center=np.array([center for _, _, center, _ in boxes]),
        profile=morphs,
        fixed=np.array([isinstance(fit.sources[fit.fitted[i]], PointSource) for i in begin.source]),
        step_scale=np.where(error < UNSEEN, error + SPECTRUM_PART * spectra, 0),
        coefficients=[
            None if v.coefficients is None else v.coefficients[begin.source] for v in fit.views
        ],
        spectrum_curvature=power,
        fit_sky=fit.settings.fit_sky,
        sky_precision=fit.sky_precision,
        ties=fit.ties,
    )
    latent = [np.zeros_like(m) for m in morphs]
    state = State(latent, [m.copy() for m in morphs], spectra, begin.sky)
    if not fit.settings.has_multiscale_prior:
        scene = replace(scene, damping=damping(scene, state, fit.settings.prior))
    return scene, state
