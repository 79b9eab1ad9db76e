"""Operators as PyTorch functions: autograd through the operator's own adjoint."""

from __future__ import annotations

import numpy as np

from .needed import needed


def as_torch(op):
    """The operator as a function of a torch tensor.

    Both directions run on the operator's OpenCL device; tensors cross the host once each way, so
    they should lie on torch's CPU (others are copied there and back). Derivatives of any order are
    exact: the backward pass is the adjoint, and its own backward pass the operator.

    op: any LinOp (Resampler, TiledResampler, ...) of item shapes shape_in and shape_out
    returns f(x): x (...,) + shape_in -> (...,) + shape_out, tensors of x's dtype and device

    Raises ImportError without torch; ValueError, when called, for other shapes and dtypes.
    """
    torch = needed("torch", "torch")
    dtype = getattr(torch, op.dtype.name)

    def run(call, x, shape_x, shape_result):
        lead = x.shape[: x.ndim - len(shape_x)]
        items = np.ascontiguousarray(x.detach().cpu().numpy()).reshape(-1, *shape_x)
        result = call(items) if len(items) else np.zeros((0, *shape_result), op.dtype)
        return torch.from_numpy(result.reshape(*lead, *shape_result)).to(x.device)

    class Forward(torch.autograd.Function):
        """A x, whose derivative is the adjoint."""

        @staticmethod
        def forward(ctx, x):
            return run(op.forward, x, op.shape_in, op.shape_out)

        @staticmethod
        def backward(ctx, y):
            return Backward.apply(y)

    class Backward(torch.autograd.Function):
        """A^T y, whose derivative is the operator."""

        @staticmethod
        def forward(ctx, y):
            return run(op.adjoint, y, op.shape_out, op.shape_in)

        @staticmethod
        def backward(ctx, x):
            return Forward.apply(x)

    def apply(x):
        if tuple(x.shape[x.ndim - len(op.shape_in) :]) != op.shape_in or x.ndim < len(op.shape_in):
            raise ValueError(f"x has shape {tuple(x.shape)}, expected (...,) + {op.shape_in}")
        if x.dtype != dtype:
            raise ValueError(f"x is {x.dtype}, the operator computes in {dtype}: convert one")
        return Forward.apply(x)

    return apply
