"""Which pixels of an observation the light of boxes reaches, and what renders it there."""

from __future__ import annotations

import numpy as np

from ...resampling.plan import Precision, make_plan
from ...resampling.transfer import light_reach, wrap_radius
from ...sky.mapping import Around
from .renderer import Renderer

# [model px] Departure from an affine mapping that a box of a distorted one may have, as for frames.
TOLERANCE_PX = 1e-4


class Aim:
    """Renderers for the boxes of slots, one observation of each of B scenes.

    views (B): WhitenedViews; precision: of the operators
    tolerance: part of the PSF's light beyond windows; 0: as little as beyond those of whole frames,
        and these are seen by the view's own operator
    """

    def __init__(self, views, device, dtype, precision: Precision, tolerance):
        self.views, self.device, self.dtype, self.precision = views, device, dtype, precision
        self._exact = not tolerance
        self._plans = plans = [v.op.plans[0] for v in views]
        self._alike = np.unique([id(v.op) for v in views], return_inverse=True)[1]
        self._distorted = np.array([p.geometry == "distorted" for p in plans])
        reaches = {id(p): _reach(p, tolerance) for p in plans}
        self._reach = [reaches[id(p)] for p in plans]
        self._renderers: dict[object, Renderer] = {}

    def runs(self, slots):
        """Slots that share a plan: first, last + 1, their Renderer, or None where nothing is near,
        first pixels (m, 2) of their windows, and by how much (m, 2) [model px] the pixels are off
        the plan's."""
        # on distorted pixels each place has its own plan
        whole = (slots.size == self.views[0].op.shape_in[1:]).all(axis=1) & self._exact
        alone = self._distorted[slots.scene] & ~whole
        key = np.where(alone, -1 - np.arange(len(slots)), self._alike[slots.scene])
        for first, last in slots.runs(key):
            aim = self._at_all if whole[first] else self._at_place if alone[first] else self._about
            yield first, last, *aim(slots, first, last)

    def shares(self, slots, first, last):
        """Shares (m, Co, T) of the operators' terms in the PSFs of slots' sources, None where there
        is one term; see WhitenedView."""
        if self.views[0].shares is None:
            return None
        rows = zip(slots.scene[first:last], slots.components[first:last], strict=True)
        return np.array([self.views[b].shares[c.source] for b, c in rows])

    def _about(self, slots, first, last):
        """What `runs` says of slots whose plan is that of all boxes of their shape."""
        scene, origin = slots.scene[first], slots.origin[first:last]
        plan, view = self._plans[scene], self.views[scene]
        shape = tuple(slots.size[first].tolist())
        small = plan.window(shape, self._reach[scene], self.precision)
        renderer = self._renderer(id(small), lambda: small)
        shift = np.array([self.views[s].op.shift for s in slots.scene[first:last]])
        matrix, offset = plan.mapping.matrix, view.mapping.offset
        off = offset + shift - origin - small.mapping.offset
        low = np.rint(-off @ np.linalg.inv(matrix).T)
        return renderer, low.astype(int), off + low @ matrix.T

    def _at_all(self, slots, first, last):
        """The same for boxes that are the whole frame."""
        op, n = self.views[slots.scene[first]].op, last - first
        renderer = self._renderer(id(op), lambda: op.plans[0], op.executor())
        return renderer, np.zeros((n, 2), int), np.zeros((n, 2))

    def _at_place(self, slots, i, _):
        """The same for one slot of a distorted mapping; no Renderer where nothing is near."""
        scene, origin, shape = slots.scene[i], slots.origin[i], slots.size[i]
        plan, view, reach = self._plans[scene], self.views[scene], self._reach[scene]
        near = view.mapping.positions + view.op.shift
        near = ((near >= origin - reach) & (near <= origin + shape + reach)).all(axis=2)
        rows, columns = (np.flatnonzero(near.any(axis=1 - axis)) for axis in (0, 1))
        if not len(rows):
            return None, (0, 0), view.op.shift[None]
        low = np.array([rows[0], columns[0]])
        size = np.array([rows[-1], columns[-1]]) + 1 - low
        margin = int(np.ceil(reach))

        def at_place():
            cut = plan.mapping.window(
                origin - margin, shape + 2 * margin, low, size, tolerance_px=TOLERANCE_PX
            )
            around = Around.of(cut, shape, margin)
            extent = tuple((shape + reach).tolist())
            given = {"precision": self.precision, "n_terms": plan.n_terms}
            return make_plan(around, *plan.psfs, extent=extent, **given)

        key = int(scene), *origin.tolist(), *shape.tolist()
        return self._renderer(key, at_place), low, view.op.shift[None]

    def _renderer(self, key, plan, executor=None):
        """The Renderer of the plan that `plan()` gives, made once for a key."""
        if key not in self._renderers:
            self._renderers[key] = Renderer(self.device, self.dtype, plan(), executor)
        return self._renderers[key]


def _reach(plan, tolerance):
    """How far [model px] the light of a box is followed; with no tolerance, as far as a plan's
    model is padded for it."""
    psf, matrix = plan.psfs[1], plan.mapping.matrix
    return light_reach(psf, matrix, tolerance) if tolerance else max(wrap_radius(psf, matrix))
