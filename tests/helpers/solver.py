"""Scenes of random numbers for the tests of the solver, and its iteration in NumPy."""

from dataclasses import fields, replace

import numpy as np
import pytest

from clresample.deblending.solver import reference as loss_ref
from clresample.deblending.solver.scene_model import compose, gather_morph, gather_spectra
from clresample.paper.solver import reference as ref
from clresample.paper.solver.amsgrad import DAMPING, StepSizes
from clresample.paper.solver.constraints import Monotone, Positivity, ProxChain
from clresample.paper.solver.engine import Engine
from clresample.paper.solver.prior import SingleScalePrior
from clresample.paper.solver.scene import AmsgradScene, AmsgradState
from clresample.resampling.cache import cached_resampler
from clresample.sky.psf import PSF

from .scenes import BLURRED, SHARP, frame, grids

PRIOR = SingleScalePrior(strength=0.1, correlation_px=1.0)
STEPS = StepSizes(latent=0.05, morphology=0.01, spectrum=0.1)
# [relative to an array's largest value] a few hundred roundings: sums over pixels and frequencies
CLOSE = {np.float32: 1e-4, np.float64: 1e-12}
PSFS = PSF.gaussian(1.2, n_pixels=19), PSF.gaussian(0.9, n_pixels=15, n_bands=2)
KNOWN_SKY = 500.0, 0.0, 90.0  # precisions with which levels are expected to be 0
BOXES = ((2, 3, 11, 14), (0, 0, 9, 8), (19, 27, 11, 9), (29, 35, 1, 1), (4, 0, 7, 36))

every_type = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=lambda t: t.__name__)
with_and_without = pytest.mark.parametrize("prior", [PRIOR, None], ids=["prior", "free"])


def posed(
    device, dtype=np.float64, *, boxes=BOXES[:3], seed=0, psfs=(SHARP, BLURRED), fixed=(), **given
):
    """A Scene and State of random data, spectra and morphologies in boxes (y0, x0, ny, nx).

    given: other values for fields of either
    """
    rng, home = np.random.default_rng(seed), frame()
    ops = [
        cached_resampler(home, grid, psf, dtype=dtype, device=device)
        for grid, psf in zip(grids(), psfs, strict=True)
    ]
    n = len(boxes)
    shapes = np.array(boxes)[:, 2:]
    profile = [rng.uniform(0.2, 1, tuple(s)) for s in shapes]
    latent = [0.1 * rng.normal(size=m.shape) for m in profile]
    weights = [rng.uniform(0.5, 1.5, op.shape_out) * op.covered for op in ops]
    for w in weights:
        w[:, 3, 2:5] = 0
    scene = AmsgradScene(
        shape=home.shape,
        unpadded_shape=home.shape,
        ops=ops,
        data=[rng.normal(0, 3, op.shape_out) for op in ops],
        weights=weights,
        origin=np.array(boxes)[:, :2],
        center=shapes // 2,
        profile=profile,
        fixed=np.isin(np.arange(n), fixed),
        step_scale=rng.uniform(0.1, 0.3, (n, 3)),
        damping=rng.uniform(0, 20, n),
        fit_sky=True,
        sky_precision=np.resize(KNOWN_SKY, np.shape(given.get("sky", KNOWN_SKY))),
    )
    state = AmsgradState(
        latent=latent,
        morph=[p * (1 + 0.1 * z) for p, z in zip(profile, latent, strict=True)],
        spectra=rng.uniform(0.5, 2, (n, 3)),
        sky=rng.normal(size=3),
    )
    return changed(scene, state, **given)


def changed(scene, state, **given):
    """Both, with other values for some fields of either."""
    parts = []
    for one in (scene, state):
        names = {f.name for f in fields(one)} & set(given)
        parts.append(replace(one, **{name: given.pop(name) for name in names}))
    assert not given
    return tuple(parts)


def ragged(device, dtype):
    """Scenes of 3, 1 and 5 sources, one of them with PSFs of its own.

    They have a star, boxes at all edges and of one pixel, dark pixels, and spectra next to zero.
    """
    pairs = [
        posed(device, dtype, seed=1, fixed=(1,)),
        posed(device, dtype, seed=2, boxes=BOXES[4:], psfs=PSFS),
        posed(device, dtype, seed=3, boxes=BOXES),
    ]
    for _, state in pairs:
        state.spectra[0] *= 1e-3
        for m in state.morph:
            m[::3, 1::4] = 0
    return pairs


def engine(pairs, device, dtype=np.float64, *, prior=PRIOR, chain=None, steps=STEPS):
    """An Engine of (Scene, State) pairs; skips where the device lacks the type."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    chain = chain or ProxChain(Positivity(), Monotone())
    scenes, states = map(list, zip(*pairs, strict=True))
    return Engine(scenes, states, device, dtype, chain=chain, prior=prior, step_sizes=steps)


def close(found, wanted, dtype):
    """Equal to a few hundred roundings of the largest value."""
    scale = np.abs(wanted).max(initial=1e-3)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=CLOSE[dtype] * scale)


class Reference:
    """One scene iterated in NumPy; only the operators are the device's."""

    def __init__(self, scene, state, prior):
        self.scene, self.prior, self.i_step = scene, prior, state.n_steps
        self.morph, self.latent = list(state.morph), list(state.latent)
        self.spectra, self.sky = state.spectra, state.sky
        self.moments = [(np.zeros(m.shape),) * 3 for m in state.morph]
        self.moments_spectra = (np.zeros(state.spectra.shape),) * 3

    def gradient(self):
        """The loss and all gradients at the present state."""
        s = self.scene
        model = compose(s.shape, s.origin, self.morph, self.spectra)
        g, self.loss, pull = [], 0.0, []
        for part, op, data, weights in zip(s.channels(), s.ops, s.data, s.weights, strict=True):
            wr, loss, total = loss_ref.residual(
                op.forward(model[part].astype(op.dtype)), data, weights, self.sky[part]
            )
            g.append(op.adjoint(wr.astype(op.dtype)))
            self.loss += loss
            pull.append(total)
        of_sky, slopes = loss_ref.expected_sky(self.sky, s.known_sky)
        self.loss += of_sky
        self.pull, self.g = np.concatenate(pull) + slopes, np.concatenate(g).astype(float)
        self.d_morph = gather_morph(self.g, s.origin, self.morph, self.spectra)
        self.d_spectra = gather_spectra(self.g, s.origin, self.morph)
        if self.prior:
            self.loss += 0.5 * sum((z**2).sum() for z in self.latent)

    def update(self):
        """One step along them."""
        s = self.scene
        self.i_step += 1
        direction, self.moments_spectra = ref.amsgrad(
            s.step_scale * self.d_spectra, self.moments_spectra, self.i_step
        )
        self.spectra = np.maximum(self.spectra - STEPS.spectrum * s.step_scale * direction, 0)
        total = np.concatenate([w.sum(axis=(1, 2)) for w in s.weights]) + s.known_sky
        self.sky = self.sky - 0.5 * self.pull / total
        for i in np.flatnonzero(~s.fixed):
            self._move(i)
            self.morph[i] = ref.monotone_sweep(np.maximum(self.morph[i], 0), s.center[i])

    def _damped(self, i, rate):
        return 1e-8 + rate * DAMPING * self.scene.damping[i]

    def _move(self, i):
        if not self.prior:
            e = self._damped(i, STEPS.morphology)
            g = self.d_morph[i]
            direction, self.moments[i] = ref.amsgrad(g, self.moments[i], self.i_step, epsilon=e)
            self.morph[i] = self.morph[i] - STEPS.morphology * direction
            return
        profile = self.scene.profile[i]
        amplitude, taps = self.prior.strength * np.sqrt(profile), self.prior.taps
        g = ref.latent_gradient(self.d_morph[i], self.morph[i], amplitude, self.latent[i], taps)
        direction, self.moments[i] = ref.amsgrad(
            g, self.moments[i], self.i_step, epsilon=self._damped(i, STEPS.latent)
        )
        self.latent[i] = self.latent[i] - STEPS.latent * direction
        self.morph[i] = ref.form(profile, amplitude, self.latent[i], taps)


def references(pairs, prior):
    """A Reference of each scene."""
    return [Reference(scene, state, prior) for scene, state in pairs]
