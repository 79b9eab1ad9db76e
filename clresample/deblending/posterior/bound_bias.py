"""Bias of fluxes and sizes caused by the bounds S >= 0 and A >= 0.

In a galaxy's wings structure follows positive noise, but not negative noise, because S >= 0. So the
light of bright galaxies is 0.1 to 1 % too high, about half an error. The flux of a source without
light in a band is 0 for negative noise, 0.3 to 0.5 of its error in the mean. At a pixel or spectrum
on the bound the gradient of the loss is not zero. The Newton step along the modes and spectra leads
to the minimum without the bounds, whose fluxes and moments do not have this bias.
"""

from __future__ import annotations

import numpy as np

from ...sky.box import box_slices


def negative_chi2_gradient(scene, views, source, spectra, residuals):
    """Minus the slopes of half chi2 by all pixels (ny, nx) of n morphologies with max = 1.

    scene: Scene; views: WhitenedViews; source (n,): of each component, by which views know its PSF
    spectra (n, C): theirs; residuals: data minus model (Co, My, Mx) of each view
    """
    out = [np.zeros(p.shape) for p in scene.profile]
    for view, left, part in zip(views, residuals, scene.channels(), strict=True):
        frames = view.op.adjoint((view.sqrt_weights**2 * left).astype(view.op.dtype))
        own = spectra[:, part]
        if view.coefficients is not None:
            own = (own[:, :, None] * view.coefficients[source]).reshape(len(own), -1)
        for image, origin, a in zip(out, scene.origin, own, strict=True):
            image += np.tensordot(a, frames[:, *box_slices(origin, image.shape)], 1)
    return out
