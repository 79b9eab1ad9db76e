"""The scene on the host in NumPy: M_c = sum_s A[s, c] S_s, each morphology in its box.

The kernels of scene.cl do the same on the device; this serves what is needed once or seldom.
"""

from __future__ import annotations

import numpy as np

from ...sky.box import box_slices


def compose(shape, origin, morphs, spectra):
    """Model (C, Ny, Nx) = sum_s spectra[s, c] S_s.

    shape (Ny, Nx) [px]; origin (S, 2) [px]; morphs (S): arrays (ny, nx); spectra (S, C)
    """
    model = np.zeros((np.shape(spectra)[1], *shape))
    for spectrum, low, morph in zip(spectra, origin, morphs, strict=True):
        model[:, *box_slices(low, morph.shape)] += spectrum[:, None, None] * morph
    return model


def gather_morph(gradient, origin, morphs, spectra):
    """dS_s (S arrays) = sum_c spectra[s, c] G_c on the box; gradient G (C, Ny, Nx).

    The adjoint of `compose` by the morphologies, of which only the shapes count here.
    """
    return [
        np.tensordot(spectrum, gradient[:, *box_slices(low, morph.shape)], 1)
        for spectrum, low, morph in zip(spectra, origin, morphs, strict=True)
    ]


def gather_spectra(gradient, origin, morphs):
    """dA (S, C) = <S_s, G_c>: the adjoint of `compose` by the spectra."""
    pairs = zip(origin, morphs, strict=True)
    return np.array(
        [(gradient[:, *box_slices(low, m.shape)] * m).sum(axis=(1, 2)) for low, m in pairs]
    )
