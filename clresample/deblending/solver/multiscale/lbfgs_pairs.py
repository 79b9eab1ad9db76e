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
        sy = self._sy[b[:, :, None], order[:, :, None], order[:, None]]
        yy = self._yy[b[:, :, None], order[:, :, None], order[:, None]]
        sy, yy = (np.where(valid[:, :, None] & valid[:, None], m, 0) for m in (sy, yy))
        own = np.einsum("bkk->bk", sy)
        rho = np.divide(1, own, where=own > 0, out=np.zeros_like(own))
        sg, yg = (np.where(valid, v[b, order], 0) for v in (sg, yg))
        newest = np.argmax(valid, axis=1)
        top = own[b[:, 0], newest], yy[b[:, 0], newest, newest]
        scale = np.divide(*top, where=top[1] > 0, out=np.ones(len(sg)))
        a, c = np.zeros_like(sg), np.zeros_like(sg)
        for i in range(a.shape[1]):
            a[:, i] = rho[:, i] * (sg[:, i] - np.einsum("bj,bj->b", sy[:, i, :i], a[:, :i]))
        yr = scale[:, None] * (yg - np.einsum("bij,bj->bi", yy, a))
        for i in reversed(range(a.shape[1])):
            past = np.einsum("bj,bj->b", sy[:, i + 1 :, i], c[:, i + 1 :])
            c[:, i] = a[:, i] - rho[:, i] * (yr[:, i] + past)
        out = np.zeros((2, *self._valid.shape))
        out[0][b, order], out[1][b, order] = a, np.where(valid, c, 0)
        return out[0], out[1], scale
