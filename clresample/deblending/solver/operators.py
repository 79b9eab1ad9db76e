"""The scene as linear operators: the model is linear in its morphologies and in its spectra.

    M[b, c] = sum_s A[s, c] S_s          the sources s of scene b, the bands c of one observation

`MorphologyOperator` takes S to M at fixed A, `SpectraOperator` takes A to M at fixed S. Their
adjoints turn a gradient by M into gradients by S and by A; kernels in scene.cl.
"""

from __future__ import annotations

import functools

from ...resampling.linop import LinOp


class SceneOperator(LinOp):
    """What both have: the model of one observation's bands for every scene of a batch.

    buffers: the batch; i_observation: which of its observations
    model (B, Co, Ny, Nx): the operators' output, in the order of the batch's scenes
    """

    def __init__(self, buffers, i_observation, shape_in):
        scene = buffers.scenes[0]
        part = scene.channels()[i_observation]
        self.buffers, self.channel, self.n_bands = buffers, part.start, part.stop - part.start
        shape_out = (len(buffers.scenes), self.n_bands, *scene.shape)
        super().__init__(buffers.device, buffers.dtype, shape_in, shape_out)
        row_width = 1 if buffers.tuning.row_loops else scene.shape[1]
        self._model_size = row_width, scene.shape[0], shape_out[0] * self.n_bands
        self._compose = self._launcher("compose").bind(first=buffers.first)

    def _launcher(self, name, local_size=None):
        """A kernel of scene.cl that knows the table of the boxes and this observation's bands."""
        b, (ny, nx) = self.buffers, self.shape_out[2:]
        launcher = b.launcher("scene.cl", name, 3, local_size=local_size, WG=b.tuning.sum_group)
        return launcher.bind(
            table=b.boxes.table,
            n_channels=b.n_channels,
            channel=self.channel,
            n_bands=self.n_bands,
            ny_frame=ny,
            nx_frame=nx,
        )

    def _refuse_batch(self, x):
        """The kernels know one buffer of each kind: the scenes of a batch are inside an item."""
        if len(x) != 1:
            raise ValueError(
                f"a batch of {len(x)} items is given; {type(self).__name__} takes one, which holds "
                "all scenes"
            )

    def compose(self, morph, spectra, model):
        """Queue model = sum_s A S_s: flat morphologies, spectra (S, C) -> model."""
        self._compose(self._model_size, morph=morph, spectra=spectra, model=model)


class MorphologyOperator(SceneOperator):
    """Morphologies to models at the batch's present spectra: (boxes.size,) -> (B, Co, Ny, Nx).

    dS_s = sum_c A[s, c] G[b, c] on the box            the adjoint; 0 between the boxes
    """

    def __init__(self, buffers, i_observation):
        super().__init__(buffers, i_observation, (buffers.host_boxes.size,))
        self._gather = self._launcher("gather_morph").bind(spectra=buffers.spectra)

    def gather(self, gradient, d_morph, active, *, add=False):
        """Queue dS_s for the sources `active` (n,): written into d_morph, or added to it."""
        size = self.buffers.row_width, self.buffers.tallest, active.size
        self._gather(size, active=active, gradient=gradient, add=add, d_morph=d_morph)

    def _forward(self, x, out):
        """M = sum_s A S_s: morphologies (1, boxes.size) -> models (1, B, Co, Ny, Nx)."""
        self._refuse_batch(x)
        self.compose(x, self.buffers.spectra, out)

    def _adjoint(self, y, out):
        """dS_s = sum_c A G on the boxes: gradients (1, B, Co, Ny, Nx) -> (1, boxes.size)."""
        self._refuse_batch(y)
        self.device.copy(self._zeros, out)  # no kernel writes to what lies between the boxes
        self.gather(y, out, self.buffers.boxes.everyone)

    @functools.cached_property
    def _zeros(self):
        """What an adjoint starts from; the solver's own launches do without."""
        return self.buffers.zeros_flat()


class SpectraOperator(SceneOperator):
    """Spectra to models at the batch's present morphologies: (S, C) -> (B, Co, Ny, Nx).

    dA[s, c] = <S_s, G[b, c]>         the adjoint; 0 in the channels of other observations
    """

    def __init__(self, buffers, i_observation):
        super().__init__(buffers, i_observation, buffers.spectra.shape)
        group = buffers.tuning.sum_group
        self._gather_size = group, self.n_bands, buffers.n_sources
        self._gather = self._launcher("gather_spectra", (group, 1, 1)).bind(morph=buffers.morph)

    def gather(self, gradient, d_spectra):
        """Queue dA of this observation's channels into d_spectra (S, C)."""
        self._gather(self._gather_size, gradient=gradient, d_spectra=d_spectra)

    def _forward(self, x, out):
        """M = sum_s A S_s: spectra (1, S, C) -> models (1, B, Co, Ny, Nx)."""
        self._refuse_batch(x)
        self.compose(self.buffers.morph, x, out)

    def _adjoint(self, y, out):
        """dA = <S, G>: gradients (1, B, Co, Ny, Nx) -> (1, S, C)."""
        self._refuse_batch(y)
        self.device.copy(self._zeros, out)  # the channels of other observations
        self.gather(y, out)

    @functools.cached_property
    def _zeros(self):
        """What an adjoint starts from; the solver's own launches do without."""
        return self.buffers.zeros_like_spectra()
