"""A fitted scene and the modes along which its morphologies can vary under the prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.blas import strmm

from ...sky.box import boxes_meet, intersect_boxes
from ..linear.mode_images import CellImages, ModeImages, cell_sums, subtract, sums_with
from ..solver.multiscale.prior import MultiscalePrior
from ..solver.scene import Scene
from ..view import flush_faint
from .profile_modes import profile_modes
from .smooth_modes import MIN_LIGHT, SmoothModes, whitening_transform

# Modes whose prior scatter changes a flux or a second moment by less than this many errors at fixed
# morphologies are left out.
MIN_CHANGE = 1.0
# [noise] Bumps whose light is nowhere above this, or above smooth_modes.MIN_LIGHT of the source's
# peak if that is less, are left out too. With MIN_LIGHT alone the wings of galaxies above signal to
# noise 1000 have no bumps, and the bias from the bound of morphologies at 0 remains in their sizes,
# one error or 0.2 %, and in their fluxes, half an error.
FAINTEST = 1e-3
# [noise] For errors, two sources overlap in a pixel if both have more light than this: a faint
# galaxy's flux is as uncertain as the fine structure of the bright one on which it lies. With the
# overlaps of joint_step.py only, the coverage of fluxes of Euclid alone is 0.02 lower below signal
# to noise 10 and above 300 (400 scenes, seeds from 60000 and 61000).
FAINT = 0.05
# For errors, the strength of the prior's scale nearest to STRUCTURE_PX follows the source's own
# data, with a weak hyperprior of WEIGHT pixels about STRENGTH, the value of simulated parametric
# galaxies. The fit's own strength stays near the centre of its prior, which is twice as large. With
# it, positions (0.80 in 68 % intervals) and ellipticities (0.74) would be over-covered.
STRUCTURE_PX, WEIGHT, STRENGTH = 2.0, 10.0, 0.05
# Exponents of the ratio of that strength to STRENGTH, by which the other scales, the core and the
# halo of a profile, and Settings.flux_error_floor are scaled: a galaxy that departs from a smooth
# profile at one scale does so at all. Parametric galaxies have ratios of 0.7 to 1.1 and are hardly
# affected; real ones of COSMOS have 2, a quarter of them 3. With STRENGTH_EXPONENT = 3.5 and
# HALO = 0.01 their errors equal those with 2.5 and 0.02. With 1.5 and 0.02 the coverage of their
# sizes, and of fluxes from signal to noise 10 to 100, is 0.04 lower.
STRENGTH_EXPONENT, FLOOR_EXPONENT = 3.5, 3.0
# Strengths of overlapping sources are estimated from ambiguous light, and are too small. For errors
# they are multiplied by OVERLAPPED if the fraction MAX_OVERLAPPED of the light, or more, belongs to
# other sources, and by proportionally less for smaller fractions. With 1.5 joint fits have 76 % of
# positions in 68 % intervals (seeds 20400 to 20459; without, 73 %). 0.1 more adds 0.005 to the
# coverage of fluxes and positions (200 scenes each, joint and of Euclid, seeds from 50000).
OVERLAPPED, MAX_OVERLAPPED = 1.2, 0.2
# Largest ratio used for these powers: a merger of real galaxies reaches 10, which would give an
# error floor of half its flux.
MAX_STRUCTURE_EXCESS = 3.0


def clipped_power(unlikeness, exponent):
    """Structure excess to the power of an exponent, limited by MAX_STRUCTURE_EXCESS."""
    return min(unlikeness, MAX_STRUCTURE_EXCESS) ** exponent


def _unlike(energy, determined):
    """Structure excess from |z|^2 and the number of determined coefficients."""
    return np.sqrt((energy + WEIGHT * STRENGTH**2) / (determined + WEIGHT)) / STRENGTH


def overlap_inflation(own, others):
    """Factor on strengths where the light of other sources overlaps a source's own.

    Both (ny, nx) as expected; see OVERLAPPED.
    """
    own, others = np.maximum(own, 0), np.maximum(others, 0)
    shared = (own * others / np.maximum(own + others, 1e-30)).sum() / max(own.sum(), 1e-30)
    return 1 + (OVERLAPPED - 1) * min(1, shared / MAX_OVERLAPPED)


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted scene, n components, C channels, in units of the views' noise.

    scene: Scene; morphs (n): arrays (ny, nx) with max = 1; peaks (n,): of the solver's
        morphologies, by which those were divided
    spectra (n, C); fixed_error (n, C): of these at fixed morphologies
    shapes, thetas, positions (n): the start's ComponentProfiles, parameters, places (2,) [px]
    source (n,): to which each component belongs
    findings: StrengthEstimates; chi2 (n,): per pixel, in each component's light
    prior: MultiscalePrior
    negative_chi2_gradient (n): arrays (ny, nx), see bound_bias.py; None if `modes` is not called
    held (n, C): see RenderedModel; None likewise
    """

    scene: Scene
    morphs: list
    peaks: np.ndarray
    spectra: np.ndarray
    fixed_error: np.ndarray
    shapes: list
    thetas: list
    positions: np.ndarray
    source: np.ndarray
    findings: object
    chi2: np.ndarray
    prior: MultiscalePrior
    negative_chi2_gradient: list | None = None
    held: np.ndarray | None = None

    def structure_excess(self, i):
        """Strength of component i's structure over that of a galaxy like its smooth profile.

        See STRENGTH; 1 for fixed components. It is divided by chi2 per pixel, so that misfit does
        not count as structure, but not to less than 1.
        """
        if self.scene.fixed[i]:
            return 1.0
        energy, known = (
            a[i, self._scale] for a in (self.findings.energies, self.findings.n_effective)
        )
        return max(_unlike(energy / max(self.chi2[i], 1), known), min(_unlike(energy, known), 1.0))

    @cached_property
    def _scale(self):
        """Index of the prior's scale STRUCTURE_PX."""
        return np.argmin(np.abs(np.log(np.array(self.prior.scales_px) / STRUCTURE_PX)))

    def strengths(self, i):
        """Strengths (J,) of component i's structure; see STRUCTURE_PX and OVERLAPPED."""
        unlike = self.structure_excess(i)
        out = self.findings.strengths[i] * clipped_power(unlike, STRENGTH_EXPONENT)
        out[self._scale] = unlike * STRENGTH
        own, beside = self._lights(i)
        others = [light for j, light in beside if self.source[j] != self.source[i]]
        return out * overlap_inflation(own, sum(others))

    def modes(self, i):
        """Images, float32, of component i's morphology and of its modes.

        returns images (1 + k, ny, nx) of the morphology and its modes, without smooth ones on wide
            pixels; its modes (k, ny, nx), an array or ModeImages; `light_sums` (6, 1 + k) of the
            smooth profile beyond the box, and of its changes by the modes; and the data's gradient
            by each mode (k,) from pixels on the bound at 0

        Under the prior the modes' coefficients are independent with unit variance.
        """
        profile, scene = self.scene.profile[i], self.scene
        images, scatter, far = profile_modes(
            self.shapes[i],
            self.thetas[i],
            self.positions[i],
            profile,
            scene.origin[i],
            radial=clipped_power(self.structure_excess(i), STRENGTH_EXPONENT),
        )
        scatter = scatter / self.peaks[i]
        far *= np.append(1 / self.peaks[i], scatter)
        parts, smooth = [], []
        if not scene.fixed[i]:
            strengths, kernels = self.strengths(i), self.prior.kernels()
            least = min(MIN_LIGHT, FAINTEST / max(self._peaks[i], 1e-30))
            given = scene.origin[i], profile, strengths, kernels, self.overlap_mask(i)
            parts = self._smooth_modes(i, SmoothModes(*given, least_light=least))
            smooth = [CellImages(*part) for part in parts if part[1] > 1]
        sharp = [own for own, pixel in parts if pixel == 1]
        sharp.append(flush_faint(scatter[:, None, None] * images).astype(np.float32))
        seen = np.concatenate([flush_faint(self.morphs[i].copy())[None], *sharp], dtype=np.float32)
        modes = ModeImages(tuple(smooth), seen[1:]) if smooth else seen[1:]
        beyond = gauged(far, self.along(i, modes) * self.peaks[i])
        return seen, modes, beyond, self._held(i, modes)

    def _smooth_modes(self, i, bumps):
        """Independent combinations of smooth modes, [(images (k, my, mx), pixel)], see SmoothModes.

        Those of wider ones come first, on their own pixels.
        """
        widths = bumps.widths()
        images = [bumps.images(pixel, last) for _, last, pixel in widths]
        pairs = list(zip(widths, images, strict=True))
        change = [self.flux_change_sigma(i, own[first:], pixel) for (first, _, pixel), own in pairs]
        keep = np.flatnonzero(np.concatenate(change) > MIN_CHANGE)
        weights = whitening_transform(bumps.precision[np.ix_(keep, keep)]) / self.peaks[i]
        found = []
        for (first, last, pixel), own in pairs:
            a, b = np.searchsorted(keep, (first, last))
            found.append((_combined(own, keep[:b], weights[a:b, :b]), pixel))
        return found

    def remove_profile_part(self, i, images):
        """Subtracts the profile's part from images, in place; returns the parts (k,).

        Images are 0 where the morphology is at its bound.
        """
        along, inside = self.along(i, images), self.morphs[i] > 0
        if not self.scene.fixed[i] and not inside.all():
            images *= inside
        return along

    def along(self, i, images):
        """Subtracts from images, in place, their projection on the profile; returns it (k,)."""
        p = flush_faint(self.scene.profile[i].astype(images.dtype))
        along = sums_with(images, p[None])[0] / max((p * p).sum(), 1e-30)
        subtract(images, along, p)
        return along.astype(np.float64)

    def _held(self, i, images):
        """Data gradient (k,) by images (k, ny, nx), from pixels where the morphology is at 0."""
        held = self.morphs[i] <= 0
        if self.scene.fixed[i] or not held.any():
            return np.zeros(len(images))
        gradient = np.where(held, self.negative_chi2_gradient[i], 0)
        return sums_with(images, gradient[None])[0].astype(np.float64)

    def flux_change_sigma(self, i, images, pixel=1):
        """Change of flux and second moment [fixed errors] by images (k, ny, nx) of scatter 1.

        pixel: of the images, see SmoothModes
        """
        m = self.morphs[i] * self.peaks[i]
        sides, total = (m.sum(1), m.sum(0)), max(m.sum(), 1e-30)
        y2, x2 = (np.square((n := np.arange(len(side))) - n @ side / total) for side in sides)
        weight = 1 + (y2[:, None] + x2) / max((sides[0] @ y2 + sides[1] @ x2) / total, 1e-9)
        significance = np.linalg.norm(self.spectra[i] / self.fixed_error[i])
        weight = cell_sums(weight.astype(np.float32), pixel)
        return np.abs(sums_with(images, weight[None])[0]) / total * significance

    def _light(self, j, i):
        """Expected light of component j on i's box, all channels in quadrature [noise]."""
        profile, out = self.scene.profile[j], np.zeros(self.scene.profile[i].shape)
        here, there = intersect_boxes(
            self.scene.origin[i], out.shape, self.scene.origin[j], profile.shape
        )
        out[here] = self._peaks[j] * profile[there]
        return out

    @cached_property
    def _peaks(self):
        """Expected light (n,) where profiles are 1, all channels in quadrature [noise]."""
        return np.linalg.norm(self.spectra, axis=1) / self.peaks

    @cached_property
    def _boxes(self):
        """First and one-past-last pixels (n, 2), (n, 2) of all boxes."""
        return self.scene.origin, self.scene.origin + [p.shape for p in self.scene.profile]

    def overlap_mask(self, i, *, faint=FAINT, ratio=0.0):
        """Pixels (ny, nx) with source i and another source over `faint` [noise].

        The other source exceeds `ratio` times source i there.
        """
        own, beside = self._lights(i)
        shared = np.zeros(own.shape, bool)
        for _, other in beside:
            shared |= (other > ratio * own) & (other > faint) & (own > faint)
        return shared

    @cached_property
    def _last_lights(self):
        """{i: lights} of the component for which `_lights` was called last."""
        return {}

    def _lights(self, i):
        """Light (`_light`) on component i's box: its own, and [(j, light)] of others there."""
        if i not in self._last_lights:
            low, high = self._boxes
            meet = np.flatnonzero(boxes_meet(low, high, low[i], high[i]))
            beside = [(j, self._light(j, i)) for j in meet if j != i]
            self._last_lights.clear()
            self._last_lights[i] = self._light(i, i), beside
        return self._last_lights[i]


def gauged(sums, along):
    """Sums (6, 1 + k) of a profile and its modes, with more modes before these.

    `along` (1 + k + m,) times the profile was subtracted from the modes, those of more too.
    """
    more = np.zeros((6, len(along) + 1 - sums.shape[1]))
    out = np.concatenate([sums[:, :1], more, sums[:, 1:]], axis=1)
    out[:, 1:] -= np.outer(sums[:, 0], along)
    return out


def _combined(images, keep, weights):
    """Combinations (m, ny, nx) of the images `keep` (k,); weights (m, k), 0 above the diagonal."""
    weights = weights.astype(np.float32)
    if len(weights) < len(keep):
        of_all = np.zeros((len(weights), len(images)), np.float32)
        of_all[:, keep] = weights
        return np.tensordot(of_all, images, 1)
    out = images[keep]
    if len(keep):
        # the transpose, since BLAS counts rows first; in place
        strmm(1.0, weights.T, out.reshape(len(out), -1).T, side=1, overwrite_b=1)
    return out
