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
    """

    def __init__(self, n_scenes, n_pairs):
        self.n_slots = n_pairs + 1
        shape = n_scenes, self.n_slots, self.n_slots
        self._sy, self._yy = np.zeros(shape), np.zeros(shape)
        # Slots of each scene: the spare one, then from the newest pair to the oldest.
        self._order = np.tile((-np.arange(self.n_slots)) % self.n_slots, (n_scenes, 1))
        self._valid = np.zeros(shape[:2], bool)
        self.used = np.ones(n_scenes, int)

    def subset(self, keep):
        """The pairs of the scenes `keep` (n,) alone."""
        new = LbfgsPairs(len(keep), self.n_slots - 1)
        for name in ("_sy", "_yy", "_order", "_valid", "used"):
            setattr(new, name, getattr(self, name)[keep])
        return new

    @property
    def spare(self):
        """The slot (B,) that takes each scene's next pair."""
        return self._order[:, 0]

    @property
    def count(self):
        """Pairs (B,) of each scene."""
        return self._valid.sum(1)

    def take(self, which, sy, yy):
        """Keeps the new pairs of the scenes `which` (n,) that have positive curvature.

        sy, yy (n, SLOTS): s_k . y and y_k . H y of every slot with the spare one
        """
        slot, i = self.spare[which], np.arange(len(which))
        self._sy[which, :, slot], self._yy[which, :, slot] = sy, yy
        self._yy[which, slot] = yy
        good = sy[i, slot] > MIN_CURVATURE * np.maximum(yy[i, slot], 0)
        kept, slot = which[good], slot[good]
        self._valid[kept, slot] = True
        self._order[kept] = np.roll(self._order[kept], 1, axis=1)
        self._valid[kept, self.spare[kept]] = False
        self.used[kept] = np.minimum(self.used[kept] + 1, self.n_slots)

    def forget(self, which):
        """Drops all pairs of the scenes `which`."""
        self._valid[which] = False

    def coefficients(self, sg, yg):
        """a, c (B, SLOTS) and scale (B,) of the direction, from s_k . g and y_k . H g."""
        b = np.arange(len(sg))[:, None]
        order = self._order[:, 1:]
        valid = self._valid[b, order]
        at = b[:, :, None], order[:, :, None], order[:, None]
        both = valid[:, :, None] & valid[:, None]
        sy, yy = (np.where(both, products[at], 0) for products in (self._sy, self._yy))
        sg, yg = (np.where(valid, v[b, order], 0) for v in (sg, yg))
        own, newest = np.diagonal(sy, axis1=1, axis2=2), np.argmax(valid, axis=1)
        top = own[b[:, 0], newest], yy[b[:, 0], newest, newest]
        scale = np.divide(*top, where=top[1] > 0, out=np.ones(len(sg)))
        # both loops of the recursion are triangular systems
        lower = np.tril(sy) + (~valid)[:, :, None] * np.eye(valid.shape[1])
        a = np.linalg.solve(lower, sg[:, :, None])
        right = own[:, :, None] * a - scale[:, None, None] * (yg[:, :, None] - yy @ a)
        a, c = a[:, :, 0], np.linalg.solve(lower.swapaxes(1, 2), right)[:, :, 0]
        out = np.zeros((2, *self._valid.shape))
        out[0][b, order], out[1][b, order] = a, c
        return out[0], out[1], scale
