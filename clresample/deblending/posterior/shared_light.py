"""Errors of fluxes from what a fit assumes of the division of light between neighbours.

Two assumptions decide it where the data do not, and neither is an unknown of the normal matrix.

The start holds the shape of a faint galaxy beside a bright one to the expected one, as far as the
light of the bright one may be wrong (start/population.py, a factor of contamination). The fit's
structure repairs little of it. So the data know that shape with 1 / factor of their precision,

    cov(flux) += G (C' - C) G^T,   G = cov(flux, theta) C^-1,   C'^-1 = 1 + (C^-1 - 1) / factor

C: posterior covariance of its shape parameters theta, whose prior covariance is 1.

Structure of a source where another one has its light may be that one's. It is decided by how either
profile fits, and is as uncertain as it is large: of component t at the place of profile p,

    e = A_t <p, S_t - P S_t> sum p / <p, p - P p>,
    P v = p_t <v, p_t>_r / <p_t, p_t>_r   in each ring r between two isophotes of p_t,

or that of one ring, all of the image, where that is more, moves from one source to the other, all
light of t at most. Light of t's own may have another scale, in each ring or as a whole, so that
only what p has off it can be p's. If the shape of p is doubted, p is drawn larger by one scatter of
its ln sigma under C': a profile that is too small fits its source's core, and structure of the
neighbour holds the ring around it. Without these two parts 2 in 100 satellites of giant galaxies
were over 5 % and 5 sigma off with no flag, and none of 32 with them; with p as it was fitted one of
96 has half of its flux and no flag (bench.ladder, seed 9191). With <p, p> alone as the divisor two
in three fluxes of galaxies 0.4 to 0.8 r_e apart, at signal to noise 3000, are over 3 errors off, by
up to 9; with the part of p off p_t it is one in forty (40 blends of cli/device_tools/workload.py).
With P of one ring the light of a satellite hides in what the giant's profile lacks all round: 1.2 %
of 972 fluxes of giants and satellites are over 3 errors off, by up to 7, one without a flag; with
the larger of both 0.5 %, by up to 4 (bench.ladder, seeds 1212, 7373, 9494). With rings alone two
giants in one another's light are 4 errors off (simulate field --sky bright --size 512).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.box import boxes_meet, intersect_boxes
from ..profiles import GalaxyProfile, StarProfile
from ..start.population import contamination_factors
from .errors import FluxChanges
from .profile_modes import SCATTER, SHAPE_MODES

# Least variance of a parameter under the posterior: a smaller one is rounding.
MIN_VARIANCE = 1e-12
# Width of a ring in the logarithm of its profile, some 20 % of the radius in a galaxy's wings; and
# the level, relative to the profile's peak, below which all pixels are one ring.
RING_STEP, MIN_LEVEL = 0.5, 1e-6
# Part of its flux by which the doubt of a component's shape moves that at most: farther away fluxes
# do not follow the slopes, and what gets twice as large as expected is seen.
MAX_DOUBT = 0.5


@dataclass(frozen=True, eq=False)
class DoubtedShape:
    """C and C' (4, 4) of a component's shape parameters, C as eigenvalues and vectors; see above.

    modes (4,): which of its unknowns these are
    """

    variance: np.ndarray
    doubted: np.ndarray
    axes: np.ndarray
    modes: np.ndarray

    @classmethod
    def of(cls, known, factor, modes):
        """From C (4, 4) and the factor of contamination."""
        variance, axes = np.linalg.eigh(known)
        variance = np.clip(variance, MIN_VARIANCE, 1)
        return cls(variance, 1 / (1 + (1 / variance - 1) / factor), axes, modes)

    @property
    def added_root(self):
        """C^-1 times a root (4, 4) of C' - C."""
        return self.axes * (np.sqrt(np.maximum(self.doubted - self.variance, 0)) / self.variance)

    @property
    def size_scatter(self):
        """Scatter of ln sigma under C'."""
        return SCATTER[0] * np.sqrt(np.square(self.axes[0]) @ self.doubted)


def doubted_shapes(posterior) -> dict[int, DoubtedShape]:
    """The DoubtedShape of each component of a galaxy whose neighbours contaminate its shape."""
    factors, found = _contamination(posterior), {}
    for i, (shape, factor) in enumerate(zip(posterior.solution.shapes, factors, strict=True)):
        if isinstance(shape, GalaxyProfile) and factor > 1:
            modes = posterior.layout.n_modes[i] + SHAPE_MODES
            known = posterior.covariance.block(i, i)[modes[:, None], modes]
            found[i] = DoubtedShape.of(known, factor, modes)
    return found


def flux_doubts(posterior, shapes, owner, n_sources) -> np.ndarray:
    """Changes (S, C, k) of fluxes, in units of the spectra, by independent errors of shapes.

    shapes: of `doubted_shapes`; owner (n,): source of each component
    """
    layout, solution = posterior.layout, posterior.solution
    if not shapes:
        return np.zeros((n_sources, layout.n_channels, 0))
    at = {i: shape.modes for i, shape in shapes.items()}
    column = {i: 4 * k + np.arange(4) for k, i in enumerate(shapes)}
    slopes = posterior.flux_slopes
    out = np.zeros((n_sources, layout.n_channels, 4 * len(shapes)))
    for (i, j), block in posterior.covariance.items():
        if j == layout.common:
            continue
        if j in at:
            out[owner[i]][:, column[j]] += slopes[i] @ block[:, at[j]]
        if i in at and i != j:
            out[owner[j]][:, column[i]] += slopes[j] @ block[at[i]].T
    for i, shape in shapes.items():
        moved = out[..., column[i]] @ shape.added_root
        own = float(np.linalg.norm(solution.spectra[i] * slopes[i][0, layout.n_modes[i]]))
        most = MAX_DOUBT * own / max(float(np.linalg.norm(moved[owner[i]])), 1e-30)
        out[..., column[i]] = min(1.0, most) * moved
    return out


def _contamination(posterior):
    """Factors (n,) by which the start would doubt the components' shapes where they are now."""
    layout, solution = posterior.layout, posterior.solution
    n, n_bands = len(layout.n_modes), layout.n_spectra
    normal, bands = np.zeros((1, n_bands, n, n)), np.arange(n_bands)
    for (i, j), block in posterior.matrix.items():
        if j != layout.common:
            shared = block[layout.n_modes[i] + bands, layout.n_modes[j] + bands]
            normal[0, :, i, j] = normal[0, :, j, i] = shared
    spectra = solution.spectra if layout.ties is None else solution.spectra[:, layout.ties.first]
    stars = np.array([isinstance(shape, StarProfile) for shape in solution.shapes])
    source = np.asarray(solution.source)
    return contamination_factors(normal, spectra.T[None], source[None], stars[None])[0]


def exchanged_light(result, solution, shapes) -> np.ndarray:
    """Light (S, S, C) [counts] of structure of the second source at the place of the first.

    solution: Solution of the finished fit; shapes: of `doubted_shapes`
    """
    components, n_sources = result.components, len(result.sources)
    scene, source = solution.scene, solution.source
    out = np.zeros((n_sources, n_sources, len(result.channels)))
    low, high = scene.origin, scene.origin + [p.shape for p in scene.profile]
    meet = boxes_meet(low[:, None], high[:, None], low, high)
    meet &= (source[:, None] != source) & ~scene.fixed
    rings = {j: _isophotes(scene.profile[j]) for j in np.flatnonzero(meet.any(axis=0))}
    structure = {j: [r.without(components[j].morphology) for r in rings[j]] for j in rings}
    for i in np.flatnonzero(meet.any(axis=1)):
        p = scene.profile[i]
        if i in shapes:
            p = _larger_profile(solution, i, shapes[i].size_scatter)
        power = np.square(p).sum()
        for j in np.flatnonzero(meet[i]):
            here, there = intersect_boxes(low[i], p.shape, low[j], scene.profile[j].shape)
            most, found = components[j].morphology.sum(), []
            for some, rest in zip(rings[j], structure[j], strict=True):
                off = power - some.power_within(p[here], there)
                found.append((p[here] * rest[there]).sum() / max(off, 1e-30))
            part = np.clip(p.sum() * max(found, key=abs), -most, most)
            out[components[i].source, components[j].source] += part * components[j].spectrum
    return out


def _isophotes(profile):
    """The _Isophotes of a profile (ny, nx) as one ring, and in rings of RING_STEP."""
    depth = np.log(profile.max() / np.maximum(profile, MIN_LEVEL * profile.max()))
    rings = np.zeros(depth.shape, int), (depth / RING_STEP).astype(int)
    return [_Isophotes(profile, ring) for ring in rings]


class _Isophotes:
    """Rings of a profile (ny, nx), by number, and projections P on it."""

    def __init__(self, profile, ring):
        self.profile, self.ring = profile, ring
        self.power = np.bincount(self.ring.ravel(), np.square(profile).ravel())
        self.power = np.maximum(self.power, 1e-30)

    def without(self, image):
        """An image (ny, nx) less its projection."""
        share = np.bincount(self.ring.ravel(), (image * self.profile).ravel())
        return image - self.profile * (share / self.power)[self.ring]

    def power_within(self, image, there):
        """Squared norm of the projection of an image of the pixels `there` (2 slices)."""
        weights = (image * self.profile[there]).ravel()
        share = np.bincount(self.ring[there].ravel(), weights, len(self.power))
        return float((np.square(share) / self.power).sum())


def _larger_profile(solution, i, growth):
    """Profile of a component in its box, larger by `growth` in ln sigma."""
    theta, scene = solution.thetas[i].copy(), solution.scene
    theta[0] += growth
    place = solution.positions[i], scene.origin[i], scene.profile[i].shape
    return solution.shapes[i].draw_box(theta, *place, slopes=False)[0]


def flux_changes(doubts, exchanged, own):
    """The FluxChanges of light that may be another source's, or lost; None without any.

    doubts (S, C, k) [counts]: changes of fluxes of scatter 1, each independent of the others
    exchanged (S, S, C) [counts]: see `exchanged_light`; what one source gains the other loses
    own (m, S, C) [counts]: independent changes, of scatter 1, of each source's fluxes alone
    """
    source, doubt = np.nonzero(doubts.any(axis=1))
    giver, taker = np.nonzero(exchanged.any(axis=2))
    part, lone = np.nonzero(own.any(axis=2))
    if not len(source) + len(giver) + len(lone):
        return None
    pairs, light = doubts.shape[2] + np.arange(len(giver)), exchanged[giver, taker]
    alone = doubts.shape[2] + len(giver) + np.arange(len(lone))
    return FluxChanges(
        np.concatenate([source, giver, taker, lone]),
        np.unique(np.concatenate([doubt, pairs, pairs, alone]), return_inverse=True)[1],
        np.concatenate([doubts[source, :, doubt], light, -light, own[part, lone]]),
    )
