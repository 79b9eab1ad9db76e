"""The scene kernels written down plainly in NumPy float64: what scene.cl and update.cl must give.

One scene: C channels, S sources, morphs (S): arrays (ny, nx) in boxes from origin (S, 2) [px] on,
spectra (S, C).
"""

from __future__ import annotations

import numpy as np


def compose(shape, origin, morphs, spectra):
    """Model (C, Ny, Nx) = sum_s spectra[s, c] S_s."""
    model = np.zeros((spectra.shape[1], *shape))
    for a, m, box in zip(spectra, morphs, _boxes(origin, morphs), strict=True):
        model[box] += a[:, None, None] * m
    return model


def residual(image, data, weights, sky):
    """w r (C, My, Mx) with r = image + sky - data; loss 1/2 sum w r^2; pull (C,) = sum w r."""
    r = image + sky[:, None, None] - data
    return weights * r, 0.5 * (weights * r**2).sum(), (weights * r).sum(axis=(1, 2))


def gather_morph(gradient, origin, morphs, spectra):
    """dS_s (S arrays) = sum_c spectra[s, c] G_c on the box; gradient G (C, Ny, Nx)."""
    boxes = _boxes(origin, morphs)
    return [np.tensordot(a, gradient[box], 1) for a, box in zip(spectra, boxes, strict=True)]


def gather_spectra(gradient, origin, morphs):
    """dA (S, C) = <S_s, G_c>."""
    boxes = _boxes(origin, morphs)
    return np.array(
        [(gradient[box] * m).sum(axis=(1, 2)) for m, box in zip(morphs, boxes, strict=True)]
    )


def blur(image, taps):
    """K image: `taps` along both axes, zero beyond the image's edges."""
    for axis in (0, 1):
        out, radius, n = np.zeros(image.shape), len(taps) // 2, image.shape[axis]
        for t, k in zip(range(-radius, radius + 1), taps, strict=True):
            i = np.arange(max(0, -t), min(n, n - t))
            if axis == 0:
                out[i] += k * image[i + t]
            else:
                out[:, i] += k * image[:, i + t]
        image = out
    return image


def form(base, amp, field, taps):
    """S = base + amp o K z."""
    return base + amp * blur(field, taps)


def field_gradient(d_morph, morph, amp, field, taps):
    """dL/dz = K (amp o dS where S > 0) + z."""
    return blur(np.where(morph > 0, amp * d_morph, 0), taps) + field


def amsgrad(gradient, moments, i_step, *, beta1=0.9, beta2=0.999, epsilon=1e-8):
    """Direction of step i_step = 1, 2, ..., x <- x - rate direction, and the moments (m, v, h)."""
    m, v, h = moments
    m = beta1 * m + (1 - beta1) * gradient
    v = beta2 * v + (1 - beta2) * gradient**2
    h = np.maximum(h, v)
    size = np.sqrt(h / (1 - beta2**i_step)) + epsilon
    return m / (1 - beta1**i_step) / size, (m, v, h)


def _boxes(origin, morphs):
    return [
        (slice(None), slice(y, y + m.shape[0]), slice(x, x + m.shape[1]))
        for (y, x), m in zip(origin, morphs, strict=True)
    ]
