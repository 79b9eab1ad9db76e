"""One observation of a batch, rendered with spectra applied at one of three stages.

The operator's first two products act on each axis of the model alone, so they may act on each
source in its box, before spectra are applied, as well as on the model's bands after that:

    depth 0    frames        Z_c = D_c o (Ty (sum_s A_sc S_s) Tx)
    depth 1    halves        Z_c = D_c o (Ty (sum_s A_sc S_s Tx[cols_s]))
    depth 2    frequencies   Z_c = D_c o (sum_s A_sc Ty[:, rows_s] S_s Tx[cols_s])

and backwards, Q_c being what the observation's residuals are there:

    depth 2    dS_s = Ty[:, rows_s]^T (sum_c A_sc Q_c) Tx[cols_s]^T,    dA_sc = <Z_s, Q_c>

All three are the same sum, to rounding; stage_selection.py selects the cheapest. Symbols are those
of resampling/executor.py. If the PSF varies, each Z_c is a sum over the operator's terms, and A_sc
is a source's spectrum times its coefficient of the term (composition.py).
"""

from __future__ import annotations

import functools

import numpy as np

from ....device.contraction import COLUMN_PAD, ImageBatch, round_up_columns, row_stride
from ....device.program import queue_anew
from ..boxes import Boxes
from .boxed import BoxedProduct
from .composition import SpectralComposition


class FrameRendering:
    """Depth 0: models M_c in full frames, each rendered as an image.

    buffers: the batch; i_observation: of it; op: the batch's operator there
    """

    depth = 0

    def __init__(self, buffers, i_observation, op):
        self.buffers, self._op = buffers, op
        n = len(buffers.scenes)
        self._model = buffers.device.empty((n, *op.shape_in), buffers.dtype)
        self._composition = SpectralComposition(
            buffers, i_observation, buffers.host_boxes, op.shape_in[1:]
        )

    def transform(self, morph):
        """Sets the morphologies (boxes.size,) for the launches that follow."""
        self._morph = morph

    def render(self, spectra, image):
        """Queues the image (B, Co, My, Mx) of the morphologies with spectra (S, C)."""
        self._composition.compose(self._morph, spectra, self._model)
        queue_anew(self._op.queue_plain, "forward", self._model, image)

    def back_project(self, image):
        """Queues the adjoint of an image (B, Co, My, Mx) for the gradients that follow."""
        queue_anew(self._op.queue_plain, "adjoint", image, self._model)

    def gather_spectra(self, d_spectra):
        """Queues dA of this observation's channels into d_spectra (S, C)."""
        self._composition.gather_spectra(self._model, self._morph, d_spectra)

    def gather_morph(self, spectra, d_morph, active, *, add=False):
        """Queues dS of the sources `active` (n,): written into d_morph, or added to it."""
        self._composition.gather_boxed(self._model, spectra, d_morph, active, add=add)

    def update_shifts(self):
        """Does nothing: the operator owns its shifts."""


class BoxTransformRendering:
    """Depth 1 or 2: each source's box transformed along one axis, or both; as FrameRendering."""

    def __init__(self, buffers, i_observation, op, depth):
        b, self.buffers, self.depth = buffers, buffers, depth
        e = self._executor = op.executor()
        self._n_images = len(b.scenes) * op.shape_out[0]
        e.reserve(self._n_images)
        self._boxes = _Boxes(b, e)
        self._lines = self._empty(self._boxes.lines)
        if depth == 1:
            boxes, shape, transfer = self._boxes.lines, (e.n_y, e.k_pad), None
            self._boxed, self._frame = self._lines, e.scratch["half"]
        else:
            boxes, shape = self._boxes.planes, (e.k_y, e.k_pad)
            transfer = e.tables(e.transfer)[:2]
            self._boxed, self._frame = self._empty(boxes), e.model_frequencies
        self._d_boxed = self._empty(boxes)
        self._composition = SpectralComposition(b, i_observation, boxes, shape, transfer)

    def _empty(self, boxes):
        return self.buffers.device.empty(boxes.size, self.buffers.dtype)

    def transform(self, morph):
        b, e = self.buffers, self._executor
        self._boxes.to_lines(morph, e.in_x_t.buffer, self._lines, b.all_sources)
        if self.depth == 2:
            self._boxes.to_planes(e.in_y.buffer, self._lines, self._boxed, b.all_sources)

    def render(self, spectra, image):
        self._composition.compose(self._boxed, spectra, self._frame)
        if self.depth == 1:
            self._executor.in_rows(self._n_images * self._executor.n_terms)
        self._executor.render_from_frequencies(ImageBatch.of(image), self._n_images)

    def back_project(self, image):
        self._executor.adjoint_to_frequencies(ImageBatch.of(image), self._n_images)
        if self.depth == 1:
            self._executor.back_rows(self._n_images * self._executor.n_terms)

    def gather_spectra(self, d_spectra):
        self._composition.gather_spectra(self._frame, self._boxed, d_spectra)

    def gather_morph(self, spectra, d_morph, active, *, add=False):
        e, d_lines = self._executor, self._d_boxed
        self._composition.gather_boxed(self._frame, spectra, self._d_boxed, active)
        if self.depth == 2:
            d_lines = self._lines  # reused, since the planes have been computed from them
            self._boxes.from_planes(e.in_y_t.buffer, self._d_boxed, d_lines, active)
        self._boxes.from_lines(d_lines, e.in_x.buffer, d_morph, active, add=add)

    def update_shifts(self):
        """Nothing to do, as for FrameRendering."""


class _Boxes:
    """The sources' boxes in an operator's tables, and the products that transform them.

    Rows and columns are those of the tables' axes, which may be the model's columns and rows.
    lines, planes: Boxes of (rows, k_pad) in (n_y, k_pad), and of all of (k_y, k_pad)
    """

    def __init__(self, buffers, executor):
        b, e, own = buffers, executor, buffers.host_boxes
        self._axes, n = list(e.axes), b.n_sources
        (self._row0, self._column0), (self._rows, self._columns) = (
            part[:, self._axes].astype(np.int64).T for part in (own.origin, own.shape)
        )
        self._buffers, self._executor = b, e
        # frequencies of the sources' own scenes: elements of a row, and those that are not padding
        self._k_y, self._k_x = (k[own.scene % len(k)] for k in (e.k_ys, e.k_xs))
        self._wide = round_up_columns(self._k_x)
        zero = np.zeros(n, np.int32)
        self.lines = Boxes(
            own.scene,
            np.stack([self._row0, zero], axis=1),
            np.stack([self._rows, self._wide], axis=1),
        )

    @functools.cached_property
    def planes(self):
        scene, shape = self._buffers.host_boxes.scene, np.stack([self._k_y, self._wide], axis=1)
        return Boxes(scene, np.zeros_like(shape), shape)

    def _image(self, letter):
        """Layout of the morphologies as matrix A or C of a product."""
        own = self._buffers.host_boxes
        steps = own.shape[:, 1], 1
        ld, step = steps if self._axes == [0, 1] else steps[::-1]
        return {f"begin_{letter}": own.offset, f"ld_{letter}": ld, f"next_{letter}": step}

    def _begin(self, table, elements):
        """First element of a table's part, (S,): that of the source's scene, `elements` on."""
        return self._buffers.host_boxes.scene * np.int64(table.stride) + elements

    @functools.cached_property
    def to_lines(self):
        """S_s, Tx[cols_s] -> S_s Tx[cols_s]."""
        e = self._executor
        return BoxedProduct(
            self._buffers,
            strided=self._axes != [0, 1],
            m=self._rows,
            n=self._wide,
            k=self._columns,
            **self._image("a"),
            begin_b=self._begin(e.in_x_t, self._column0 * e.k_pad),
            ld_b=e.k_pad,
            begin_c=self.lines.offset,
            ld_c=self._wide,
        )

    @functools.cached_property
    def to_planes(self):
        """Ty[:, rows_s], lines -> Ty[:, rows_s] lines."""
        e = self._executor
        return BoxedProduct(
            self._buffers,
            m=self._k_y,
            n=self._wide,
            k=self._rows,
            begin_a=self._begin(e.in_y, self._row0),
            ld_a=e.n_y,
            begin_b=self.lines.offset,
            ld_b=self._wide,
            begin_c=self.planes.offset,
            ld_c=self._wide,
        )

    @functools.cached_property
    def from_planes(self):
        """Ty[:, rows_s]^T, planes -> Ty[:, rows_s]^T planes."""
        e = self._executor
        return BoxedProduct(
            self._buffers,
            inward=False,
            m=self._rows,
            n=self._wide,
            k=self._k_y,
            begin_a=self._begin(e.in_y_t, self._row0 * e.k_y),
            ld_a=e.k_y,
            begin_b=self.planes.offset,
            ld_b=self._wide,
            begin_c=self.lines.offset,
            ld_c=self._wide,
        )

    @functools.cached_property
    def from_lines(self):
        """lines, Tx[cols_s]^T -> lines Tx[cols_s]^T, added if requested."""
        e, aligned = self._executor, self._column0 // COLUMN_PAD * COLUMN_PAD
        return BoxedProduct(
            self._buffers,
            ragged=True,
            inward=False,
            m=self._rows,
            n=self._columns,
            k=self._k_x,
            begin_a=self.lines.offset,
            ld_a=self._wide,
            begin_b=self._begin(e.in_x, aligned),
            ld_b=row_stride(e.n_x),
            skip=self._column0 - aligned,
            **self._image("c"),
        )
