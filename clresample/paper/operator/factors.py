"""The two factors of the paper's scheme on the device, and the contraction that joins them.

    I2(i, l) = sum_u F^i(u) P^l(u),    F^i(u) = I1(i a + t - u),    P^l(u) = Pd(l b + u)

Both factors are band-limited, so that a sum over the pixels u of the padded grid is exact. By
Parseval's theorem the sum may run over frequencies instead: there a shift is a complex exponential,
and no shifted image needs an inverse transform.  The inner index u still has as many values as
the padded grid has pixels. They are computed slab by slab, so that a slab of F is read back
from the cache.
"""

from __future__ import annotations

from ...device.contraction import Contraction, ImageBatch, MatrixBatch, round_up_columns, row_stride
from ...device.rounding import round_up
from ...device.tuning import Tuning
from .launches import PixelLaunches, ShiftLaunches, SlabLaunches
from .slabs import SHIFT_COST, cut_slabs
from .tables import cos_sin_table, device_matrix, wave_planes


class PaperFactors:
    """The two factors where steps i along observed axis `axis` shift the model, steps l the kernel.

    axes: model axes taken as rows and columns; n_y, n_x and k_y, k_x: their lengths, padded lengths
    n_units, unit_rows: the inner index, n_terms = n_units * unit_rows long
    z_rows: rows of the model's 2-D transform, if there is one
    waves: buffers of the exponentials of the steps i along both model axes
    kernels[band][slab]: the factor P (rows of the slab, l_pad) and its transpose (l, rows)
    Subclasses: name (of the kernels in shift.cl), model_axes, units, make_kernels, analyse and
        synthesise
    """

    name: str

    def __init__(self, device, dtype, mapping, n_fft, axis):
        self.device, self.dtype, self.mapping = device, dtype, mapping
        self.tuning = Tuning.of(device, dtype)
        self.axis, self.axes = axis, self.model_axes(mapping, axis)
        self.n_i, self.n_l = mapping.shape_out[axis], mapping.shape_out[1 - axis]
        self.n_cols, self.l_pad = self.whole_lanes(self.n_i), row_stride(self.n_l)
        self.n_y, self.n_x = (mapping.shape_in[k] for k in self.axes)
        self.k_y, self.k_x = (n_fft[k] for k in self.axes)
        self.h_y, self.h_x = (self.k_y + 1) // 2, (self.k_x + 1) // 2
        self.n_units, self.unit_rows, self.z_rows = self.units()
        self.n_terms = self.n_units * self.unit_rows
        self.cost = self.n_terms * round_up_columns(self.n_i) * (self.n_l + SHIFT_COST)

    def prepare(self):
        """Kernels and the model's transform on the device, and the slabs of the inner index."""
        device, dtype, tuning = self.device, self.dtype, self.tuning
        budget = tuning.slab_bytes // dtype.itemsize
        n_slabs = max(
            -(-self.n_terms * self.n_cols // budget),
            # half of the largest buffer, because a slab may be one unit longer than others
            -(-self.n_terms * self.l_pad * dtype.itemsize // (device.max_alloc // 2)),
        )
        self.slabs = cut_slabs(self.n_units, self.unit_rows, n_slabs, tuning.chunk_terms)
        self.slab_rows = max(slab.n_rows for slab in self.slabs)
        self.group = max(1, budget // (self.slab_rows * self.n_cols))
        self.plain = Contraction(device, dtype)
        self.ragged = Contraction(device, dtype, ragged=True)
        self.strided = Contraction(device, dtype, strided=self.axes != (0, 1))
        in_x = cos_sin_table(self.n_x, self.k_x)
        self.in_x, self.in_x_t = self.table(in_x), self.table(in_x.T)
        self.shifts = ShiftLaunches(device, dtype, self.name, self.h_x, tuning.lanes)
        self.pixels = PixelLaunches(
            device, dtype, self.mapping, self.axis, self.n_cols, tuning.lanes
        )
        self.scratch, self.bound = {}, {}

    def set_transfer(self, d, shift):
        """Both factors' tables from the transfer function D (C, Ky, Kx) in FFT order.

        shift (2,) [model px]: moves every observed pixel
        """
        self.bound = {}
        self.waves, self.kernels = self.make_kernels(d, shift)

    def reserve(self, n):
        """Makes room for the intermediates of `n` images at a time."""
        if self.scratch.get("n") == n:
            return
        ld, n_chunks = row_stride(n * self.n_cols), sum(slab.n_chunks for slab in self.slabs)
        shapes = {
            "half": (n, self.n_y, self.in_x.ld),
            "frequencies": (n, self.z_rows, self.in_x.ld),
            "shifted": (self.slab_rows, ld),
            "part": (n_chunks, self.n_l, ld),
        }
        self.scratch, self.bound = {}, {}  # frees the old ones first
        self.scratch = {name: self.device.zeros(s, self.dtype) for name, s in shapes.items()}
        self.bind()
        self.scratch["n"] = n

    def bind(self):
        """Binds the products between the model and its row sums to the present scratch."""
        image = ImageBatch.shaped(*self.mapping.shape_in, every=len(self.kernels))
        image, half, k = image.matrix(self.axes), self.matrix("half"), 2 * self.h_x
        self.to_half = self.strided.bind(self.n_y, k, self.n_x, image, self.in_x, half)
        self.from_half = self.ragged.bind(self.n_y, self.n_x, k, half, self.in_x_t, image)

    def forward(self, x: ImageBatch, y: ImageBatch, band, n):
        """I2(i, l) = sum_u F^i(u) P^l(u) of one band.

        x (n, Ny, Nx): I1; y (n, My, Mx): I2, overwritten
        """
        slabs, (collect, _) = self._launches(band, n)
        self.analyse(x, n)
        for slab in slabs:
            slab.shift()
            slab.product(slab.n_chunks)
        collect(pixels=y.buffer, offset=y.offset, stride=y.stride)

    def adjoint(self, y: ImageBatch, x: ImageBatch, band, n):
        """I1(k) = sum_il I2(i, l) dI2(i, l) / dI1(k) of one band.

        y (n, My, Mx): I2; x (n, Ny, Nx): I1, overwritten
        """
        slabs, (_, spread) = self._launches(band, n)
        spread(pixels=y.buffer, offset=y.offset, stride=y.stride)
        for slab in slabs:
            slab.product_t(1)
            slab.unshift()
        self.synthesise(x, n)

    def analyse(self, x: ImageBatch, n):
        """The frequencies of I1, into scratch "frequencies", or "half" where z_rows is 0."""
        raise NotImplementedError

    def synthesise(self, x: ImageBatch, n):
        """The adjoint of `analyse`."""
        raise NotImplementedError

    def _launches(self, band, n):
        """SlabLaunches of every slab, and Pixels' (collect, spread); bound once for `n` images."""
        if (band, n) not in self.bound:
            z = self.matrix("frequencies" if self.z_rows else "half")
            n_cols, i_chunk, slabs = n * self.n_cols, 0, []
            ld, f = row_stride(n_cols), self.scratch["shifted"]
            part = MatrixBatch(self.scratch["part"].base_data, ld, self.n_l * ld)
            for slab, (kernel, kernel_t) in zip(self.slabs, self.kernels[band], strict=True):
                shift, unshift = self.shifts.bind(slab, z, self.waves, f, self.n_cols, ld, n)
                left = MatrixBatch(kernel_t.base_data, slab.n_rows, slab.chunk)
                right = MatrixBatch(f.base_data, ld, slab.chunk * ld)
                sums = part._replace(offset=i_chunk * part.stride)
                product = self.plain.bind(self.n_l, n_cols, slab.chunk, left, right, sums)
                n_rows, left = (
                    slab.n_units * self.unit_rows,
                    MatrixBatch(kernel.base_data, self.l_pad),
                )
                right, rows = MatrixBatch(part.buffer, ld), MatrixBatch(f.base_data, ld)
                product_t = self.plain.bind(n_rows, n_cols, self.n_l, left, right, rows)
                slabs.append(SlabLaunches(shift, product, slab.n_chunks, product_t, unshift))
                i_chunk += slab.n_chunks
            pixels = self.pixels.bind(self.scratch["part"], i_chunk, ld, n)
            self.bound[band, n] = slabs, pixels
        return self.bound[band, n]

    def matrix(self, name) -> MatrixBatch:
        """Intermediate matrices of all images."""
        array = self.scratch[name]
        return MatrixBatch(array.base_data, array.shape[2], array.shape[1] * array.shape[2])

    def table(self, host) -> MatrixBatch:
        """A host table (rows, columns) or (bands, rows, columns) on the device."""
        return device_matrix(self.device, self.dtype, host)

    def wave_planes(self, k, x):
        """exp(2 pi i nu x) on the device; see tables.wave."""
        return self.device.put(wave_planes(k, x, self.whole_lanes(len(x))), self.dtype).base_data

    def whole_lanes(self, n) -> int:
        """`n` columns rounded up to whole work-items of shift.cl."""
        return round_up(n, self.tuning.lanes)
