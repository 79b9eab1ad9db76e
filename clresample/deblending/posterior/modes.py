"""A fitted scene, and all modes of its components: what their morphologies may still be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...sky.extent import shared_part
from ..solver.learned.prior import LearnedPrior
from ..solver.scene import Scene
from .bumps import Bumps, uncorrelated
from .profile_modes import profile_modes

# Bumps that the prior allows to change a flux or a second moment by less than this many errors at
# fixed morphologies are left out.
LEAST_CHANGE = 1.0
# Light is exchanged where a neighbour has more than this part of the source's own, and both more
# than FAINT of a pixel's noise.
RATIO, FAINT = 0.05, 0.3
# The prior's scale next to STRUCTURE_PX is given the strength that the source's own data show,
# under a weak hyperprior of WEIGHT pixels about STRENGTH, that of simulated parametric galaxies.
# The fit's own is held near its centre, twice as large, with which positions (0.80 in 68 %
# intervals) and ellipticities (0.74) are over-covered.
STRUCTURE_PX, WEIGHT, STRENGTH = 2.0, 10.0, 0.05
# Powers of that strength, over STRENGTH, with which the other scales, the core and the halo of a
# profile, and Settings.flux_floor go: what is unlike a smooth profile at one scale is so at all.
# Parametric galaxies have 1 and hardly notice; real ones of COSMOS, which have 2 (a quarter of
# them 3), gain 0.03 in the coverage of fluxes by the first, and 0.05 by the second.
OTHERS, FLOOR = 1.5, 2.0


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted scene, n components, C channels, in units of the views' noise.

    scene: Scene; morphs (n): arrays (ny, nx) with max = 1; peaks (n,): of the solver's
        morphologies, by which those were divided
    spectra (n, C); fixed_error (n, C): of these at fixed morphologies
    shapes, thetas, positions (n): the start's Shapes, parameters, places (2,) [px]
    findings: Findings; chi2 (n,): per pixel, where each component's light is
    prior: LearnedPrior
    """

    scene: Scene
    morphs: list
    peaks: np.ndarray
    spectra: np.ndarray
    fixed_error: np.ndarray
    shapes: list
    thetas: list
    positions: np.ndarray
    findings: object
    chi2: np.ndarray
    prior: LearnedPrior

    def unlikeness(self, i):
        """Strength of component i's structure over that of a galaxy that is like its smooth
        profile, see STRENGTH; 1 of fixed ones."""
        if self.scene.fixed[i]:
            return 1.0
        found, j = self.findings, self._scale
        wanted = found.energies[i, j] / max(self.chi2[i], 1) + WEIGHT * STRENGTH**2
        return np.sqrt(wanted / (found.determined[i, j] + WEIGHT)) / STRENGTH

    @cached_property
    def _scale(self):
        """Which of the prior's scales is STRUCTURE_PX."""
        return np.argmin(np.abs(np.log(np.array(self.prior.scales_px) / STRUCTURE_PX)))

    def strengths(self, i):
        """Strengths (J,) of component i's structure; see STRUCTURE_PX."""
        unlike = self.unlikeness(i)
        out = self.findings.strengths[i] * unlike**OTHERS
        out[self._scale] = unlike * STRENGTH
        return out

    def modes(self, i):
        """Modes (k, ny, nx) of component i, whose coefficients the prior expects to scatter by 1,
        each on its own; and its Beyond."""
        profile, scene = self.scene.profile[i], self.scene
        images, scatter, far = profile_modes(
            self.shapes[i],
            self.thetas[i],
            self.positions[i],
            profile,
            scene.origin[i],
            radial=self.unlikeness(i) ** OTHERS,
        )
        images = scatter[:, None, None] * images
        far = far.scaled(np.append(1, scatter) / self.peaks[i])
        if not scene.fixed[i]:
            bumps = Bumps(
                scene.origin[i], profile, self.strengths(i), self.prior.kernels(), self._shared(i)
            )
            keep = self._change(i, bumps.images) > LEAST_CHANGE
            own = uncorrelated(bumps.images[keep], bumps.precision[np.ix_(keep, keep)])
            images = np.concatenate([own, images])
        images, along = self._gauged(i, images)
        return images / self.peaks[i], far.gauged(along)

    def _gauged(self, i, images):
        """Images without what lies along the profile, 0 where the morphology is at its bound; and
        how much lay along it (k,)."""
        p = self.scene.profile[i]
        along = np.tensordot(images, p, 2) / max((p * p).sum(), 1e-30)
        images = images - along[:, None, None] * p
        return images if self.scene.fixed[i] else np.where(self.morphs[i] > 0, images, 0), along

    def _change(self, i, images):
        """What images (k, ny, nx) of scatter 1 change of flux and second moment [fixed errors]."""
        m = self.morphs[i] * self.peaks[i]
        total = max(m.sum(), 1e-30)
        y, x = np.indices(m.shape)
        r2 = (y - (y * m).sum() / total) ** 2 + (x - (x * m).sum() / total) ** 2
        weight = 1 + r2 / max((r2 * m).sum() / total, 1e-9)
        significance = np.linalg.norm(self.spectra[i] / self.fixed_error[i])
        return np.abs(np.tensordot(images, weight, 2)) / total * significance

    def _light(self, j, i):
        """Expected light of component j on i's box, all channels in quadrature [noise]."""
        profile, out = self.scene.profile[j], np.zeros(self.scene.profile[i].shape)
        here, there = shared_part(
            self.scene.origin[i], out.shape, self.scene.origin[j], profile.shape
        )
        out[here] = np.linalg.norm(self.spectra[j]) / self.peaks[j] * profile[there]
        return out

    @cached_property
    def _boxes(self):
        """First and one-past-last pixels (n, 2), (n, 2) of all boxes."""
        return self.scene.origin, self.scene.origin + [p.shape for p in self.scene.profile]

    def _shared(self, i):
        """Where (ny, nx) component i may exchange light with another."""
        own, (low, high) = self._light(i, i), self._boxes
        shared = np.zeros(own.shape, bool)
        for j in np.flatnonzero(((low < high[i]) & (high > low[i])).all(1)):
            if j != i:
                other = self._light(j, i)
                shared |= (other > RATIO * own) & (other > FAINT) & (own > FAINT)
        return shared
