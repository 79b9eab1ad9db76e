"""A joint Newton step over smooth structure, spectra and sky of overlapping sources.

L-BFGS has the curvature of each source alone. Moving light between neighbours barely changes the
loss, yet can move their fluxes by more than their errors. Along the smooth changes from which
errors are computed (smooth_modes.py), the curvature of all sources together is one normal matrix,
which predicts the minimum and the gain.

The matrix ignores the bound S >= 0. Many wing pixels lie on that bound, and a step that lifts them
raises the loss. Three in four of the full steps are rejected on simulated scenes (133 of 180 in 120
scenes), nearly all in a bright blend of HSC, and a shortened step gains. Without any such step, a
fit of HST and HSC to a merger had a loss 50 higher after 500 iterations than with them after 250.
Steps that count what each pixel adds beyond its bound gain most of what they promise, and fits then
take 5 % fewer iterations, but as many core-seconds (72 scenes of bench.throughput).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..linear.aligned_observation import align_observations
from ..linear.block_matrix import BlockCholesky, BlockMatrix
from ..linear.normal import UnknownLayout, normal_matrix
from ..solver.multiscale.prior import kernel_rows
from ..view import flush_faint
from .modes import Solution
from .smooth_modes import SmoothModes, whitening_transform

# Sources overlap in a pixel if a neighbour has more than MIN_LIGHT_RATIO of the source's light, and
# both more than FAINT of the pixel's noise. Fainter light changes a fit too little to justify more
# unknowns.
MIN_LIGHT_RATIO, FAINT = 0.05, 0.3
# Modes whose prior scatter changes a flux or a second moment by less than this many errors at fixed
# morphologies are left out. With 1, as for errors, the losses of simulated scenes end 0.5 higher in
# the mean.
MIN_CHANGE = 0.3
# Largest number of modes of a component; for larger overlaps their spacing increases. With 400 the
# matrix of 18 galaxies in HST's pixels takes three times as long, and fits need as many iterations.
MAX_CHANGES = 100
MIN_POWER = 1e-30  # of a component in a channel that does not cover it
# Spectra whose precision is below this fraction of the best channel's are held fixed, because
# residual wings in their channel would change them by large factors. For such sky levels the slopes
# are set to 0, but their rows stay in the matrix, so that they still follow the structure.
MIN_RELATIVE_POWER = 1e-9


class JointNewtonStep:
    """The unknowns of a nearly converged scene, and their normal matrix.

    solution: Solution with the solver's own morphologies and spectra, its peaks 1
    shared (n): masks (ny, nx) of the pixels where each component overlaps others, see
        Solution.shared
    exposures: an AlignedObservation of each observation; fit_sky: True if sky levels are unknowns

    moves (n): each component's ComponentModes, None if it overlaps no other
    """

    def __init__(self, solution, shared, exposures, *, fit_sky=False):
        n_channels, pairs = solution.spectra.shape[1], []
        for i, (morph, where) in enumerate(zip(solution.morphs, shared, strict=True)):
            image = flush_faint(morph.astype(np.float32))[None]
            pairs.append(_moves(solution, i, where, image))
        self.moves = [moves for moves, _ in pairs]
        counts = np.array([len(images) - 1 for _, images in pairs])
        ties = solution.scene.ties
        self._layout = UnknownLayout(counts, n_channels, n_channels if fit_sky else 0, ties=ties)
        images = [images for _, images in pairs]
        self._matrix = normal_matrix(
            solution.scene, exposures, images, solution.spectra, self._layout
        )
        diagonal = [np.diag(self._matrix.block(i, i)) for i in range(len(self._layout.sizes))]
        power = np.array([d[k:] for k, d in zip(counts, diagonal, strict=False)])
        self._unseen = power <= MIN_RELATIVE_POWER * power.max()
        self._level = diagonal[-1] > MIN_RELATIVE_POWER * diagonal[-1].max() if fit_sky else None
        self._held = None

    def step(self, slopes):
        """The step to the minimum of all unknowns; slopes: SceneGradient of the loss.

        returns changes [i][j] (ny_j, nx_j) of the structure, None for components without overlap,
            (n, C) of the spectra, (C,) of the sky, and the predicted decrease of the loss

        Raises LinAlgError where the matrix is not positive definite.
        """
        layout, right = self._layout, []
        bound, by_spectra, ties = slopes.at_bound, slopes.spectra, layout.ties
        if ties is not None:
            bound, by_spectra = bound[:, ties.first], ties.total(by_spectra)
        bound = bound | self._unseen
        for i, moves in enumerate(self.moves):
            own = moves.slopes(slopes.structure[i]) if moves else np.zeros(0)
            right.append(-np.concatenate([own, np.where(bound[i], 0, by_spectra[i])]))
        if layout.n_sky:
            right.append(-np.where(self._level, slopes.sky, 0))
        found = self._factor(bound).solve(right)
        gain = 0.5 * sum(x @ r for x, r in zip(found, right, strict=True))
        own = list(zip(self.moves, layout.n_modes, found, strict=False))
        structure = [moves.structure(x[:k]) if moves else None for moves, k, x in own]
        sky = found[-1] if layout.n_sky else np.zeros_like(slopes.sky)
        spectra = np.array([x[k:] for _, k, x in own])
        return structure, spectra if ties is None else ties.spread(spectra), sky, gain

    def _factor(self, bound):
        """The BlockCholesky with the spectra `bound` (n, B) held; the last one stays."""
        if self._held is None or (self._held[0] != bound).any():
            self._held = (
                bound.copy(),
                BlockCholesky(_held(self._matrix, self._layout.n_modes, bound)),
            )
        return self._held[1]


@dataclass(frozen=True, eq=False)
class ComponentModes:
    """Smooth changes of one component's structure.

    Under the prior their coefficients (k,) are independent with unit variance.

    weights (k, m): of m bumps; rows (m, ny), columns (m, nx): whose products are these
    scale_kernels (J): pairs (ny_j, ny), (nx_j, nx), see prior.kernel_rows; variance (J,): of the
        structure
    """

    weights: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    scale_kernels: list
    variance: np.ndarray

    def slopes(self, gradients):
        """Slopes (k,) of the loss by the coefficients; gradients [j] (ny_j, nx_j): by z_j."""
        parts = zip(self.variance, self.scale_kernels, gradients, strict=True)
        image = sum(v * (y.T @ g @ x) for v, (y, x), g in parts)
        return self.weights @ ((self.rows @ image) * self.columns).sum(axis=1)

    def structure(self, coefficients):
        """Changes [j] (ny_j, nx_j) of z_j."""
        image = (self.rows * (coefficients @ self.weights)[:, None]).T @ self.columns
        return [
            v * (y @ image @ x.T)
            for v, (y, x) in zip(self.variance, self.scale_kernels, strict=True)
        ]


def _moves(solution, i, shared, image):
    """Modes of component i and images (1 + k, ny, nx), float32, of its morphology and changes.

    morphology (1, ny, nx); None and the morphology alone if it overlaps no other.

    Modes cover the overlaps only: elsewhere L-BFGS converges by itself, and most modes of a large
    galaxy would be there.
    """
    scene, prior = solution.scene, solution.prior
    if scene.fixed[i] or not shared.any():
        return None, image
    profile, strengths = scene.profile[i], solution.findings.strengths[i]
    given = scene.origin[i], profile, strengths, prior.kernels(), shared
    bumps = SmoothModes(*given, all_over=False, most=MAX_CHANGES)
    images = bumps.images()
    keep = np.flatnonzero(solution.flux_change_sigma(i, images) > MIN_CHANGE)
    if not len(keep):
        return None, image
    weights = whitening_transform(bumps.precision[np.ix_(keep, keep)])
    changes = np.tensordot(weights.astype(np.float32), images[keep], 1)
    solution.remove_profile_part(i, changes)
    rows, columns = bumps.sides
    both = [tuple(kernel_rows(prior, j, n) for n in profile.shape) for j in range(len(strengths))]
    moves = ComponentModes(weights, rows[keep], columns[keep], both, np.square(strengths))
    return moves, np.concatenate([image, changes])


def _held(matrix, counts, bound):
    """Decouples the spectra `bound` (n, B) from all other unknowns, with a diagonal of 1.

    counts (n,): unknowns before a component's spectrum.
    """
    if not bound.any():
        return matrix
    held = {i: k + np.flatnonzero(b) for i, (k, b) in enumerate(zip(counts, bound, strict=True))}
    out = BlockMatrix(matrix.sizes)
    for (i, j), block in matrix.items():
        new = out.block(i, j)
        new[:] = block
        new[held.get(i, [])] = 0
        new[:, held.get(j, [])] = 0
        if i == j:
            new[held.get(i, []), held.get(i, [])] = 1
    return out


def make_joint_step(fit, scene, state, findings):
    """The JointNewtonStep of a Fit at a State of a Scene.

    None if no sources share light.
    """
    n = len(state.morph)
    solution = Solution(
        scene,
        [m.astype(float) for m in state.morph],
        np.ones(n),
        np.asarray(state.spectra),
        1 / np.sqrt(np.maximum(scene.spectrum_curvature, MIN_POWER)),
        fit.start.shapes,
        fit.start.thetas,
        fit.start.positions[fit.start.source],
        fit.start.source,
        findings,
        np.ones(n),
        fit.settings.prior,
    )
    shared = [solution.overlap_mask(i, faint=FAINT, ratio=MIN_LIGHT_RATIO) for i in range(n)]
    if not any(where.any() for where in shared):
        return None
    return JointNewtonStep(solution, shared, align_observations(fit), fit_sky=fit.settings.fit_sky)


def solve_joint_step(joint_step, slopes):
    """Step and gain of a JointNewtonStep; None, 0 if its matrix is not positive definite."""
    try:
        *step, gain = joint_step.step(slopes)
    except np.linalg.LinAlgError:
        return None, 0.0
    return step, gain
