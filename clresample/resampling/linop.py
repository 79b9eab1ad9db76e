"""Linear operators on device arrays: one forward, one adjoint, NumPy in and out where wanted."""

from __future__ import annotations

import numpy as np

from ..device.device import get_device


class LinOp:
    """A linear operator between arrays of fixed item shapes, with an optional leading batch axis.

    shape_in, shape_out: shapes of one item, for images (C, Ny, Nx)
    dtype: float32 or float64, of both sides

    NumPy arrays in give NumPy arrays out; pyopencl arrays in give pyopencl arrays out and never
    touch the host.  Where both sides have one band, (Ny, Nx) images may be given without the band
    axis.  Subclasses implement `_forward` and `_adjoint` on device arrays (B,) + shape; both
    overwrite `out` and leave their input alone.
    """

    def __init__(self, device, dtype, shape_in, shape_out):
        self.device = get_device(device)
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise ValueError(f"dtype is {self.dtype}, allowed are float32 and float64")
        self.shape_in, self.shape_out = tuple(shape_in), tuple(shape_out)
        self._staged = {}

    def forward(self, x, out=None):
        """A x.  x (B,) + shape_in -> (B,) + shape_out, into `out` (of x's kind) if given."""
        return self._apply(self._forward, "x", x, out, self.shape_in, self.shape_out)

    def adjoint(self, y, out=None):
        """A^T y.  y (B,) + shape_out -> (B,) + shape_in, into `out` (of y's kind) if given."""
        return self._apply(self._adjoint, "y", y, out, self.shape_out, self.shape_in)

    __call__ = __matmul__ = forward

    @property
    def T(self) -> LinOp:
        """The adjoint as an operator."""
        return Adjoint(self)

    def as_scipy(self):
        """The operator as a scipy LinearOperator on flat vectors (prod(shape_in),)."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(
            (int(np.prod(self.shape_out)), int(np.prod(self.shape_in))),
            matvec=lambda x: self.forward(x.reshape(self.shape_in)).ravel(),
            rmatvec=lambda y: self.adjoint(y.reshape(self.shape_out)).ravel(),
            dtype=self.dtype,
        )

    def _forward(self, x, out):
        raise NotImplementedError

    def _adjoint(self, y, out):
        raise NotImplementedError

    def _apply(self, run, name, x, out, shape_x, shape_out):
        single = shape_x[0] == 1 == shape_out[0] and len(shape_x) == len(shape_out) == 3
        on_device = hasattr(x, "base_data")
        if not on_device:
            x = np.asarray(x)
            if np.iscomplexobj(x):
                raise ValueError(f"{name} is {x.dtype}, the operator is real ({self.dtype})")
        shape = tuple(x.shape)
        if shape == shape_x:
            batch, shape_result = 1, shape_out
        elif len(shape) == len(shape_x) + 1 and shape[1:] == shape_x and shape[0] > 0:
            batch, shape_result = shape[0], (shape[0], *shape_out)
        elif single and shape == shape_x[1:]:
            batch, shape_result = 1, shape_out[1:]
        else:
            raise ValueError(f"{name} has shape {shape}, expected {shape_x} or (B,) + {shape_x}")
        if out is not None:
            if on_device != hasattr(out, "base_data") or not hasattr(out, "shape"):
                raise ValueError(
                    f"out is a {_kind(out)}, but {name} a {_kind(x)}: both must be "
                    "NumPy arrays or both pyopencl arrays"
                )
            if tuple(out.shape) != shape_result:
                raise ValueError(f"out has shape {tuple(out.shape)}, expected {shape_result}")
        batched_x, batched_out = (batch, *shape_x), (batch, *shape_out)

        if on_device:
            x = self._checked(name, x)
            out = (
                self.device.empty(shape_result, self.dtype)
                if out is None
                else self._checked("out", out)
            )
            others = {a.queue for a in (x, out)} - {None, self.device.queue}
            for queue in others:  # of the caller, who may still write or read there
                queue.finish()
            run(_shaped(x, batched_x), _shaped(out, batched_out))
            if others:
                self.device.finish()
            return out
        x_device, out_device = self._staging(name, batched_x, batched_out)
        self.device.upload(np.ascontiguousarray(x, dtype=self.dtype), x_device)
        run(x_device, out_device)
        if out is None:
            out = np.empty(shape_result, self.dtype)
        if out.dtype == self.dtype and out.flags.c_contiguous:
            self.device.download(out_device, out)
        else:
            out[...] = self.device.get(out_device).reshape(shape_result)
        return out

    def _checked(self, name, array):
        if array.dtype != self.dtype:
            raise ValueError(f"{name} has dtype {array.dtype}, the operator has {self.dtype}")
        if not array.flags.c_contiguous:
            raise ValueError(
                f"{name} has strides {array.strides} for the shape {array.shape}: "
                "a device array must be C-contiguous"
            )
        if array.context != self.device.context:
            raise ValueError(
                f"{name} belongs to an OpenCL context of {array.context.devices}, the "
                f"operator to that of {self.device}: make it with op.device.put"
            )
        return array

    def _staging(self, name, shape_x, shape_out):
        """Device arrays for NumPy callers, kept for the next call with the same shapes."""
        if self._staged.get(name, (None,))[0] != shape_x:
            self._staged[name] = (
                shape_x,
                self.device.empty(shape_x, self.dtype),
                self.device.empty(shape_out, self.dtype),
            )
        return self._staged[name][1:]


def _kind(array):
    return f"{type(array).__module__}.{type(array).__name__}"


def _shaped(array, shape):
    """The array, or a view: pyopencl takes 15 us to make one, even of the same shape."""
    return array if array.shape == shape else array.reshape(shape)


class Adjoint(LinOp):
    """The transpose of an operator, as an operator."""

    def __init__(self, op):
        super().__init__(op.device, op.dtype, op.shape_out, op.shape_in)
        self.op = op

    def _apply(self, *call):
        return self.op._apply(*call)  # frames in tiles stay on the host this way round too

    def _forward(self, x, out):
        self.op._adjoint(x, out)

    def _adjoint(self, y, out):
        self.op._forward(y, out)
