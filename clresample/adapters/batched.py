"""An operator, or its adjoint, on host arrays with any number of leading axes."""

from __future__ import annotations

import numpy as np


def with_bands(op, x):
    """Adds the band axis to an image of a one-band operator: (image, True if it was added).

    An image (Ny, Nx) becomes (1, Ny, Nx); others are returned unchanged.
    Raises ValueError for shapes that the operator does not accept.
    """
    shape, expected = tuple(x.shape), op.shape_in
    if len(expected) == 3 and expected[0] == 1 == op.shape_out[0] and shape == expected[1:]:
        return x[None], True
    if len(shape) < len(expected) or shape[len(shape) - len(expected) :] != expected:
        raise ValueError(f"x has shape {shape}, expected (...,) + {expected}")
    return x, False


def batched_shapes(x, op, transposed):
    """Shapes of one item of x, and of the result with all leading axes of x."""
    shape_x, shape_result = op.shape_in, op.shape_out
    if transposed:
        shape_x, shape_result = shape_result, shape_x
    return shape_x, (*x.shape[: x.ndim - len(shape_x)], *shape_result)


def apply_batched(op, transposed, x):
    """A x, or A^T x where `transposed`, all leading axes of the array x as one batch."""
    x = np.ascontiguousarray(x)
    shape_x, shape_result = batched_shapes(x, op, transposed)
    if 0 in x.shape:
        return np.zeros(shape_result, op.dtype)
    run = op.adjoint if transposed else op.forward
    return run(x.reshape(-1, *shape_x)).reshape(shape_result)
