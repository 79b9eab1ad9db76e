"""Checks that an operator is what it says it is; each raises AssertionError with the figures."""

from __future__ import annotations

import numpy as np

__all__ = ["check_prox"]


def check_prox(prox, penalty, shape, rng, *, step=1.0, convex=True, tolerance=1e-6, n_trials=20):
    """Check p = prox(y) against its definition: p minimises F(z) = step f(z) + |z - y|^2 / 2.

    Optimality: f(p) is finite and F(p) <= F(z) for many z: on the way from p to points where f is
    finite, with single pixels taken from y, from 0 or from these points. If convex, firm
    non-expansiveness: |p1 - p2|^2 <= <p1 - p2, y1 - y2>.

    prox: from an array of `shape` to one, new or its own; penalty: f, a number or inf
    rng: a NumPy Generator; tolerance: of |y|^2, from the arithmetic's rounding
    AssertionError: one of them fails, with its figures
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
    """Images to compare an answer with; those with an infinite penalty do no harm."""
    for q in (y, 0 * y, 2 * p, y.mean() + 0 * y, *points):
        for part in (1e-3, 0.1, 1.0):
            yield p + part * (q - p)
        yield np.where(rng.random(p.shape) < 0.1, q, p)
