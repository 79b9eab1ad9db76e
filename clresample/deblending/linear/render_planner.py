"""Plans the rendering of component boxes: the window that each box reaches, and its operator."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from ...device.rounding import round_up
from ...resampling.plan import Precision, make_resampling_plan
from ...sky.mapping import PaddedMapping, on_wide_pixels
from .placing import place_windows, reach_of, wing_light
from .renderer import BoxRenderer

# [model px] Largest departure from an affine mapping within a box, as for frames.
TOLERANCE_PX = 1e-4
# [px] Sides of windows shared by several plans are multiples of this, so that windows of
# neighbouring scenes have the same size and are reused. With 1 px they are often recomputed; with 8
# px windows have more pixels without light.
SIZE_PX = 4
# Largest number of reaches, the distances from boxes to which light is rendered, and their ratio. A
# box has the smallest at which the light beyond, in the wings of its source's PSF, has a signal to
# noise of less than MISSED_SIGMAS, for a flux of MIN_FLUX [noise of a model pixel] at least, as
# fluxes are unknown at first. In a blend of 38 sources and a star of magnitude 14 with a halo all
# boxes were rendered to the halo's end.
N_REACHES, REACH_RATIO, MISSED_SIGMAS, MIN_FLUX = 14, 0.5**0.5, 0.1, 500.0


@dataclass(frozen=True, eq=False)
class RenderRun:
    """Slots that follow each other and are rendered at once.

    first, last: of the first slot, and of the last plus 1; renderer: None if no pixel is near
    plan_index (m,): index of each one's plan there; low (m, 2): first pixels of their windows
    lit_window (m, 4): first pixels and sizes of the parts of these that light reaches
    offsets_px (m, 2) [px of the boxes]: distance of the pixels from those of the plan
    """

    first: int
    last: int
    renderer: BoxRenderer | None
    plan_index: np.ndarray
    low: np.ndarray
    lit_window: np.ndarray
    offsets_px: np.ndarray


class RenderPlanner:
    """Renderers for the boxes of slots, one observation of each of B scenes.

    views (B): WhitenedViews; precision: of the operators
    tolerance: fraction of the PSF's light beyond windows; 0 = that of whole frames, which are
        rendered with the views' own plans

    Scenes whose plans have the same layout share a renderer for each shape of boxes.
    """

    def __init__(self, views, device, dtype, precision: Precision, tolerance):
        self.views, self.device, self.dtype, self.precision = views, device, dtype, precision
        self.is_exact = not tolerance
        plans = [v.op.plans[0] for v in views]
        self._plans = list({id(p): p for p in plans}.values())
        at = {id(p): i for i, p in enumerate(self._plans)}
        self._plan = np.array([at[id(p)] for p in plans])  # of each scene, among these
        # distorted ones are alone
        layouts = [id(p) if p.geometry == "distorted" else p.layout for p in self._plans]
        self._layout = np.array([layouts.index(layouts[i]) for i in self._plan])
        self._alike = {int(k): np.unique(self._plan[self._layout == k]) for k in self._layout}
        self._distorted = np.array([p.geometry == "distorted" for p in plans])
        ratios = REACH_RATIO ** np.arange(1 if self.is_exact else N_REACHES)
        self._reach = np.array([reach_of(p, tolerance) * ratios for p in self._plans])
        self._wings = self._wings_of_sources()
        self._renderers: dict[object, _WindowRenderer | BoxRenderer] = {}

    def of_scenes(self, scenes) -> RenderPlanner:
        """The planner of some of the scenes (k,), which may repeat, with the same renderers."""
        out = copy(self)
        out.views, out._wings = ([own[b] for b in scenes] for own in (self.views, self._wings))
        for name in ("_plan", "_layout", "_distorted"):
            setattr(out, name, getattr(self, name)[scenes])
        return out

    def _wings_of_sources(self):
        """Per scene the `wing_light` (S or 1, K) of the sources' PSFs, at most."""
        found, each = [], zip(self._plans, self._reach, strict=True)
        beyond = [wing_light(p, reach).reshape(-1, p.n_terms, len(reach)) for p, reach in each]
        for view, i in zip(self.views, self._plan, strict=True):
            shares = 1 if view.coefficients is None else np.abs(view.coefficients)[..., None]
            found.append(np.sum(shares * beyond[i][None], axis=2).max(axis=1))
        return found

    def levels(self, components, flux):
        """Indices (n,) of the components' reaches; flux (n,) [noise of a model pixel]."""
        wings = [self._wings[c.scene] for c in components]
        wings = [own[min(c.source, len(own) - 1)] for own, c in zip(wings, components, strict=True)]
        seen = np.maximum(flux, MIN_FLUX)[:, None] * np.array(wings)
        return np.maximum((seen < MISSED_SIGMAS).sum(axis=1) - 1, 0)

    def allow_wide_pixels(self):
        """Selects scenes (B,) in which boxes may have wide pixels."""
        return ~self._distorted & (not self.is_exact)

    def runs(self, slots, level):
        """Yields the RenderRuns of slots; level (slots,): of their reaches."""
        # on distorted pixels each position has its own plan
        whole = (slots.size == self.views[0].op.shape_in[1:]).all(axis=1) & self.is_exact
        alone = self._distorted[slots.scene] & ~whole
        key = self._layout[slots.scene] * N_REACHES + level
        key = np.where(alone, -1 - np.arange(len(slots)), key)
        for first, last in slots.runs(key):
            aim = self._at_all if whole[first] else self._at_place if alone[first] else self._about
            yield RenderRun(first, last, *aim(slots, first, last, level[first]))

    def shares(self, slots, first, last):
        """Coefficients (m, Co, T) of the operators' terms in the PSFs of slots' sources, or None.

        None where there is one term; see WhitenedView.
        """
        if self.views[0].coefficients is None:
            return None
        rows = zip(slots.scene[first:last], slots.components[first:last], strict=True)
        return np.array([self.views[b].coefficients[c.source] for b, c in rows])

    def _about(self, slots, first, last, level):
        """Renderer and offsets of slots whose plans are those of all boxes of their shape."""
        scene, origin = slots.scene[first:last], slots.origin[first:last]
        shape, plan = tuple(slots.size[first].tolist()), self._plan[scene]
        pixel = int(slots.pixel[first])
        key = int(self._layout[scene[0]]), int(level), shape, pixel
        windows, used = self._renderers.get(key), set(plan.tolist())
        if windows is None or not used <= windows.known:
            members = np.array(sorted(used if windows is None else used | windows.known))
            windows = self._renderers[key] = self._windows(*key, members)
        which = np.searchsorted(windows.members, plan)
        own = {
            s: self.views[s].mapping.offset + self.views[s].op.shift for s in set(scene.tolist())
        }
        placed = np.array([own[s] for s in scene.tolist()])
        off = on_wide_pixels(placed - origin, pixel) - windows.offset[which]
        low, moves = place_windows(off, windows.matrix[which])
        lit = np.concatenate([low, windows.own[which]], axis=1)
        return windows.renderer, which, low - windows.before[which], lit, moves

    def _windows(self, layout, level, shape, pixel, members):
        """The _Windows of the plans `members` for boxes of a shape, of one size for all scenes."""
        own = [
            PaddedMapping.window_size(plan.mapping.on_pixels(pixel), shape, reach[level] / pixel)
            for plan, reach in zip(self._plans, self._reach, strict=True)
        ]
        alike, size = self._alike[layout], None
        if len(alike) > 1:
            most = np.max([own[i] for i in alike], axis=0)
            size = tuple(round_up(most, SIZE_PX).tolist())
        plans = [
            self._plans[i].window(shape, self._reach[i, level], self.precision, size, pixel)
            for i in members
        ]
        renderer = BoxRenderer(self.device, self.dtype, plans)
        return _WindowRenderer(members, renderer, np.array([own[i] for i in members]))

    def _at_all(self, slots, first, last, _):
        """The same for boxes that are the whole frame."""
        scene = slots.scene[first:last]
        layout = self._layout[scene[0]]
        of_layout = self._layout == layout
        members, n = np.unique(self._plan[of_layout]), last - first
        ops = {id(view.op): view.op for view, on in zip(self.views, of_layout, strict=True) if on}
        moves = np.array([self.views[s].op.shift for s in scene])
        executor = None
        if len(ops) == 1:  # its tables are there, with the shift
            executor, moves = ops.popitem()[1].executor(), np.zeros((n, 2))
        key = int(layout), *members.tolist()
        renderer = self._renderer(key, [self._plans[i] for i in members], executor)
        which, low = np.searchsorted(members, self._plan[scene]), np.zeros((n, 2), int)
        return renderer, which, low, np.concatenate([low, low + renderer.size], axis=1), moves

    def _at_place(self, slots, i, _, level):
        """The same for one slot of a distorted mapping; no BoxRenderer where nothing is near."""
        scene, origin, shape = slots.scene[i], slots.origin[i], slots.size[i]
        plan, view = self._plans[self._plan[scene]], self.views[scene]
        reach = self._reach[self._plan[scene], level]
        which, moves = np.zeros(1, int), view.op.shift[None]
        near = view.mapping.positions + view.op.shift
        near = ((near >= origin - reach) & (near <= origin + shape + reach)).all(axis=2)
        rows, columns = (np.flatnonzero(near.any(axis=1 - axis)) for axis in (0, 1))
        if not len(rows):
            nowhere = np.zeros((1, 4), int)
            return None, which, nowhere[:, :2], nowhere, moves
        low = np.array([rows[0], columns[0]])
        size = np.array([rows[-1], columns[-1]]) + 1 - low
        margin = int(np.ceil(reach))
        key = id(view), reach, *origin.tolist(), *shape.tolist()
        renderer = self._renderers.get(key)
        if renderer is None:
            cut = plan.mapping.window(
                origin - margin, shape + 2 * margin, low, size, tolerance_px=TOLERANCE_PX
            )
            around = PaddedMapping.of(cut, shape, margin)
            extent = tuple((shape + reach).tolist())
            given = {"precision": self.precision, "n_terms": plan.n_terms}
            at_place = make_resampling_plan(around, *plan.psfs, extent=extent, **given)
            renderer = self._renderer(key, [at_place])
        return renderer, which, low[None], np.concatenate([low, size])[None], moves

    def _renderer(self, key, plans, executor=None):
        """The BoxRenderer of plans, made once for a key."""
        if key not in self._renderers:
            self._renderers[key] = BoxRenderer(self.device, self.dtype, plans, executor)
        return self._renderers[key]


class _WindowRenderer:
    """Renders boxes of one shape about their middle.

    members (P,): the plans of whole frames that they are windows of, ascending, `known` as a set
    renderer: of them
    offset, matrix: of mappings (P, 2), (P, 2, 2) that begin where the light does
    own (P, 2): pixels that each one's light reaches; before (P, 2): those in front of these
    """

    def __init__(self, members, renderer, own):
        self.members, self.renderer, self.own = members, renderer, own
        self.known = set(members.tolist())
        mappings = [plan.mapping for plan in renderer.plans]
        self.offset = np.array([m.offset for m in mappings])
        self.matrix = np.array([m.matrix for m in mappings])
        self.before = (np.array(renderer.size) - self.own) // 2
        self.offset = self.offset + np.einsum("nij,nj->ni", self.matrix, self.before)
