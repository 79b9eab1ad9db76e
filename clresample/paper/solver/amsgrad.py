"""One step of proximal AMSGrad (Melchior et al. 2019) on all scenes of a batch.

    m <- B1 m + (1 - B1) g,  v <- B2 v + (1 - B2) g^2,  h <- max(h, v)
    x <- prox(x - step (m / (1 - B1^t)) / (sqrt(h / (1 - B2^t)) + e))

x is z where there is a prior, with g = K (amplitude o dS) + z and S = profile + amplitude o K z,
else S itself; then the spectra and the sky levels. Kernels in update.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .scene import AmsgradMoments

# Decay of the moments of gradients and of their squares (Reddi et al. 2018's defaults, as in the
# paper's solver): an average over the last 10 and the last 1000 iterations.
BETA1, BETA2 = 0.9, 0.999
# Fraction of AmsgradScene.damping by which steps are damped. The damping is a bound on the
# curvature, in most scenes twice the largest curvature (see curvature.py), so all of it would make
# steps too short. Without damping, steps of one length for all pixels would move a bright source
# far away from a good start.
DAMPING = 0.3
DECAY = {"B1": BETA1, "B2": BETA2}  # as macros
N_MOMENTS = 3  # m, v, h


@dataclass(frozen=True)
class StepSizes:
    """Lengths of the solver's undamped steps.

    Larger steps approach the minimum faster and are less stable there.

    latent: of z, in units of the prior's scatter; morphology: of S where there is no prior, in
    units of its maximum, 1; spectrum: in units of `AmsgradScene.step_scale`, a flux's error and 2 %
    of the flux
    """

    latent: float = 0.1
    morphology: float = 0.01
    spectrum: float = 0.1


class AMSGrad:
    """The steps of one batch. An update for `Engine` needs this signature, `step` and `memories`.

    buffers: the batch, whose latent, morph, spectra and sky are stepped along d_morph, d_spectra
    gradient: its LossGradient, for the sky; states: the scenes' States, with their moments
    chain: constraints on the morphologies, applied after every step
    prior: the SingleScalePrior of extended sources, or None; step_sizes: StepSizes
    """

    def __init__(self, buffers, gradient, states, *, chain, prior, step_sizes):
        self.buffers, self.chain, self.n_steps = buffers, chain, states[0].n_steps
        b = buffers
        if states[0].memory is None:
            self._m_morph = [b.zeros_flat() for _ in range(N_MOMENTS)]
            self._m_spectra = [b.zeros_like_spectra() for _ in range(N_MOMENTS)]
        else:
            memory = [s.memory for s in states]
            self._m_morph = [b.flat([m.morph[k] for m in memory]) for k in range(N_MOMENTS)]
            self._m_spectra = [
                b.put(np.concatenate([m.spectra[k] for m in memory])) for k in range(N_MOMENTS)
            ]
        self.factor = b.put(np.ones(b.n_sources))
        if prior is None:
            self._morph = _MorphologyStep(b, self._m_morph, self.factor, step_sizes)
        else:
            self._morph = _LatentStep(b, self._m_morph, prior, step_sizes)
        self._spectra = _launcher(b, prior, "step_spectra", 1).bind(
            gradient=b.d_spectra,
            scale=b.scale,
            spectra=b.spectra,
            rate=step_sizes.spectrum,
            n=b.spectra.size,
            **_named(self._m_spectra),
        )
        self._sky = _sky_step(b, gradient, prior) if b.scenes[0].fit_sky else None

    def step(self):
        """Queues one step along the gradients that were queued before."""
        b = self.buffers
        self.n_steps += 1
        t1, t2 = (1 / (1 - beta**self.n_steps) for beta in (BETA1, BETA2))
        self._spectra(b.items(b.spectra.size), t1=t1, t2=t2)
        if self._sky is not None:
            self._sky(b.items(b.sky.size))
        if not b.n_free:
            return
        self._morph.step(t1, t2)
        self.chain.prox(
            b.morph, b.boxes, step=self._morph.step_size, active=b.free, factor=self.factor
        )
        self._morph.after_constraints()

    def memories(self) -> list[AmsgradMoments]:
        """Each scene's moments, back on the host."""
        b = self.buffers
        morph = zip(*(b.unpack(b.device.get(a)) for a in self._m_morph), strict=True)
        spectra = zip(*(b.split(b.device.get(a)) for a in self._m_spectra), strict=True)
        return [AmsgradMoments(list(m), np.stack(s)) for m, s in zip(morph, spectra, strict=True)]


class _LatentStep:
    """Steps z along K (amplitude o dS) + z, and forms S = profile + amplitude o K z of it."""

    def __init__(self, buffers, moments, prior, step_sizes):
        b, self.step_size = buffers, step_sizes.latent
        self._size = b.box_rows(b.n_free)
        common = {"active": b.free, "table": b.boxes.table, "taps": b.put(prior.taps)}
        blurred, weighed = b.zeros_flat(), b.zeros_flat()  # K along x, and what is blurred
        kernels = ("blur_latent", "step_latent", "blur_latent", "form_latent_morphology")
        self._blur_gradient, self._step, self._blur_latent, self._form = (
            _launcher(b, prior, name, 3).bind(**common) for name in kernels
        )
        for blur, values, weigh in (
            (self._blur_gradient, b.d_morph, True),
            (self._blur_latent, b.latent, False),
        ):
            blur.bind(v=values, weigh=weigh, amplitude=b.amplitude, morph=b.morph)
            blur.bind(weighed=weighed, scratch=blurred)
        self._step.bind(
            damping=_damping(b),
            scratch=blurred,
            latent=b.latent,
            gradient=b.d_morph,
            rate=self.step_size,
            **_named(moments),
        )
        self._form.bind(scratch=blurred, profile=b.profile, amplitude=b.amplitude, morph=b.morph)

    def step(self, t1, t2):
        """Queues a step; t1, t2 = 1 / (1 - B^t) of both moments."""
        self._blur_gradient(self._size)
        self._step(self._size, t1=t1, t2=t2)
        self._blur_latent(self._size)
        self._form(self._size)

    def after_constraints(self):
        """Does nothing: with a prior no constraint changes a morphology's scale (see Settings)."""


class _MorphologyStep:
    """Steps S itself along dS; a normalisation of S multiplies its spectrum by the divisor."""

    def __init__(self, buffers, moments, factor, step_sizes):
        b, self.step_size = buffers, step_sizes.morphology
        self._size, self._spectra_size = b.box_rows(b.n_free), b.items(b.spectra.size)
        self._step = _launcher(b, None, "step_morph", 3).bind(
            active=b.free,
            table=b.boxes.table,
            damping=_damping(b),
            gradient=b.d_morph,
            morph=b.morph,
            rate=self.step_size,
            **_named(moments),
        )
        self._rescale = _launcher(b, None, "rescale_spectra", 1).bind(
            factor=factor, n_channels=b.n_channels, spectra=b.spectra, n=b.spectra.size
        )

    def step(self, t1, t2):
        """Queues a step; t1, t2 = 1 / (1 - B^t) of both moments."""
        self._step(self._size, t1=t1, t2=t2)

    def after_constraints(self):
        """Queues the spectra's part of a normalisation."""
        self._rescale(self._spectra_size)


def _launcher(buffers, prior, name, n_axes):
    """A Launcher of a kernel of update.cl, all of one build."""
    macros = DECAY | ({"RADIUS": len(prior.taps) // 2} if prior else {})
    return buffers.launcher("update.cl", name, n_axes, **macros)


def _sky_step(buffers, gradient, prior):
    """The kernel that changes sky levels by a fraction of a Newton step; launch: (B * C)."""
    totals = [w.sum(axis=(1, 2)) for s in buffers.scenes for w in s.weights]
    total = np.concatenate(totals) + np.concatenate([s.known_sky for s in buffers.scenes])
    inverse = np.divide(1, total, where=total > 0, out=np.zeros_like(total))
    return _launcher(buffers, prior, "step_sky", 1).bind(
        n_channels=buffers.n_channels,
        n_rows=gradient.rows[-1],
        row0=buffers.device.put(gradient.rows, np.int32),
        pull=gradient.rows_pull,
        inverse=buffers.put(inverse),
        sky=buffers.sky,
        n=buffers.sky.size,
    )


def _damping(buffers):
    """Gradients (S,) under which steps are shorter than the step sizes, on the device."""
    return buffers.put(DAMPING * np.concatenate([s.damping for s in buffers.scenes]))


def _named(moments):
    """The three moments by their names in update.cl."""
    return dict(zip("mvh", moments, strict=True))
