"""The paper's factorised operator, with the inputs and outputs of Resampler."""

from __future__ import annotations

import functools
import math

import numpy as np

from ...device.contraction import ImageBatch, MatrixBatch
from ...resampling.grid_operator import GridOperator
from ...resampling.plan import count_bands
from ...resampling.transfer import Certificate, wrap_radius
from .factors import PaperFactors
from .sincs import sinc_table, sinc_transfer
from .tables import cos_sin_table, with_transpose


class PaperResampler(GridOperator):
    """Resampling and PSF-difference convolution as one product of two factors, O(N^2 M^2).

        I2(i, l) = sum_u F^i(u) P^l(u)                X = i a + l b + t, the columns a, b of A
        F^i(u) = I1(i a + t - u),    P^l(u) = Pd(l b + u)

    grid_in, psf_in, grid_out, psf_out, dtype, device, shift, tolerance_px, and what can be read
    back: see GridOperator
    n_terms: length of the sum over u; model_axis: the observed axis along i, 0 (y) or 1 (x)

    P2 is interpolated to the model's grid by sincs (eq. `psf_interp`). These sincs, and those of
    aligned grids, are cut off at the padded grid's edge. Results differ from those of `Resampler`
    for this reason only; see docs/schemes.md.
    Raises ValueError for distorted mappings, grids that do not overlap and bands that do not match;
    DeviceError where a factor does not fit on the device.
    Source: eqs. `compact_sinc_sep`, `fast_reconvampling`, `rotation`, `psf_interp`.
    """

    def _prepare(self, mapping, psf_in, psf_out, dtype, device):
        """The transfer function and the factors, multiplied in the cheaper order."""
        if mapping.geometry == "distorted":
            raise ValueError(
                f"grid_out departs from an affine mapping by {mapping.departure_px:.2g} px of "
                "grid_in, more than tolerance_px: the paper's shifts need one matrix for all "
                "pixels; use Resampler, which does not"
            )
        n_bands, self._psfs = count_bands(mapping, psf_in, psf_out), (psf_in, psf_out)
        self._begin(device, dtype, n_bands, [mapping])
        radius = wrap_radius(psf_out, mapping.matrix)
        # nothing wraps, the kernel lies in the grid whole, and K is odd
        n_fft = tuple(
            2 * math.ceil((max(n, r) + r - 1) / 2) + 1
            for n, r in zip(mapping.shape_in, radius, strict=True)
        )
        d, max_gain, floored_power = sinc_transfer(
            self.device, mapping.matrix, psf_in, psf_out, n_fft
        )
        n_frequencies = tuple((k + 1) // 2 for k in n_fft)
        self._certificates = [Certificate(radius, n_fft, n_frequencies, max_gain, floored_power)]
        self._transfer = np.broadcast_to(d, (n_bands, *n_fft))
        factors = AlignedFactors if self.geometry == "aligned" else RotatedFactors
        choices = [factors(self.device, self.dtype, mapping, n_fft, axis) for axis in (0, 1)]
        self._factors = min(choices, key=lambda choice: choice.cost)
        self._factors.prepare()
        self.n_terms, self.model_axis = self._factors.n_terms, self._factors.axis

    def _use_shift(self):
        """Both factors' tables anew."""
        self._factors.set_transfer(self._transfer, self._shift[0])

    def __reduce__(self):
        """Copied and pickled as its mapping and PSFs; the copy makes its factors anew."""
        make = functools.partial(type(self).from_mapping, dtype=self.dtype, device=self.device)
        return functools.partial(make, shift=self._shift[0]), (self.mapping, *self._psfs)

    def _forward(self, x, out):
        """I2 of device arrays: x (B, C, Ny, Nx), out (B, C, My, Mx)."""
        self._run(self._factors.forward, x, out)

    def _adjoint(self, y, out):
        """The transpose of device arrays: y (B, C, My, Mx), out (B, C, Ny, Nx)."""
        self._run(self._factors.adjoint, y, out)

    def _run(self, chain, source, target):
        """Queues the factors `chain`, band by band, on groups of items (B, C, Ny, Nx)."""
        batch, n_bands = source.shape[:2]
        group = min(self._factors.group, batch)
        self._factors.reserve(group)
        for start in range(0, batch, group):
            for band in range(n_bands):
                first = start * n_bands + band
                ends = (ImageBatch.of(array, first, n_bands) for array in (source, target))
                chain(*ends, band, min(group, batch - start))


class AlignedFactors(PaperFactors):
    """Eq. `compact_sinc_sep`: inner index (y, nu_x), y a model row, x the axis that is shifted.

    F = I1^(y, nu_x) exp(2 pi i nu_x X_i),    P = sum_ym Pd^(nu_x, y_m) sinc(Y_l - y - y_m)
    """

    name = "line"

    @staticmethod
    def model_axes(mapping, axis):
        """The model axes of rows and columns: columns are those that the steps i move along."""
        x = axis if mapping.matrix[0, 0] != 0 else 1 - axis
        return 1 - x, x

    def units(self):
        """Model rows as units, of a cos and a sin for each frequency; no 2-D transform."""
        return self.n_y, 2 * self.h_x, 0

    def make_kernels(self, d, shift):
        """The waves of the steps i, and the factors P of each band and slab; see set_transfer."""
        (y, x), matrix = self.axes, self.mapping.matrix
        t = self.mapping.offset + shift
        wave = self.wave_planes(self.k_x, matrix[x, self.axis] * np.arange(self.n_i) + t[x])
        p = np.fft.fftshift(np.fft.ifft(d, axis=1 + y), axes=1 + y).swapaxes(1 + y, 2)
        p = p[:, : self.h_x] * np.where(np.arange(self.h_x) == 0, 1, 2)[:, None] / self.k_x
        p = self.table(np.stack([p.real, -p.imag], axis=2).reshape(len(d), 2 * self.h_x, -1))
        positions = matrix[y, 1 - self.axis] * np.arange(self.n_l) + t[y]
        kernels = [[] for _ in d]
        for slab in self.slabs:
            n_sincs = slab.n_units + self.k_y - 1  # y + y_m: each row of the model one further on
            sincs = self.device.zeros((n_sincs, self.l_pad), self.dtype)
            sinc_table(
                self.device, positions, slab.first - self.k_y // 2, n_sincs, sincs, 1, self.l_pad
            )
            for i, slabs in enumerate(kernels):
                kernel = self.device.zeros((slab.n_rows, self.l_pad), self.dtype)
                self.plain.bind(
                    self.unit_rows,
                    self.n_l,
                    self.k_y,
                    MatrixBatch(p.buffer, p.ld, offset=i * p.stride),
                    MatrixBatch(sincs.base_data, self.l_pad, self.l_pad),
                    MatrixBatch(kernel.base_data, self.l_pad, self.unit_rows * self.l_pad),
                )(slab.n_units)
                slabs.append(with_transpose(self.device, kernel, self.n_l))
        return (wave, wave), kernels  # a line's kernels use the second wave alone

    def analyse(self, x: ImageBatch, n):
        """Cos and sin sums of each model row (n, Ny, 2 Hx), into scratch "half"."""
        self.to_half(n, a=x)

    def synthesise(self, x: ImageBatch, n):
        """The adjoint of `analyse`."""
        self.from_half(n, c=x)


class RotatedFactors(PaperFactors):
    """Eq. `fast_reconvampling` for any affine mapping: inner index (nu_y, nu_x) with nu_y >= 0.

    F = I1^(nu) exp(2 pi i nu.(i a + t)),    P = D(nu) exp(2 pi i nu.(l b))
    """

    name = "plane"

    @staticmethod
    def model_axes(mapping, axis):
        """The model axes of rows and columns: as they are."""
        return 0, 1

    def units(self):
        """Frequencies nu_y as units, of four products of cos and sin for each nu_x."""
        return self.h_y, 4 * self.h_x, 2 * self.h_y

    def prepare(self):
        """Also the transform along the model's columns."""
        super().prepare()
        in_y = cos_sin_table(self.n_y, self.k_y)
        self.in_y, self.in_y_t = self.table(in_y), self.table(in_y.T)

    def make_kernels(self, d, shift):
        """The waves of the steps i, and the factors P of each band and slab; see set_transfer."""
        a, b = self.mapping.matrix[:, self.axis], self.mapping.matrix[:, 1 - self.axis]
        t, k = self.mapping.offset + shift, (self.k_y, self.k_x)
        steps_i, steps_l = np.arange(self.n_i), np.arange(self.n_l)
        waves_i = [self.wave_planes(k[j], a[j] * steps_i + t[j]) for j in (0, 1)]
        # conj(P), so that the sum of products is the real part: conj(D) and the opposite steps
        waves_l = [self.wave_planes(k[j], -b[j] * steps_l) for j in (0, 1)]
        d = d[:, : self.h_y].conj() / (self.k_y * self.k_x)
        d[:, 1:] *= 2  # -nu as well
        plus, minus = d[:, :, : self.h_x], d[:, :, -np.arange(self.h_x)]
        weight = np.where(np.arange(self.h_x) == 0, 0.25, 0.5)  # nu_x = 0 is in both
        kernels = []
        for p, m in zip(plus * weight, minus * weight, strict=True):
            sums = np.empty((self.h_y, 2, self.h_x, 2))  # as the model's: CC, CS; SC, SS
            sums[:, 0, :, 0], sums[:, 0, :, 1] = p.real + m.real, m.imag - p.imag
            sums[:, 1, :, 0], sums[:, 1, :, 1] = -p.imag - m.imag, m.real - p.real
            z = self.table(sums.reshape(2 * self.h_y, -1))
            kernels.append([])
            n_cols = self.whole_lanes(self.n_l)
            for slab in self.slabs:
                kernel = self.device.zeros((slab.n_rows, self.l_pad), self.dtype)
                launch, _ = self.shifts.bind(slab, z, waves_l, kernel, n_cols, self.l_pad, 1)
                launch()
                kernels[-1].append(with_transpose(self.device, kernel, self.n_l))
        return waves_i, kernels

    def bind(self):
        """Also the products between row sums and frequencies."""
        super().bind()
        half, z, k = self.matrix("half"), self.matrix("frequencies"), 2 * self.h_x
        self.to_frequencies = self.plain.bind(self.z_rows, k, self.n_y, self.in_y_t, half, z)
        self.from_frequencies = self.plain.bind(self.n_y, k, self.z_rows, self.in_y, z, half)

    def analyse(self, x: ImageBatch, n):
        """Cos and sin sums along both axes (n, 2 Hy, 2 Hx), into scratch "frequencies"."""
        self.to_half(n, a=x)
        self.to_frequencies(n)

    def synthesise(self, x: ImageBatch, n):
        """The adjoint of `analyse`."""
        self.from_frequencies(n)
        self.from_half(n, c=x)
