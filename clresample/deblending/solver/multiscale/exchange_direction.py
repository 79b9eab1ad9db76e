"""Changes by which a source's structure takes over a neighbour's light, at the same colour.

The model sum_s A_s S_s hardly changes if S_i gains S_j and A_j loses A_i: the prior alone resists.
The blocks of inverse.py and the curvatures of the spectra contain one source's light each, so that
they allow steps far too short for such a change, and L-BFGS takes hundreds of iterations for it:
from one start, a fit of HST and HSC (hst_hsc of bench.real) takes over 930 without and 330 with
these directions. The direction d with u = S_j of the smallest |z|^2 / alpha^2, and the spectra that
fit it, has an inverse curvature of its own, d d^T / (d^T H d), which is added to that of the
blocks. A spectrum that is nearly 0 cannot fall, and then the data of its channel resist too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ....sky.box import Box, boxes_meet
from .inverse import seen_through
from .scale_direction import coefficients_of

# Smallest part of S_j's squared light that S_i can take over: in its box, and where it is not 0.
MIN_SHARED = 0.8
# Largest curvature along a direction, in units of that by the neighbour's spectrum alone: steeper
# ones leave the number of iterations as it is.
MAX_CURVATURE = 0.4
# Steps along a direction, each of which lowers the loss by 1/2 at most, for which a spectrum must
# suffice; it is held otherwise. With 0 steps end at the bound and are rejected, and that fit takes
# 440 iterations.
MIN_STEPS = 3.0


@dataclass(frozen=True, eq=False)
class ExchangeDirection:
    """The direction d of two of a scene's n sources, scaled to d^T H d = 1.

    source: the one whose structure changes
    places, values (k,): of coefficients among all of its, and their changes
    spectra (n, C): changes of both sources' spectra
    """

    source: int
    places: np.ndarray
    values: np.ndarray
    spectra: np.ndarray


def find_exchange_directions(scene, state, evidence, strengths):
    """The ExchangeDirections of one scene at a State.

    evidence (n): SourceEvidence, None of fixed sources; strengths (n, J)
    """
    boxes = [Box.at(low, m.shape) for low, m in zip(scene.origin, state.morph, strict=True)]
    low, shines = np.asarray(scene.origin), (state.spectra > 0).astype(np.float32)
    high = low + [m.shape for m in state.morph]
    meet = boxes_meet(low[:, None], high[:, None], low, high)
    meet &= (shines @ shines.T > 0) & ~np.eye(len(low), dtype=bool) & ~scene.fixed[:, None]
    pairs = np.argwhere(meet).tolist()
    found = [_direction(scene, state, boxes, pair, evidence, strengths) for pair in pairs]
    return [direction for direction in found if direction is not None]


def _direction(scene, state, boxes, pair, evidence, strengths):
    """The ExchangeDirection of a pair (i, j) of sources, None if it is steep."""
    (i, j), (evidence, alpha) = pair, (evidence[pair[0]], strengths[pair[0]])
    prior, profile, spectrum = evidence.prior, scene.profile[i].astype(np.float32), state.spectra[i]
    box = boxes[j].grown(max(prior.radii)).intersection(boxes[i])
    window = box.relative_to(boxes[i]).slices
    p, own, theirs = profile[window], state.morph[i][window], state.morph[j].astype(np.float32)
    light, shared = np.zeros_like(p), box.intersection(boxes[j])
    light[shared.relative_to(box).slices] = theirs[shared.relative_to(boxes[j]).slices]
    wanted = np.where(own > 0, light, 0)
    power = np.square(spectrum)
    alone = (power * scene.spectrum_curvature[j]).sum()
    # the prior's term is at least that of light as wide as the widest kernel
    widest = (np.square(alpha * prior.scales_px) * 4 * np.pi).sum()
    squares = np.square(wanted, dtype=float)  # over the faintest p of float32 they are large
    least = np.divide(squares, p, where=p > 0, out=np.zeros(p.shape)).sum() / widest
    if (wanted**2).sum() < MIN_SHARED * (theirs**2).sum() or least > MAX_CURVATURE * alone:
        return None
    z, u = coefficients_of(prior, profile, wanted, alpha, window)
    part = (p * u).sum() / (profile * profile).sum()
    change = np.where(own > 0, u - part * (p - own), 0)
    fraction = (change * light).sum() / max((light * light).sum(), 1e-30)
    by_prior = sum((a**2).sum() / s**2 for a, s in zip(z, alpha, strict=True))

    def curvature_with(falls):
        total = by_prior
        for which, left in ((falls, change - fraction * light), (~falls, change)):
            if spectrum[which].any():
                sharpness = evidence.sharpness(np.where(which, spectrum, 0))
                total += max(seen_through(sharpness, left[None], 1)[0] @ left.ravel(), 0)
        return total

    shines = state.spectra[j] > 0
    curvature = curvature_with(shines)
    falls = shines & (state.spectra[j] > MIN_STEPS * fraction * spectrum / np.sqrt(curvature))
    if (falls != shines).any():
        curvature = curvature_with(falls)
    if not falls.any() or curvature > MAX_CURVATURE * alone:
        return None
    spectra = np.zeros_like(state.spectra)
    spectra[i], spectra[j] = part * spectrum, -fraction * np.where(falls, spectrum, 0)
    values = np.concatenate([a.ravel() for a in z])
    places, scale = np.flatnonzero(values), 1 / np.sqrt(curvature)
    return ExchangeDirection(i, places, values[places] * scale, spectra * scale)
