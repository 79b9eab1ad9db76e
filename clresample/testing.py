"""Checks of adjoints and proximal operators; each raises AssertionError with the figures."""

from __future__ import annotations

import numpy as np

__all__ = ["check_adjoint", "check_prox", "dense"]

# of |A x| |y|: a few dozen roundings of each type, 6e-8 and 1.1e-16; a wrong adjoint is off by more
# than these, a right one of long sums by less
ADJOINT_TOLERANCE = {"float32": 1e-6, "float64": 1e-13}


def check_adjoint(op, rng, *, batch=(), tolerance=None, n_trials=3):
    """Dot test |<A x, y> - <x, A^T y>| <= tolerance |A x| |y|, sums in float64.

    op: has forward, adjoint, shape_in, shape_out and dtype; rng: a NumPy Generator
    batch: leading axes of x and y; tolerance: None takes that of op.dtype
    returns the largest of the left side over |A x| |y|

    Each trial uses two y: a random one, and A x itself, for which a wrong scale shows most.
    Raises AssertionError, with both sides, if the test fails.
    """
    if tolerance is None:
        tolerance = ADJOINT_TOLERANCE[np.dtype(op.dtype).name]
    worst = 0.0
    for _ in range(n_trials):
        x = rng.normal(size=(*batch, *op.shape_in)).astype(op.dtype)
        ax = op.forward(x)
        for y in (rng.normal(size=ax.shape).astype(op.dtype), ax):
            left, right = _dot(ax, y), _dot(x, op.adjoint(y))
            size = np.sqrt(_dot(ax, ax) * _dot(y, y))
            assert size > 0, "A x is zero: nothing to test"
            error = abs(left - right) / size
            assert error <= tolerance, f"<Ax,y> {left}, <x,A^T y> {right}: {error:.1e} of |Ax||y|"
            worst = max(worst, error)
    return worst


def dense(op):
    """The matrix of an operator, one column for each pixel: (prod(shape_out), prod(shape_in))."""
    units = np.eye(int(np.prod(op.shape_in)), dtype=op.dtype)
    return np.stack([op.forward(e.reshape(op.shape_in)).ravel() for e in units], axis=1)


def _dot(a, b):
    """<a, b>, summed in float64."""
    return float(np.vdot(np.asarray(a, np.float64), np.asarray(b, np.float64)))


def check_prox(prox, penalty, shape, rng, *, step=1.0, convex=True, tolerance=1e-6, n_trials=20):
    """Checks p = prox(y) against its definition: p minimises F(z) = step f(z) + |z - y|^2 / 2.

    Optimality: f(p) is finite and F(p) <= F(z) for many z: on the way from p to points where f is
    finite, with single pixels taken from y, from 0 or from these points. If convex, firm
    non-expansiveness: |p1 - p2|^2 <= <p1 - p2, y1 - y2>.

    prox: from an array of `shape` to one, new or its own; penalty: f, a number or inf
    rng: a NumPy Generator; tolerance: of |y|^2, from the arithmetic's rounding

    Raises AssertionError, with the values compared, if one of the tests fails.
    """
    values = [rng.normal(size=shape) * rng.choice([0.1, 1, 3]) for _ in range(n_trials)]
    points = [np.array(prox(y.copy()), dtype=float) for y in values]
    for i, (y, p) in enumerate(zip(values, points, strict=True)):
        slack = tolerance * (y**2).sum()
        cost = step * penalty(p)
        assert np.isfinite(cost), f"trial {i}: the answer's penalty is {cost}"
        cost += ((p - y) ** 2).sum() / 2
        for z in _candidates(y, p, points, rng):
            other = step * penalty(z) + ((z - y) ** 2).sum() / 2
            assert cost <= other + slack, f"trial {i}: cost {cost}, but {other} elsewhere"
        if convex:
            y2, p2 = values[i - 1], points[i - 1]
            left, right = ((p - p2) ** 2).sum(), ((p - p2) * (y - y2)).sum()
            slack += tolerance * (y2**2).sum()
            assert left <= right + slack, f"trial {i}: |p1-p2|^2 {left} > {right} <p1-p2, y1-y2>"


def _candidates(y, p, points, rng):
    """Images to compare prox(y) = p with, in random places; some may have an infinite penalty."""
    for q in (y, 0 * y, 2 * p, y.mean() + 0 * y, *points):
        for part in (1e-3, 0.1, 1.0):
            yield p + part * (q - p)
        yield np.where(rng.random(p.shape) < 0.1, q, p)
