"""The solver's kernels in NumPy, written from their definitions.

The tests compare kernels with it.

First the steps of one scene (update.cl), in float64: S sources with arrays (ny, nx), C channels.
Its loss is in deblending/solver/reference.py.

Then the constraints (prox.cl): every function takes one image x (Ny, Nx) and returns a
new one of the same type. Where a `center` is asked for it is the pixel (cy, cx). Sources: Parikh &
Boyd 2014 for the proximal operators; Melchior et al. 2018 (arXiv:1802.10157) for the monotone sweep
and the symmetry; Melchior et al. 2019 (arXiv:1910.10094) for proximal AMSGrad.
"""

from __future__ import annotations

import numpy as np

from .constraints import MonotoneWeights

# The 8 neighbours of a pixel (dy, dx), in row order.
NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


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


def form(profile, amplitude, latent, taps):
    """S = profile + amplitude o K z."""
    return profile + amplitude * blur(latent, taps)


def latent_gradient(d_morph, morph, amplitude, latent, taps):
    """dL/dz = K (amplitude o dS where S > 0) + z."""
    return blur(np.where(morph > 0, amplitude * d_morph, 0), taps) + latent


def amsgrad(gradient, moments, i_step, *, beta1=0.9, beta2=0.999, epsilon=1e-8):
    """Direction of step i_step = 1, 2, ..., x <- x - rate direction, and the moments (m, v, h)."""
    m, v, h = moments
    m = beta1 * m + (1 - beta1) * gradient
    v = beta2 * v + (1 - beta2) * gradient**2
    h = np.maximum(h, v)
    size = np.sqrt(h / (1 - beta2**i_step)) + epsilon
    return m / (1 - beta1**i_step) / size, (m, v, h)


def positivity(x):
    """The projection onto x >= 0: max(x, 0)."""
    return np.where(x < 0, x.dtype.type(0), x)


def l1(x, threshold):
    """Soft threshold, the prox of threshold * sum |x|: sign(x) max(|x| - threshold, 0)."""
    return (np.sign(x) * np.maximum(np.abs(x) - threshold, 0)).astype(x.dtype)


def l0(x, threshold):
    """Hard threshold, the prox of threshold * (number of x != 0): 0 where x^2 <= 2 threshold."""
    return np.where(x * x <= 2 * threshold, x.dtype.type(0), x)


def max_norm(x):
    """x / max(x) and max(x); x itself and 1 where the maximum is not positive."""
    scale = x.max()
    return (x / scale, scale) if scale > 0 else (x.copy(), x.dtype.type(1))


def sum_norm(x):
    """x / sum(x) and sum(x); x itself and 1 where the sum is not positive."""
    scale = x.sum(dtype=np.float64)
    return ((x / scale).astype(x.dtype), scale) if scale > 0 else (x.copy(), 1.0)


def symmetry(x, center, strength=1.0):
    """Towards the mirror image about a pixel: x - strength (x - x_mirror) / 2.

    strength 1 is the projection onto symmetric images; 0 changes nothing; between, it is the prox
    of k/2 |antisymmetric part|^2 with strength = k / (1 + k). A pixel whose mirror is outside the
    box is left alone.
    """
    out = x.copy()
    (ny, nx), (cy, cx) = x.shape, center
    ry, rx = min(cy, ny - 1 - cy), min(cx, nx - 1 - cx)
    part = out[cy - ry : cy + ry + 1, cx - rx : cx + rx + 1]
    part -= (x.dtype.type(0.5 * strength) * (part - part[::-1, ::-1])).astype(x.dtype)
    return out


def monotone_weights(shape, center, weights=MonotoneWeights.ANGLE):
    """Weights w (8, Ny, Nx) of the neighbours (order NEIGHBOURS) that are nearer to the centre.

    weights: one of MonotoneWeights
    They sum to 1 over the neighbours inside the image, to 0 at the centre.
    """
    y = np.arange(shape[0])[:, None] - center[0]
    x = np.arange(shape[1])[None, :] - center[1]
    w = np.zeros((8, *shape))
    for i_way, (dy, dx) in enumerate(NEIGHBOURS):
        to_y, to_x = y + dy + center[0], x + dx + center[1]
        inside = (to_y >= 0) & (to_y < shape[0]) & (to_x >= 0) & (to_x < shape[1])
        nearer = (y + dy) ** 2 + (x + dx) ** 2 < y**2 + x**2
        # The way to the centre has the same length for all 8, so it drops out of the normalisation.
        cosine = -(dy * y + dx * x) / np.hypot(dy, dx)
        w[i_way] = np.where(inside & nearer, 1.0 if weights == MonotoneWeights.FLAT else cosine, 0)
    if weights == MonotoneWeights.NEAREST:
        w = np.where((w > 0) & (np.arange(8)[:, None, None] == w.argmax(0)), 1.0, 0)
    total = w.sum(0)
    return w / np.where(total > 0, total, 1)


def monotone_sweep(x, center, weights=MonotoneWeights.ANGLE, gradient=0.0):
    """Outward from the centre, one pixel after the other: x_i <- min(x_i, (1-g) sum_j w_ij x_j).

    A heuristic, not a projection: it only ever lowers pixels, and its answer is monotone.
    """
    w = monotone_weights(x.shape, center, weights).astype(x.dtype)
    keep = x.dtype.type(1 - gradient)
    out = x.copy()
    y, x_ = np.indices(x.shape)
    distance = (y - center[0]) ** 2 + (x_ - center[1]) ** 2
    for i_pixel in np.argsort(distance, axis=None, kind="stable")[1:]:
        iy, ix = divmod(int(i_pixel), x.shape[1])
        mean = x.dtype.type(0)
        for weight, (dy, dx) in zip(w[:, iy, ix], NEIGHBOURS, strict=True):
            if weight > 0:
                mean += weight * out[iy + dy, ix + dx]
        out[iy, ix] = min(out[iy, ix], keep * mean)
    return out


def monotone_violation(x, center, weights=MonotoneWeights.ANGLE, gradient=0.0):
    """x_i - (1-g) sum_j w_ij x_j (Ny, Nx) float64, 0 at the centre: positive where too high."""
    w = monotone_weights(x.shape, center, weights) * (1 - gradient)
    out = np.asarray(x, float) - sum(wi * _ahead(x, way) for wi, way in zip(w, NEIGHBOURS))
    out[tuple(center)] = 0
    return out


def _ahead(x, way):
    """x at i + way, 0 outside."""
    dy, dx = way
    padded = np.pad(x, 1)
    return padded[1 + dy : 1 + dy + x.shape[0], 1 + dx : 1 + dx + x.shape[1]]
