"""The iteration of a batch of scenes, all of it on the device: model, residual, gradients, update.

    L = 1/2 sum_o |sqrt(w_o) (R_o M + sky - d_o)|^2 + 1/2 |z|^2,      M_c = sum_s A[s, c] S_s
    G_o = R_o^T w_o (R_o M + sky - d_o),  dS_s = sum_c A[s, c] G_c on the box,
    dA[s, c] = <S_s, G_c>

The kernels are scene.cl (model, residual, gradients) and update.cl (proximal AMSGrad).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...device.device import Device
from ...resampling.resampler import Resampler
from .boxes import Boxes
from .constraints import Chain
from .prior import Prior
from .problem import Problem, StepSizes

# Decay of AMSGrad's moments (Reddi et al. 2018's defaults, as in the paper's solver).
BETA1, BETA2 = 0.9, 0.999
# Work-items that share one sum over a box: a CPU's vector unit does it alone.
GROUP_ELSEWHERE = 64
# Steps are damped by this part of a bound on the curvature, which is a few times too large: from a
# start that fits, steps of one length for all pixels would take a bright source far from it.
DAMPING = 0.3
# Losses kept on the device until somebody looks.
HISTORY = 16


class Engine:
    """A batch of problems of one signature on the device; `step` queues one iteration.

    chain: constraints on the morphologies, applied after every step
    prior: the Prior of all extended sources, or None to fit the morphologies themselves
    """

    def __init__(
        self,
        problems: list[Problem],
        device: Device,
        dtype,
        *,
        chain: Chain,
        prior: Prior | None,
        rates: StepSizes,
    ):
        self.problems, self.device, self.dtype = problems, device, np.dtype(dtype)
        self.prior, self.chain, self.rates = prior, chain, rates
        self.n_steps = problems[0].n_steps
        self.shape = problems[0].shape
        self.n_channels = problems[0].spectra.shape[1]
        self._upload_sources()
        self._upload_observations()
        self._bind()

    def _upload_sources(self):
        problems, put = self.problems, self._put
        counts = [len(p.spectra) for p in problems]
        self.first = self.device.put(np.concatenate([[0], np.cumsum(counts)]), np.int32)
        self.host_boxes = Boxes(
            np.repeat(np.arange(len(problems)), counts),
            np.concatenate([p.origin for p in problems]),
            np.array([m.shape for p in problems for m in p.morph]),
            np.concatenate([p.center for p in problems]),
        )
        self.boxes = self.host_boxes.put(self.device)
        free = np.flatnonzero(~np.concatenate([p.fixed for p in problems]))
        self.n_free = len(free)
        self.free = self.device.put(free if self.n_free else [0], np.int32)
        self.tallest = int(self.host_boxes.shape[:, 0].max())
        self.widest = int(self.host_boxes.shape[:, 1].max())
        flat = self._flat
        self.base = flat([p.base for p in problems])
        self.field = flat([p.field for p in problems])
        self.morph = flat([p.morph for p in problems])
        amplitude = self.prior.amplitude if self.prior else np.zeros_like
        self.amp = flat([[amplitude(base) for base in p.base] for p in problems])
        self.damping = put(DAMPING * np.concatenate([p.damping for p in problems]))
        zeros = self.device.zeros
        self.moments = [
            flat([p.moments_morph[i] for p in problems])
            if problems[0].moments_morph
            else zeros(self.host_boxes.size, self.dtype)
            for i in range(3)
        ]
        self.d_morph, self.blurred, self.weighed = (
            zeros(self.host_boxes.size, self.dtype) for _ in range(3)
        )
        self.spectra = put(np.concatenate([p.spectra for p in problems]))
        self.scale = put(np.concatenate([p.scale for p in problems]))
        shape = self.spectra.shape
        self.moments_spectra = [
            put(np.concatenate([p.moments_spectra[i] for p in problems]))
            if problems[0].moments_spectra is not None
            else zeros(shape, self.dtype)
            for i in range(3)
        ]
        self.d_spectra = self.device.zeros(shape, self.dtype)
        self.factor = put(np.ones(shape[0]))
        self.sky = put(np.array([p.sky for p in problems]))

    def _upload_observations(self):
        problems, put = self.problems, self._put
        self.ops, self.data, self.weights, self.models, self.images = [], [], [], [], []
        n = len(problems)
        for i, op in enumerate(problems[0].ops):
            ops = [p.ops[i] for p in problems]
            if any(other is not op for other in ops):
                op = Resampler.from_plans(
                    [o.plans[0] for o in ops],
                    dtype=self.dtype,
                    device=self.device,
                    shift=np.stack([o.shift for o in ops]),
                )
            self.ops.append(op)
            self.data.append(put(np.stack([p.data[i] for p in problems])))
            self.weights.append(put(np.stack([p.weights[i] for p in problems])))
            self.models.append(self.device.empty((n, *op.shape_in), self.dtype))
            self.images.append(self.device.empty((n, *op.shape_out), self.dtype))
        rows = [my for op in self.ops for my in [op.shape_out[1]] * op.shape_out[0]]
        self.row0 = np.concatenate([[0], np.cumsum(rows)])
        self.rows_loss, self.rows_pull = (
            self.device.empty((n, int(self.row0[-1])), self.dtype) for _ in range(2)
        )
        total = np.concatenate(
            [
                [w.sum(axis=(1, 2)) for w in p.weights][i]
                for p in problems
                for i in range(len(p.weights))
            ]
        )
        self.inverse = put(np.divide(1, total, where=total > 0, out=np.zeros_like(total)))

    def _bind(self):
        """Kernels with their arguments set, in the order of one iteration."""
        d, i32 = self.device, np.int32
        cpu = d.kind == "CPU"
        options = {"dtype": self.dtype, "ROWS": cpu, "B1": BETA1, "B2": BETA2}
        n, n_sources = len(self.problems), len(self.host_boxes)
        width = 1 if cpu else self.widest
        n_channels, n_rows = i32(self.n_channels), i32(self.row0[-1])
        table, first, free = self.boxes.table.data, self.first.data, self.free.data
        self._kept = []

        def kernel(file, name, size, *args, local=None, **defines):
            k = d.kernel(file, name, **options, **defines)
            k.set_args(*(a.base_data if hasattr(a, "base_data") else a for a in args))
            self._kept.append(args)  # OpenCL does not keep what a kernel's arguments point to
            return lambda: self._launch(k, size, local)

        self._iteration = []
        for j, op in enumerate(self.ops):
            n_bands, my, mx = op.shape_out
            channel = self.channel(j)
            geometry = n_channels, i32(channel), i32(n_bands), *map(i32, self.shape)
            group = 1 if cpu else GROUP_ELSEWHERE
            first_width = 1 if cpu else self.shape[1]
            self._iteration += [
                kernel(
                    "scene.cl",
                    "compose",
                    (first_width, self.shape[0], n * n_bands),
                    first,
                    table,
                    self.morph,
                    self.spectra,
                    *geometry,
                    self.models[j],
                ),
                lambda op=op, j=j: op.forward_into(self.models[j], self.images[j]),
                kernel(
                    "scene.cl",
                    "residual",
                    (my, n_bands, n),
                    n_channels,
                    i32(channel),
                    i32(n_bands),
                    i32(my),
                    i32(mx),
                    i32(self.row0[channel]),
                    n_rows,
                    self.data[j],
                    self.weights[j],
                    self.sky,
                    self.images[j],
                    self.rows_loss,
                    self.rows_pull,
                ),
                lambda op=op, j=j: op.adjoint_into(self.images[j], self.models[j]),
                kernel(
                    "scene.cl",
                    "gather_spectra",
                    (group, n_bands, n_sources),
                    table,
                    self.models[j],
                    self.morph,
                    *geometry,
                    self.d_spectra,
                    local=(group, 1, 1),
                    WG=group,
                ),
            ]
            if self.n_free:
                self._iteration.append(
                    kernel(
                        "scene.cl",
                        "gather_morph",
                        (width, self.tallest, self.n_free),
                        free,
                        table,
                        self.models[j],
                        self.spectra,
                        *geometry,
                        i32(j > 0),
                        self.d_morph,
                    )
                )
        self.history = d.empty((HISTORY, n), self.dtype)
        self._losses = d.kernel("update.cl", "losses", **options)
        self.best = self._put(np.full(n, np.inf))
        self._losses.set_args(
            first,
            table,
            n_rows,
            self.rows_loss.data,
            i32(self.prior is not None),
            self.field.data,
            self.history.data,
            self.best.data,
            i32(0),
        )
        state = self.field, self.morph, self.spectra, self.sky
        self.kept = [d.put(d.get(a)) for a in state]
        everyone = self.boxes.everyone.data
        self._keep = kernel(
            "update.cl",
            "keep",
            (width, self.tallest, n_sources),
            everyone,
            table,
            first,
            n_channels,
            self.history,
            self.best,
            *state,
            *self.kept,
        )
        self._spectra_kernel = d.kernel("update.cl", "step_spectra", **options)
        self._spectra_kernel.set_args(
            *(
                a.base_data
                for a in (self.d_spectra, self.scale, self.spectra, *self.moments_spectra)
            ),
            *[self.dtype.type(0)] * 3,
        )
        self._sky_step = kernel(
            "update.cl",
            "step_sky",
            (n * self.n_channels,),
            n_channels,
            n_rows,
            d.put(self.row0, np.int32),
            self.rows_pull,
            self.inverse,
            self.sky,
        )
        self._rescale = kernel(
            "update.cl",
            "rescale",
            (n_sources * self.n_channels,),
            self.factor,
            n_channels,
            self.spectra,
        )
        size = width, self.tallest, max(self.n_free, 1)
        if self.prior is not None:
            taps = self._put(self.prior.taps)
            self._kept.append(taps)
            radius = {"RADIUS": len(self.prior.taps) // 2}
            arrays = self.amp, self.morph, self.weighed, self.blurred
            self._blur_gradient = kernel(
                "update.cl",
                "blur",
                size,
                free,
                table,
                taps,
                i32(1),
                self.d_morph,
                *arrays,
                **radius,
            )
            self._blur_field = kernel(
                "update.cl", "blur", size, free, table, taps, i32(0), self.field, *arrays, **radius
            )
            self._form = kernel(
                "update.cl",
                "form",
                size,
                free,
                table,
                taps,
                self.blurred,
                self.base,
                self.amp,
                self.morph,
                **radius,
            )
            self._morph_kernel = d.kernel("update.cl", "step_field", **options, **radius)
            args = free, table, self.damping.data, taps.data, self.blurred.data, self.field.data
            args += *(m.data for m in self.moments), self.d_morph.data
        else:
            self._morph_kernel = d.kernel("update.cl", "step_morph", **options)
            args = free, table, self.damping.data, self.d_morph.data, self.morph.data
            args += tuple(m.data for m in self.moments)
        self._morph_kernel.set_args(*args, *[self.dtype.type(0)] * 3)
        self._n_morph_args, self._morph_size = len(args), size

    def run(self, n_steps):
        """Losses (n_steps, B) before each of `n_steps` iterations, which are done by then.

        Of each scene the state before the first of them is kept if its loss is the lowest so far.
        """
        if n_steps > HISTORY:
            raise ValueError(f"n_steps is {n_steps}, losses of {HISTORY} are kept")
        for i in range(n_steps):
            self.gradient(i)
            if i == 0:
                self._keep()
            self.update()
        return self.device.get(self.history)[:n_steps].astype(np.float64)

    def final_losses(self):
        """Losses (B,) at the present parameters."""
        self.gradient(1)  # not 0, which belongs to the states that are kept
        return self.device.get(self.history)[1].astype(np.float64)

    def best_losses(self):
        """Losses (B,) of the states kept, infinite before the first iteration."""
        return self.device.get(self.best).astype(np.float64)

    def gradient(self, i_loss=0):
        """Queue model, residual, gradients, and the losses into history[i_loss]."""
        for launch in self._iteration:
            launch()
        self._losses.set_arg(8, np.int32(i_loss))
        self._launch(self._losses, (len(self.problems),))

    def update(self):
        """Queue the proximal step along the gradients."""
        self.n_steps += 1
        real = self.dtype.type
        t = [real(1 / (1 - beta**self.n_steps)) for beta in (BETA1, BETA2)]
        for k, value in enumerate((real(self.rates.spectrum), *t)):
            self._spectra_kernel.set_arg(6 + k, value)
        self._launch(self._spectra_kernel, (self.spectra.size,))
        if self.problems[0].fit_sky:
            self._sky_step()
        if not self.n_free:
            return
        rate = self.rates.field if self.prior is not None else self.rates.morphology
        for k, value in enumerate((real(rate), *t)):
            self._morph_kernel.set_arg(self._n_morph_args + k, value)
        if self.prior is not None:
            self._blur_gradient()
        self._launch(self._morph_kernel, self._morph_size)
        if self.prior is not None:
            self._blur_field()
            self._form()
        self.chain.prox(self.morph, self.boxes, step=rate, active=self.free, factor=self.factor)
        if self.prior is None:
            self._rescale()

    def _launch(self, kernel, size, local=None):
        """Groups of one on CPUs: left to choose, their runtimes pick another size for every box and
        build each kernel anew for it, 0.6 s in all; a GPU's drivers choose well and build once."""
        if local is None and self.device.kind == "CPU":
            local = (1,) * len(size)
        self.device.launch(kernel, size, local)

    def channel(self, i_observation) -> int:
        """First channel of an observation."""
        return sum(op.shape_out[0] for op in self.ops[:i_observation])

    def problems_now(self, kept=False) -> list[Problem]:
        """The problems with their present state, or the best one kept, back on the host."""
        get, unpack = self.device.get, self.host_boxes.unpack
        state = self.kept if kept else (self.field, self.morph, self.spectra, self.sky)
        field, morph, spectra, sky = (get(a) for a in state)
        flats = [unpack(a) for a in (field, morph, *(get(m) for m in self.moments))]
        moments = [get(a) for a in self.moments_spectra]
        ends = np.cumsum([len(p.spectra) for p in self.problems])
        out = []
        for i, (p, end) in enumerate(zip(self.problems, ends, strict=True)):
            part = slice(end - len(p.spectra), end)
            field, morph, *m = (flat[part] for flat in flats)
            out.append(
                replace(
                    p,
                    field=field,
                    morph=morph,
                    moments_morph=m,
                    spectra=spectra[part].astype(float),
                    sky=sky[i].astype(float),
                    moments_spectra=np.stack([a[part] for a in moments]),
                    n_steps=self.n_steps,
                )
            )
        return out

    def _put(self, values):
        return self.device.put(values, self.dtype)

    def _flat(self, morphs):
        return self._put(
            self.host_boxes.pack([m for scene in morphs for m in scene], dtype=self.dtype)
        )
