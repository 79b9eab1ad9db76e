"""Linear operators: one forward, one adjoint, on device arrays or NumPy arrays in and out."""

from __future__ import annotations

import threading

import numpy as np

from ..device.device import get_device
from ..sky.validation.checks import as_real_array, check_dtype, mask_of


class LinOp:
    """A linear operator between arrays of fixed item shapes, with an optional leading batch axis.

    shape_in, shape_out: shapes of one item, for images (C, Ny, Nx)
    dtype: float32 or float64, of both sides

    The result has the type of the input: a NumPy array, a Quantity in its unit, or a pyopencl
    array, which never touches the host.  If both sides have one band, (Ny, Nx) images may be passed
    without the band axis.  Subclasses implement `_forward` and `_adjoint` on device arrays (B,) +
    shape; both overwrite `out` and leave their input unchanged.

    Safe to use from several threads. An operator has one set of intermediates and staging arrays,
    so a lock admits one call at a time between upload and download; only the cast of NumPy arrays
    to `dtype` runs in parallel. Separate operators for each thread gain nothing else.
    """

    def __init__(self, device, dtype, shape_in, shape_out):
        self.device = get_device(device)
        self.dtype = check_dtype(dtype)
        self.shape_in, self.shape_out = tuple(shape_in), tuple(shape_out)
        self._staged, self._lock = {}, threading.RLock()

    def __repr__(self):
        parts = [_pixels(self.shape_in) + " -> " + _pixels(self.shape_out), *self._about()]
        return f"{type(self).__name__}({', '.join(parts)}, {self.dtype} on {self.device.name})"

    def _about(self):
        """Words of `repr` between shapes and type."""
        return ()

    def __getstate__(self):
        """State for copies, without lock and staging arrays, of which a copy makes its own."""
        return {k: v for k, v in self.__dict__.items() if k not in ("_staged", "_lock")}

    def __setstate__(self, state):
        self.__dict__.update(state, _staged={}, _lock=threading.RLock())

    def forward(self, x, out=None):
        """A x.  x (B,) + shape_in -> (B,) + shape_out, into `out` (of x's kind) if given.

        Raises ValueError for wrong shapes, for complex or too large numbers, for device arrays of
        another dtype, layout or context, and if only one of x and `out` is on the device.
        """
        return self._apply(self._forward, "x", x, out, self.shape_in, self.shape_out)

    def adjoint(self, y, out=None):
        """A^T y.  y (B,) + shape_out -> (B,) + shape_in, into `out` (of y's kind) if given.

        Raises ValueError as `forward` does.
        """
        return self._apply(self._adjoint, "y", y, out, self.shape_out, self.shape_in)

    __call__ = __matmul__ = forward

    def forward_into(self, x, out):
        """Queues out = A x without checks, for loops that reuse the same arrays.

        x (B,) + shape_in, out (B,) + shape_out: C-contiguous arrays of `dtype` on `device`
        """
        with self._lock:
            self._forward(x, out)

    def adjoint_into(self, y, out):
        """Queues out = A^T y without any check; y (B,) + shape_out, out (B,) + shape_in."""
        with self._lock:
            self._adjoint(y, out)

    @property
    def T(self) -> LinOp:
        """The adjoint as an operator."""
        return AdjointLinOp(self)

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
        """out = A x on device arrays (B,) + shape_in and (B,) + shape_out."""
        raise NotImplementedError

    def _adjoint(self, y, out):
        """out = A^T y on device arrays (B,) + shape_out and (B,) + shape_in."""
        raise NotImplementedError

    def _apply(self, run, name, x, out, shape_x, shape_out):
        """`run`, one of the two above, on a caller's array `x`; messages name it `name`."""
        on_device = hasattr(x, "base_data")
        unit = None if on_device or out is not None else getattr(x, "unit", None)
        if unit is not None and hasattr(x, "to_value"):
            return self._apply(run, name, x.to_value(unit), None, shape_x, shape_out) * unit
        if not on_device:
            x = as_real_array(name, x)
        batch, shape_result = _match_shape(name, tuple(x.shape), shape_x, shape_out)
        if out is not None:
            _check_out(name, x, out, on_device, shape_result)
        go = self._on_device if on_device else self._through_host
        return go(run, name, x, out, (batch, *shape_x), (batch, *shape_out), shape_result)

    def _on_device(self, run, name, x, out, batched_x, batched_out, shape_result):
        """`run` on a caller's device arrays, without copies."""
        x = self._checked(name, x)
        if out is None:
            out = self.device.empty(shape_result, self.dtype)
        else:
            out = self._checked("out", out)
        others = {a.queue for a in (x, out)} - {None, self.device.queue}
        for queue in others:  # the caller's queues may still write or read these arrays
            self.device.finish(queue)
        with self._lock:
            run(_shaped(x, batched_x), _shaped(out, batched_out))
        if others:
            self.device.finish()
        return out

    def _through_host(self, run, name, x, out, batched_x, batched_out, shape_result):
        """`run` on a caller's NumPy arrays, through staging arrays on the device."""
        x = _cast(name, x, self.dtype)
        direct = out is None or (out.dtype == self.dtype and out.flags.c_contiguous)
        result = np.empty(shape_result, self.dtype) if out is None or not direct else out
        with self._lock:
            x_device, out_device = self._staging(name, batched_x, batched_out)
            self.device.upload(x, x_device)
            run(x_device, out_device)
            self.device.download(out_device, result)
        if direct:
            return result
        out[...] = result
        return out

    def _checked(self, name, array):
        """A caller's device array, validated. Raises ValueError if kernels cannot read it."""
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


class HostLinOp(LinOp):
    """A linear operator whose arrays are too large for the device: they stay on the host.

    Subclasses implement `_forward` and `_adjoint` on NumPy arrays (B,) + shape of `dtype`.
    """

    def _on_device(self, run, name, *call):
        """Raises an error: device arrays are not accepted."""
        raise ValueError(f"{name} is on the device: {type(self).__name__} takes NumPy arrays")

    def _through_host(self, run, name, x, out, batched_x, batched_out, shape_result):
        """`run` on a caller's NumPy arrays, copied only if dtype or layout require it."""
        x = _cast(name, x, self.dtype).reshape(batched_x)
        direct = out is not None and out.dtype == self.dtype and out.flags.c_contiguous
        direct = direct and not np.may_share_memory(x, out)
        result = out if direct else np.empty(shape_result, self.dtype)
        with self._lock:
            run(x, result.reshape(batched_out))
        if out is None or direct:
            return result
        out[...] = result
        return out


class AdjointLinOp(LinOp):
    """The transpose of an operator, as an operator."""

    def __init__(self, op):
        super().__init__(op.device, op.dtype, op.shape_out, op.shape_in)
        self.op = op

    def _apply(self, *call):
        """Applies the operator's adjoint, on the device or on the host."""
        return self.op._apply(*call)

    def _forward(self, x, out):
        """The operator's adjoint."""
        self.op._adjoint(x, out)

    def _adjoint(self, y, out):
        """The operator itself."""
        self.op._forward(y, out)


def _pixels(shape):
    """An item's shape in words: bands, if more than one, and pixels."""
    *bands, n_y, n_x = (1, *shape) if len(shape) == 1 else shape
    return "".join(f"{n} bands of " for n in bands if n > 1) + f"{n_y} x {n_x} px"


def _match_shape(name, shape, shape_x, shape_out):
    """Number of items in a caller's array of this shape, and the shape of its result.

    shape_x, shape_out: of one item
    """
    if shape == shape_x:
        return 1, shape_out
    if len(shape) == len(shape_x) + 1 and shape[1:] == shape_x and shape[0] > 0:
        return shape[0], (shape[0], *shape_out)
    one_band = shape_x[0] == 1 == shape_out[0] and len(shape_x) == len(shape_out) == 3
    if one_band and shape == shape_x[1:]:
        return 1, shape_out[1:]
    raise ValueError(f"{name} has shape {shape}, expected {shape_x} or (B,) + {shape_x}")


def _check_out(name, x, out, on_device, shape):
    """ValueError unless `out` is an array of x's kind and of the expected shape."""
    if on_device != hasattr(out, "base_data") or not hasattr(out, "shape"):
        raise ValueError(
            f"out is a {_kind(out)}, but {name} a {_kind(x)}: both must be "
            "NumPy arrays or both pyopencl arrays"
        )
    if tuple(out.shape) != shape:
        raise ValueError(f"out has shape {tuple(out.shape)}, expected {shape}")
    if not on_device and (
        out.dtype.kind != "f"
        or not out.flags.writeable
        or mask_of(out) is not None
        or hasattr(out, "unit")
    ):
        kind = "read-only" if not out.flags.writeable else f"of type {out.dtype}"
        raise ValueError(f"out is a {_kind(out)}, {kind}: it must be a plain array of floats")


def _cast(name, x, dtype):
    """A caller's NumPy array in the operator's type and in C order.

    Raises ValueError if its numbers exceed the type's range.
    """
    try:
        with np.errstate(over="raise"):
            return np.ascontiguousarray(x, dtype=dtype)
    except FloatingPointError:
        largest = np.abs(x[np.isfinite(x)]).max()
        raise ValueError(
            f"{name} holds numbers of up to {largest:.3g}, {dtype} holds {np.finfo(dtype).max:.3g} "
            "at most: scale it, or use dtype=float64"
        ) from None


def _kind(array):
    """Full name of an array's class, for messages."""
    return f"{type(array).__module__}.{type(array).__name__}"


def _shaped(array, shape):
    """The array itself or a view; pyopencl takes 15 us for a view, even of the same shape."""
    return array if array.shape == shape else array.reshape(shape)
