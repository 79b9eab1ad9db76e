"""The loss of a batch of scenes and its gradients, on the device.

    L = 1/2 sum_o |sqrt(w_o) (R_o M + sky - d_o)|^2 + 1/2 sum_c p_c sky_c^2
    M_c = sum_s A[s, c] S_s,   p = Scene.known_sky,   G_o = R_o^T w_o (R_o M + sky - d_o)
    dS_s = sum_c A[s, c] G_c on the box,   dA[s, c] = <S_s, G_c>
    dsky_c = sum of w_o (...) + p_c sky_c

dA of tied channels is the mean over their band, see linear/ties.py.

The solvers add the prior's term and its gradient in their steps. rendering/ computes
R_o M and the gradients; kernels are in scene.cl, boxed.cl and losses.cl.
"""

from __future__ import annotations

import numpy as np

from ...resampling.resampler import Resampler
from .rendering.stage_selection import select_rendering
from .rendering.windows import WindowRendering


class LossGradient:
    """Queues model, residual, gradients and loss of a batch at its present state.

    buffers: the batch; d_morph and d_spectra of it are overwritten
    depth: the stage of rendering at which spectra are applied, see rendering/stages.py; None = the
        cheapest for each observation
    before: LossGradient of a batch that contained these scenes, whose stages are reused; windows
        are counted again
    rows (C + 1,): first observed row of each channel, then their total; the columns of rows_loss
        and rows_pull
    rows_loss, rows_pull (B, n_rows): 1/2 sum w r^2 and sum w r of each observed row; the first row
        of a channel includes the prior of its sky. Sums over its rows are its loss and dL/dsky
    """

    def __init__(self, buffers, depth=None, *, before=None):
        self.buffers, scenes = buffers, buffers.scenes
        heights = [op.shape_out[1] for op in scenes[0].ops for _ in range(op.shape_out[0])]
        self.rows = np.concatenate([[0], np.cumsum(heights)])
        shape = len(scenes), int(self.rows[-1])
        self.rows_loss, self.rows_pull = (
            buffers.device.empty(shape, buffers.dtype) for _ in range(2)
        )
        depths = [depth] * len(scenes[0].ops)
        if before is not None:
            had = [o.rendering.depth for o in before.observations]
            depths = [None if depth == WindowRendering.depth else depth for depth in had]
        self.observations = [_ObservedBatch(self, i, depth) for i, depth in enumerate(depths)]
        self._tie, self._expect_sky = None, None
        known = np.array([scene.known_sky for scene in scenes])
        if known.any():
            self._expect_sky = buffers.launcher("losses.cl", "expect_sky", 1).bind(
                n=known.size,
                n_channels=buffers.n_channels,
                n_rows=self.rows[-1],
                row0=buffers.device.put(self.rows, np.int32),
                precision=buffers.put(known),
                sky=buffers.sky,
                rows=self.rows_loss,
                pull=self.rows_pull,
            )
        ties = scenes[0].ties
        if ties is not None:
            first, count = (
                buffers.device.put(a, np.int32) for a in (ties.first[ties.band], ties.count)
            )
            self._tie = buffers.launcher("ties.cl", "tie", 1).bind(
                n_sources=buffers.n_sources,
                n_channels=buffers.n_channels,
                first=first,
                count=count,
                d_spectra=buffers.d_spectra,
            )

    def queue(self):
        """Queues the evaluation: gradients, rows_loss and rows_pull."""
        for observed in self.observations:
            observed.queue()
        if self._expect_sky is not None:
            self._expect_sky(self.buffers.items(self.buffers.sky.size))
        if self._tie is not None:
            self._tie(self.buffers.items(self.buffers.n_sources))

    def update_shifts(self):
        """Copies the current shifts of the scenes' own operators."""
        for observed in self.observations:
            observed.follow_shifts()


class _ObservedBatch:
    """One observation of every scene of a batch: data, operator and buffers for its images.

    op: the operator; rendering: its FrameRendering, BoxTransformRendering or WindowRendering
    image (B, Co, My, Mx): R M, then w r
    """

    def __init__(self, gradient, i_observation, depth):
        buffers = self.buffers = gradient.buffers
        scenes, device, i = buffers.scenes, buffers.device, i_observation
        self._ops = [scene.ops[i] for scene in scenes]
        self.op = Resampler.of_items(self._ops)
        n, channel = len(scenes), scenes[0].channels()[i].start
        n_bands, my, mx = self.op.shape_out
        self.image = device.empty((n, *self.op.shape_out), buffers.dtype)
        self.rendering = select_rendering(buffers, i, self.op, depth)
        group = buffers.tuning.sum_group
        self.add, self._residual_size = i > 0, (group, my, n * n_bands)
        self._residual = buffers.scene_launcher("residual", (group, 1, 1)).bind(
            n_channels=buffers.n_channels,
            channel=channel,
            n_bands=n_bands,
            my=my,
            mx=mx,
            row0=gradient.rows[channel],
            n_rows=gradient.rows[-1],
            data=device.resident.stack([s.data[i] for s in scenes], buffers.dtype),
            weights=device.resident.stack([s.weights[i] for s in scenes], buffers.dtype),
            sky=buffers.sky,
            image=self.image,
            loss=gradient.rows_loss,
            pull=gradient.rows_pull,
        )

    def queue(self):
        """Queues the model, its residual and their contribution to the gradients."""
        b, shown = self.buffers, self.rendering
        shown.transform(b.morph)
        shown.render(b.spectra, self.image)
        self._residual(self._residual_size)
        shown.back_project(self.image)
        shown.gather_spectra(b.d_spectra)
        if b.n_free:
            shown.gather_morph(b.spectra, b.d_morph, b.free, add=self.add)

    def follow_shifts(self):
        """Copies the shifts of the scenes' own operators to the batch's operator."""
        if self.op is not self._ops[0]:
            self.op.shift = np.stack([op.shift for op in self._ops])
        self.rendering.update_shifts()
