"""The scene as linear operators: an image is linear in morphologies and in spectra.

    I[b, c] = R_c M[b, c],   M[b, c] = sum_s A[s, c] S_s    sources s of scene b, an observation's
                                                            channels c

`MorphologyOperator` takes S to I at fixed A, `SpectraOperator` takes A to I at fixed S. Their
adjoints turn a gradient by I into gradients by S and by A. rendering/ has how it is computed.
"""

from __future__ import annotations

import functools

from clresample.resampling.linop import LinOp


class SceneOperator(LinOp):
    """Base of both operators: one observation's images of every scene of a batch (B, Co, My, Mx).

    buffers: the batch; op: its operator of that observation; rendering: its FrameRendering or
        BoxTransformRendering
    """

    def __init__(self, buffers, op, rendering, shape_in):
        self.buffers, self.rendering = buffers, rendering
        shape_out = (len(buffers.scenes), *op.shape_out)
        super().__init__(buffers.device, buffers.dtype, shape_in, shape_out)

    def _refuse_batch(self, x):
        """Copies have one buffer of each kind: the scenes of a batch are inside an item."""
        if len(x) != 1:
            raise ValueError(
                f"a batch of {len(x)} items is given; {type(self).__name__} takes one, which holds "
                "all scenes"
            )


class MorphologyOperator(SceneOperator):
    """Morphologies to images at the batch's present spectra: (boxes.size,) -> (B, Co, My, Mx).

    dS_s = sum_c A[s, c] (R_c^T y_c) on the box       the adjoint; 0 between the boxes
    """

    def __init__(self, buffers, op, rendering):
        super().__init__(buffers, op, rendering, (buffers.host_boxes.size,))

    def _forward(self, x, out):
        self._refuse_batch(x)
        self.rendering.transform(x)
        self.rendering.render(self.buffers.spectra, out[0])

    def _adjoint(self, y, out):
        self._refuse_batch(y)
        self.device.copy(self._zeros, out)  # no kernel writes between the boxes
        self.rendering.back_project(y[0])
        self.rendering.gather_morph(self.buffers.spectra, out, self.buffers.boxes.everyone)

    @functools.cached_property
    def _zeros(self):
        """Zeros from which an adjoint starts; the solver's own launches do without."""
        return self.buffers.zeros_flat()


class SpectraOperator(SceneOperator):
    """Spectra to images at the batch's present morphologies: (S, C) -> (B, Co, My, Mx).

    dA[s, c] = <R_c S_s, y_c>         the adjoint; 0 in the channels of other observations
    """

    def __init__(self, buffers, op, rendering):
        super().__init__(buffers, op, rendering, buffers.spectra.shape)

    def _forward(self, x, out):
        self._refuse_batch(x)
        self.rendering.transform(self.buffers.morph)
        self.rendering.render(x, out[0])

    def _adjoint(self, y, out):
        self._refuse_batch(y)
        self.device.copy(self._zeros, out)  # the channels of other observations
        self.rendering.transform(self.buffers.morph)
        self.rendering.back_project(y[0])
        self.rendering.gather_spectra(out)

    @functools.cached_property
    def _zeros(self):
        """Zeros from which an adjoint starts; the solver's own launches do without."""
        return self.buffers.zeros_like_spectra()
