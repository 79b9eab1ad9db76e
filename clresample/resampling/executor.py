"""Base of the executors of all geometries: from a model to its frequencies and back.

    forward   Z = D o (Ty I1 Tx)           both axes to frequencies, then the transfer function
              aligned    I2 = Sy Z Sx
              affine     G = Sy twist(Z Sx),  I2 = gather(G) along each line
              distorted  G = Sy Z Sx,  I2 = gather(G) at each pixel
    adjoint   the same factors transposed, in reverse order

If a band is the sum of T images of the model, one through each PSF of a basis, then Z = sum_t Z_t
with Z_t = D_t o (Ty I1_t Tx) (PSFTerms). The steps after Z are done once.

    I1 (Ny, Nx), I2 (My, Mx): one band of the model and of the observation
    Ty (ky, Ny), Tx (Nx, kx): cos and sin waves at the model's pixels; ky = 2 Hy, kx = 2 Hx
    Z (ky, kx): the frequencies; D o multiplies them by the transfer function, see contract.cl's MIX
    Sy, Sx: waves at the observed rows, columns, lines or pixels

All matrices are real: rows or columns 2i, 2i+1 are the cos and sin parts of frequency i.
"""

from __future__ import annotations

from typing import Self

from ..device.contraction import Contraction, ImageBatch, MatrixBatch
from ..device.mirror_contraction import fourier_contraction, is_supported
from .executor_base.tables import ExecutorTables
from .executor_base.terms import PSFTerms


class Executor(ExecutorTables):
    """Base of the three executors: from a model to its frequencies, and back.

    plans, axes, n_rows: see ExecutorTables
    Subclasses extend scratch_shapes, bind and bind_adjoint, and implement frequencies_to_pixels
    and pixels_to_frequencies
    """

    def __init__(self, device, dtype, plans):
        super().__init__(device, dtype, plans)
        self.terms = PSFTerms(self) if self.n_terms > 1 else None

    def product(self, **options) -> Contraction:
        """A Contraction of the executor's type and tuning."""
        return Contraction(self.device, self.dtype, tuning=self.tuning, **options)

    def waves(self, name, side, **options) -> Contraction:
        """The products with a table of waves, or its transpose, on that side."""
        mirrored = is_supported(self.tuning) and self.mirrored(name)
        given = {"mirrored": mirrored, "tuning": self.tuning}
        return fourier_contraction(self.device, self.dtype, side, **given, **options)

    def clone(self) -> Self:
        other = super().clone()
        other.terms = PSFTerms(other) if self.terms else None
        return other

    def scratch_shapes(self):
        n_half = max(self.n_terms * self.n_y, self.n_rows)
        shapes = {"half": (n_half, self.k_pad), "frequencies": (self.k_y, self.k_pad)}
        return shapes | ({"terms": (self.n_terms * self.k_y, self.k_pad)} if self.terms else {})

    @property
    def model_frequencies(self):
        """The scratch of Z, (n, ky, k_pad), or of the T parts Z_t of each, (n T, ky, k_pad)."""
        return self.scratch["terms" if self.terms else "frequencies"]

    def bind(self):
        """Binds the products at the model's end to the present scratch buffers."""
        half, n = self.matrix("half", self.n_y), self.n_bands * self.n_terms
        z = self.matrix("terms" if self.terms else "frequencies", self.k_y)
        model = ImageBatch.shaped(*self.plans[0].mapping.shape_in).matrix(self.axes)
        # `spread`: an image is transformed once for all bands
        once, shared = self.in_x_t._replace(items_per_matrix=1), half._replace(items_per_matrix=n)
        k_y, k_x = self.k_ys, self.k_xs
        to_columns = self.waves("in_x", "right", strided=self.axes != (0, 1))
        self.in_columns, self.in_columns_once = (
            to_columns.bind(
                *(self.n_y, self.k_x, self.n_x),
                *(model, in_x_t, half),
                n_bands=in_x_t.items_per_matrix,
                own=self.item_sizes(n=k_x),
            )
            for in_x_t in (self.in_x_t._replace(items_per_matrix=n), once)
        )
        d, in_y, own = (
            self.tables(self.transfer),
            self.in_y._replace(items_per_matrix=n),
            self.item_sizes(m=k_y, n=k_x),
        )
        to_rows = self.waves("in_y", "left", epilogue="MIX")
        self.in_rows, self.in_rows_shared = (
            to_rows.bind(self.k_y, self.k_x, self.n_y, in_y, right, z, d, n, own=own)
            for right in (half, shared)
        )
        if self.terms:
            self.terms.bind(self.scratch)

    def bind_adjoint(self):
        """Binds the products of the adjoint."""
        half, n = self.matrix("half", self.n_y), self.n_bands * self.n_terms
        z = self.matrix("terms" if self.terms else "frequencies", self.k_y)
        model = ImageBatch.shaped(*self.plans[0].mapping.shape_in).matrix(self.axes)
        k_y, k_x = self.k_ys, self.k_xs
        in_y_t, in_x = (
            self.in_y_t._replace(items_per_matrix=n),
            self.in_x._replace(items_per_matrix=n),
        )
        self.back_rows = self.waves("in_y", "left", back=True).bind(
            *(self.n_y, self.k_x, self.k_y),
            *(in_y_t, z, half),
            n_bands=n,
            inward=False,
            own=self.item_sizes(n=k_x, k=k_y),
        )
        self.back_columns = self.waves("in_x", "right", back=True, ragged=True).bind(
            *(self.n_y, self.n_x, self.k_x),
            *(half, in_x, model),
            n_bands=n,
            inward=False,
            own=self.item_sizes(k=k_x),
        )

    def forward(self, x: ImageBatch, y: ImageBatch, n, spread=False):
        """I2 from I1: x (n T, Ny, Nx), or (n / n_bands, Ny, Nx) if `spread`, to y (n, My, Mx)."""
        self.model_to_frequencies(x, n, spread)
        self.render_from_frequencies(y, n)

    def adjoint(self, y: ImageBatch, x: ImageBatch, n):
        """The adjoint of `forward`: y (n, My, Mx) to x (n T, Ny, Nx)."""
        self.adjoint_to_frequencies(y, n)
        self.frequencies_to_model(x, n)

    def render_from_frequencies(self, y: ImageBatch, n):
        """I2 of `n` images, y (n, My, Mx), from `model_frequencies`."""
        if self.terms:
            self.terms.add(n)
        self.frequencies_to_pixels(y, n)

    def adjoint_to_frequencies(self, y: ImageBatch, n):
        """Adjoint of `render_from_frequencies`, times conj(D).

        y (n, My, Mx) to `model_frequencies`.
        """
        self.ensure_adjoint()
        self.pixels_to_frequencies(y, n)
        if self.terms:
            self.terms.split(n)

    def frequencies_to_pixels(self, y: ImageBatch, n):
        """I2 of `n` images, y (n, My, Mx), from Z in scratch "frequencies"."""
        raise NotImplementedError

    def pixels_to_frequencies(self, y: ImageBatch, n):
        """Adjoint of `frequencies_to_pixels`, times conj(D) unless there are terms.

        Each term has its own D: y (n, My, Mx) into the same scratch.
        """
        raise NotImplementedError

    def adjoint_options(self) -> dict:
        """Options of the product `to_frequencies`.

        It multiplies its result by conj(D), unless that is left to the terms.
        """
        return {} if self.terms else {"epilogue": "MIX", "adjoint": True}

    def to_frequencies(
        self, product: Contraction, k, left: MatrixBatch, right: MatrixBatch, own_k=None
    ):
        """Queues the product Z = conj(D) o (left right), left (ky, k), right (k, kx).

        Without D where there are terms. product: made with `adjoint_options`; own_k (plans,): k of
        each, if not all's
        """
        z, n = self.matrix("frequencies"), self.n_bands
        d = None if self.terms else self.tables(self.transfer)
        own = self.item_sizes(m=self.k_ys, n=self.k_xs, k=own_k)
        return product.bind(self.k_y, self.k_x, k, left, right, z, d, n, own=own)

    def model_to_frequencies(self, x: ImageBatch, n, spread=False):
        """Z = D o (Ty I1 Tx) for `n` images, into `model_frequencies`.

        spread: there are n / n_bands images, each of them observed in every band
        """
        if spread:
            self.in_columns_once(n // self.n_bands, a=x)
            self.in_rows_shared(n * self.n_terms)
        else:
            self.in_columns(n * self.n_terms, a=x)
            self.in_rows(n * self.n_terms)

    def frequencies_to_model(self, x: ImageBatch, n):
        """I1 = Ty^T Z Tx^T of `n` images, Z in `model_frequencies`: the end of every adjoint."""
        self.back_rows(n * self.n_terms)
        self.back_columns(n * self.n_terms, c=x)
