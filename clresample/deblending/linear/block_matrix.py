"""Symmetric positive definite matrices in sparse blocks: factors, and parts of the inverse.

Blocks belong to pairs of neighbouring nodes. Nodes with the fewest neighbours are eliminated first,
which causes little fill-in for wide fields: memory and time are proportional to the number of
sources, rather than to its square and cube.
"""

from __future__ import annotations

import heapq

import numpy as np
from scipy.linalg.lapack import dtrtri, dtrtrs

# Added to the unit diagonal of the matrix, so that undetermined unknowns have finite variances.
RIDGE = 1e-9
# The same for matrices that are indefinite without it, which grows fourfold from the first to the
# second. Images in float32, on wide pixels and rendered to 1e-5 leave eigenvalues of -3e-5 in a
# field's blend of two giants and a saturated star, and of -4e-3 in blends of sources that share
# cirrus. Twice the first ridge beyond that is added, so that no eigenvalue is left near 0: flux
# errors are 0.8 to 1.0 of those of the matrix with its negative eigenvalues at 0. In cirrus they
# are 0.1 to 0.5 of the fluxes, of which 14 of 16 lie within two; without the covariances of
# morphologies they were 3 to 100 times too small.
GROWING_RIDGE = 1e-6, 0.1


class BlockMatrix:
    """A symmetric matrix of nodes of `sizes` (n,): blocks (size_i, size_j) of pairs i <= j.

    Blocks that were never accessed are zero.
    """

    def __init__(self, sizes):
        self.sizes, self._blocks = np.asarray(sizes, int), {}

    def block(self, i, j):
        """The block of a pair i <= j, to add to."""
        if (i, j) not in self._blocks:
            self._blocks[i, j] = np.zeros((self.sizes[i], self.sizes[j]))
        return self._blocks[i, j]

    def items(self):
        """((i, j), block) of all blocks that are not zero."""
        return self._blocks.items()

    def dense(self):
        """All of it (N, N), for tests and small matrices."""
        ends = np.cumsum([0, *self.sizes])
        out = np.zeros((ends[-1],) * 2)
        for (i, j), block in self.items():
            out[ends[i] : ends[i + 1], ends[j] : ends[j + 1]] = block
            out[ends[j] : ends[j + 1], ends[i] : ends[i + 1]] = block.T
        return out


class BlockCholesky:
    """Cholesky's factor of a BlockMatrix, scaled to a unit diagonal, with a ridge added.

    scale (n): arrays, square roots of the diagonal; order (n,): in which nodes are eliminated

    Raises LinAlgError where the matrix is not positive definite by more than rounding: neither with
    RIDGE, nor with the largest of GROWING_RIDGE.
    """

    def __init__(self, matrix: BlockMatrix):
        self.sizes, n = matrix.sizes, len(matrix.sizes)
        self.scale = [_root(np.diag(matrix.block(i, i))) for i in range(n)]
        near: list[set[int]] = [set() for _ in range(n)]
        for i, j in list(dict(matrix.items())):
            if i != j:
                near[i].add(j)
                near[j].add(i)
        self.order, self._later = _eliminated(near, self.sizes)
        ridge, (least, most) = RIDGE, GROWING_RIDGE
        while not self._factorise(matrix, ridge):
            if ridge >= most:
                raise np.linalg.LinAlgError("not positive definite by more than rounding")
            ridge = min(max(least, 4 * ridge), most)
        if ridge > RIDGE:  # away from an eigenvalue that may be all but 0 now
            self._factorise(matrix, 2 * ridge)

    @classmethod
    def restore(cls, sizes, scale, order, later, lower, below) -> BlockCholesky:
        """Restores a BlockCholesky from its attributes and `blocks`.

        sizes (n,), scale (n): arrays; order (n,), later (n): lists of nodes; lower and below:
        {node: block}
        """
        factor = object.__new__(cls)
        factor.sizes, factor.scale, factor.order, factor._later = sizes, scale, order, later
        factor._lower, factor._below = lower, below
        return factor

    @property
    def later(self) -> list[list[int]]:
        """For each node (n), its neighbours that are eliminated later."""
        return self._later

    def blocks(self):
        """Each node's own block of the factor and, if any, the one below, in the order."""
        for v in self.order:
            yield self._lower[v]
            if self._later[v]:
                yield self._below[v]

    def _factorise(self, matrix, ridge):
        """Factorises the matrix with a ridge; returns False if it is not positive definite."""
        place = {node: at for at, node in enumerate(self.order)}
        rest = {}
        for (i, j), block in matrix.items():
            scaled = block / np.outer(self.scale[i], self.scale[j])
            if i == j:
                scaled[np.diag_indices(len(scaled))] += ridge
            late_first = place[i] >= place[j]
            rest[(i, j) if late_first else (j, i)] = scaled if late_first else scaled.T
        self._lower: dict[int, np.ndarray] = {}
        self._below: dict[int, np.ndarray] = {}
        try:
            for v in self.order:
                self._eliminate(v, rest)
        except np.linalg.LinAlgError:
            return False
        return True

    def _eliminate(self, v, rest):
        """Factorises node v's columns and subtracts their products from the rest."""
        later = self._later[v]
        self._lower[v] = lower = np.linalg.cholesky(rest.pop((v, v)))
        if np.isnan(lower).any():  # of a matrix with NaN, of which LAPACK says nothing
            raise np.linalg.LinAlgError("the matrix holds NaN")
        if not later:
            return
        stacked = np.concatenate([rest.pop((u, v)) for u in later])
        self._below[v] = below = _solve(lower, stacked.T).T
        ends = self._ends(v)
        for a, u in enumerate(later):
            part = below[: ends[a + 1]] @ below[ends[a] : ends[a + 1]].T
            for b, w in enumerate(later[: a + 1]):
                # u comes after w in the order, so that its rows are below
                piece = part[ends[b] : ends[b + 1]].T
                if (u, w) in rest:
                    rest[u, w] -= piece
                else:
                    rest[u, w] = -piece

    def _ends(self, v):
        return np.cumsum([0, *self.sizes[self._later[v]]]) if self._later[v] else np.zeros(1, int)

    def solve(self, right):
        """H^-1 of arrays (n), one for each node."""
        parts = [r / s for r, s in zip(right, self.scale, strict=True)]
        for v in self.order:
            parts[v] = _solve(self._lower[v], parts[v])
            ends = self._ends(v)
            for a, u in enumerate(self._later[v]):
                parts[u] = parts[u] - self._below[v][ends[a] : ends[a + 1]] @ parts[v]
        return self._upwards(parts)

    def draw(self, normal):
        """H^-1/2 times numbers (N,), node after node: arrays (n) with the inverse as covariance."""
        return self._upwards(np.split(np.asarray(normal, float), np.cumsum(self.sizes)[:-1]))

    def _upwards(self, parts):
        """The transposed factor's inverse of scaled arrays (n), unscaled."""
        out = [np.zeros(0)] * len(parts)
        for v in reversed(self.order):
            right = parts[v]
            if self._later[v]:
                after = np.concatenate([out[u] for u in self._later[v]])
                right = right - self._below[v].T @ after
            out[v] = _solve(self._lower[v], right, transposed=True)
        return [x / s for x, s in zip(out, self.scale, strict=True)]

    def inverse(self) -> BlockMatrix:
        """The blocks of the inverse where the factor has some: of all neighbours.

        Source: K. Takahashi, J. Fagan, M.-S. Chin (1973), Formation of a sparse bus impedance
        matrix, in blocks.
        """
        place = {node: at for at, node in enumerate(self.order)}
        found: dict[tuple[int, int], np.ndarray] = {}

        def get(u, w):
            return found[u, w] if place[u] >= place[w] else found[w, u].T

        for v in reversed(self.order):
            half = dtrtri(self._lower[v].T)[0].T
            own, later = half.T @ half, self._later[v]
            if later:
                step = self._below[v] @ half
                rows = [np.concatenate([get(u, w) for w in later], axis=1) for u in later]
                known = np.concatenate(rows)  # np.block would take most of the time here
                side = -known @ step
                own -= step.T @ side
                for u, part in zip(later, np.split(side, self._ends(v)[1:-1]), strict=True):
                    found[u, v] = part
            found[v, v] = 0.5 * (own + own.T)
        out = BlockMatrix(self.sizes)
        for u, v in found:
            i, j = min(u, v), max(u, v)
            values = found[u, v] if u == i else found[u, v].T
            np.divide(values, np.outer(self.scale[i], self.scale[j]), out=out.block(i, j))
        return out


def _solve(lower, right, *, transposed=False):
    """x of lower x = right, (n,) or (n, r), or of the transposed matrix.

    By LAPACK itself: SciPy's function would copy the matrix and take most of the time of small ones
    for its checks.
    """
    return dtrtrs(lower.T, right, trans=not transposed)[0]


def _root(diagonal):
    scale = np.sqrt(np.maximum(diagonal, 0))
    return np.where(scale > 0, scale, 1)


def _eliminated(near, sizes):
    """Order of elimination, and for each node those of its neighbours that come after it.

    Nodes whose neighbours have the fewest unknowns come first. near (n): sets, which are modified.
    """
    weight = [sum(sizes[u] for u in others) for others in near]
    heap = [(w, v) for v, w in enumerate(weight)]
    heapq.heapify(heap)
    order, later, done = [], [[] for _ in near], set()
    while heap:
        w, v = heapq.heappop(heap)
        if v in done or w != weight[v]:
            continue
        done.add(v)
        order.append(v)
        later[v] = list(near[v])
        for u in near[v]:
            near[u] |= near[v]
            near[u] -= {u, v}
            weight[u] = sum(sizes[x] for x in near[u])
            heapq.heappush(heap, (weight[u], u))
    place = {node: at for at, node in enumerate(order)}
    return order, [sorted(nodes, key=place.get) for nodes in later]
