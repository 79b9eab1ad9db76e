"""Operators as PyTorch functions: autograd through the operator's own adjoint."""

from __future__ import annotations

from .batched import apply_batched, with_bands
from .optional import require


def as_torch(op):
    """The operator as a function of a torch tensor.

    Both directions run on the operator's OpenCL device. Tensors are copied through the host once
    each way, so they should be on torch's CPU (others are copied there and back). Derivatives of
    any order are exact: the backward pass is the adjoint, and the backward pass of that is the
    operator.

    op: any LinOp (Resampler, TiledResampler, ...) of item shapes shape_in and shape_out
    returns f(x): x (...,) + shape_in -> (...,) + shape_out, tensors of x's dtype and device; of one
        band also (Ny, Nx) -> (My, Mx)

    Raises ImportError without torch; ValueError, when called, for other shapes and dtypes.
    """
    torch = require("torch", "torch")
    dtype = getattr(torch, op.dtype.name)

    class Applied(torch.autograd.Function):
        """A x, or A^T x where `transposed`; the derivative of each is the other."""

        @staticmethod
        def forward(ctx, x, transposed):
            ctx.transposed = transposed
            result = apply_batched(op, transposed, x.detach().cpu().numpy())
            return torch.from_numpy(result).to(x.device)

        @staticmethod
        def backward(ctx, y):
            return Applied.apply(y, not ctx.transposed), None

    def apply(x):
        x, is_flat = with_bands(op, x)
        if x.dtype != dtype:
            raise ValueError(f"x is {x.dtype}, the operator computes in {dtype}: convert one")
        result = Applied.apply(x, False)
        return result[0] if is_flat else result

    return apply
