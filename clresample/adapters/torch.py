"""Operators as PyTorch functions: autograd through the operator's own adjoint."""

from __future__ import annotations

from .batched import applied
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

    class Applied(torch.autograd.Function):
        """A x, or A^T x where `transposed`; the derivative of each is the other."""

        @staticmethod
        def forward(ctx, x, transposed):
            ctx.transposed = transposed
            result = applied(op, transposed, x.detach().cpu().numpy())
            return torch.from_numpy(result).to(x.device)

        @staticmethod
        def backward(ctx, y):
            return Applied.apply(y, not ctx.transposed), None

    def apply(x):
        if tuple(x.shape[x.ndim - len(op.shape_in) :]) != op.shape_in or x.ndim < len(op.shape_in):
            raise ValueError(f"x has shape {tuple(x.shape)}, expected (...,) + {op.shape_in}")
        if x.dtype != dtype:
            raise ValueError(f"x is {x.dtype}, the operator computes in {dtype}: convert one")
        return Applied.apply(x, False)

    return apply
