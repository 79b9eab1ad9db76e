"""Operators as JAX functions: differentiable by their own adjoint, under jit, grad and vmap."""

from __future__ import annotations

import functools

from .batched import apply_batched, batched_shapes, with_bands
from .optional import require


def as_jax(op):
    """The operator as a function of a JAX array.

    Both directions run on the operator's OpenCL device, in a callback from JAX's CPU backend:
    arrays are copied through the host once each way. The operator is linear, so it is its own
    forward derivative, and its adjoint is the reverse derivative: `jax.jvp`, `jax.vjp`, `jax.grad`,
    `jax.linear_transpose` and second derivatives are exact. `jax.vmap` makes one launch of a batch.

    op: any LinOp (Resampler, TiledResampler, ...) of item shapes shape_in and shape_out
    returns f(x): x (...,) + shape_in -> (...,) + shape_out, arrays of the operator's dtype; of one
        band also (Ny, Nx) -> (My, Mx)

    Raises ImportError without JAX; ValueError for a float64 operator where JAX holds float32 only
    (`jax.config.update("jax_enable_x64", True)` first), and, when called, for other shapes.
    """
    jax = require("jax", "jax")
    if jax.dtypes.canonicalize_dtype(op.dtype) != op.dtype:
        raise ValueError(
            f"op computes in {op.dtype}, JAX holds {jax.dtypes.canonicalize_dtype(op.dtype)}: "
            'call jax.config.update("jax_enable_x64", True), or make op with dtype=np.float32'
        )
    primitive = _primitive()

    def apply(x):
        x = jax.numpy.asarray(x, op.dtype)
        x, is_flat = with_bands(op, x)
        result = primitive.bind(x, op=op, transposed=False)
        return result[0] if is_flat else result

    return apply


@functools.cache
def _primitive():
    """The JAX primitive: x -> A x, or A^T x where `transposed`, of an operator `op`."""
    jax = require("jax", "jax")
    ad, batching, mlir = (
        require(f"jax.interpreters.{name}", "jax") for name in ("ad", "batching", "mlir")
    )
    p = require("jax.extend.core", "jax").Primitive("clresample")

    def called_back(x, *, op, transposed):
        result = jax.ShapeDtypeStruct(batched_shapes(x, op, transposed)[1], op.dtype)
        return jax.pure_callback(functools.partial(apply_batched, op, transposed), result, x)

    def transpose(y, _, *, op, transposed):
        return [p.bind(y, op=op, transposed=not transposed)]

    def batch(args, axes, **of):
        return p.bind(jax.numpy.moveaxis(args[0], axes[0], 0), **of), 0

    p.def_impl(jax.jit(called_back, static_argnames=("op", "transposed")))
    p.def_abstract_eval(
        lambda x, *, op, transposed: jax.core.ShapedArray(
            batched_shapes(x, op, transposed)[1], op.dtype
        )
    )
    ad.deflinear2(p, transpose)
    batching.primitive_batchers[p] = batch
    mlir.register_lowering(p, mlir.lower_fun(called_back, multiple_results=False))
    return p
