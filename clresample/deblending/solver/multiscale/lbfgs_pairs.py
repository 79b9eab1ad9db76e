"""L-BFGS history of each scene on the host: inner products of its (s, y) pairs.

s_k, y_k: changes of the variables and of the gradient; H: the estimated inverse curvature. The
direction d follows from the two-loop recursion from scale H (Nocedal & Wright 2006, algorithm 7.4),
which needs only the inner products s_i . y_j, y_i . H y_j, s_i . g and y_i . H g:
d = scale H (sum_k a_k y_k - g) - sum_k c_k s_k
"""

from __future__ import annotations

import numpy as np

# A pair is stored if s . y exceeds this fraction of y . H y. The ratio is about 1 if H is the
# inverse curvature; far below that, sums in float32 consist of rounding errors.
MIN_CURVATURE = 1e-6


class LbfgsPairs:
    """Pairs (s, y) of B scenes in SLOTS slots each, one of them spare for the next pair.

    used (B,): slots 0 .. used - 1 contain pairs or are spare; kernels skip the others
    count (B,): pairs of each scene
    """

    def __init__(self, n_scenes, n_pairs):
        self.n_slots, one = n_pairs + 1, np.eye(n_pairs)
        # Products of the pairs from the newest to the oldest: s_i . y_j, j no older than i, and
        # y_i . H y_j. Missing pairs have rows of the unit matrix, and of 0.
        self._none = np.stack([one, 0 * one])
        self._products = np.tile(self._none, (n_scenes, 1, 1, 1))
        # Slots of each scene: the spare one, then from the newest pair to the oldest.
        self._order = np.tile((-np.arange(self.n_slots)) % self.n_slots, (n_scenes, 1))
        self.used, self.count = np.ones(n_scenes, int), np.zeros(n_scenes, int)

    def subset(self, keep):
        """The pairs of the scenes `keep` (n,) alone."""
        new = LbfgsPairs(len(keep), self.n_slots - 1)
        for name in ("_products", "_order", "used", "count"):
            setattr(new, name, getattr(self, name)[keep])
        return new

    @property
    def spare(self):
        """The slot (B,) that takes each scene's next pair."""
        return self._order[:, 0]

    def take(self, which, sy, yy):
        """Keeps the new pairs of the scenes `which` (n,) that have positive curvature.

        sy, yy (n, SLOTS): s_k . y and y_k . H y of every slot with the spare one
        """
        slot, i = self.spare[which], np.arange(len(which))
        good = sy[i, slot] > MIN_CURVATURE * np.maximum(yy[i, slot], 0)
        kept, i = which[good], i[good, None, None]
        count = np.minimum(self.count[kept] + 1, self.n_slots - 1)
        order = self._order[kept]
        there = np.arange(self.n_slots - 1) < count[:, None, None]
        new = np.stack([sy, yy], axis=1)[i, [[0], [1]], order[:, None, :-1]]
        self._products[kept, :, 1:, 1:] = self._products[kept, :, :-1, :-1]
        self._products[kept, :, :, 0] = new = np.where(there, new, 0)
        self._products[kept, 1, 0] = new[:, 1]
        self._order[kept] = order[:, np.arange(-1, self.n_slots - 1)]
        self.count[kept] = count
        self.used[kept] = np.minimum(self.used[kept] + 1, self.n_slots)

    def forget(self, which):
        """Drops all pairs of the scenes `which`."""
        self.count[which], self._products[which] = 0, self._none

    def coefficients(self, sg, yg):
        """a, c (B, SLOTS) and scale (B,) of the direction, from s_k . g and y_k . H g."""
        b, order, products = np.arange(len(sg))[:, None], self._order[:, 1:], self._products
        sy, yy = products[:, 0], products[:, 1]
        there = np.arange(self.n_slots - 1) < self.count[:, None]
        sg, yg = (np.where(there, v[b, order], 0)[:, :, None] for v in (sg, yg))
        own, newest = np.diagonal(sy, axis1=1, axis2=2), yy[:, 0, 0]
        scale = np.divide(own[:, 0], newest, where=newest > 0, out=np.ones(len(sg)))
        # both loops of the recursion are triangular systems
        a = np.linalg.solve(sy, sg)
        right = own[:, :, None] * a - scale[:, None, None] * (yg - yy @ a)
        out = np.zeros((2, len(sg), self.n_slots))
        out[0][b, order] = a[:, :, 0]
        out[1][b, order] = np.linalg.solve(sy.swapaxes(1, 2), right)[:, :, 0]
        return out[0], out[1], scale
