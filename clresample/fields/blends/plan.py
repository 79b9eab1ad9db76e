"""Plan of a field's fits: sources, regions, groups."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from ...sky.box import Box, round_up_size
from .cut import FitLimits, cut_blend, fit_bytes
from .search import nearest

# [model px] Sky around a blend's footprint in the box of its fit, which constrains the wings. More
# makes fits slower; less leaves wings without sky.
MARGIN_PX = 8
# [model px] Sides of these boxes are multiples of this number, so that blends share batches: with
# smaller steps there are more batches, with larger ones more sky to compute.
STEP_PX = 16
# Bits of an id for each of a source's row and column, and of the field's number above them.
POSITION_BITS = 20
LARGEST_FIELD = (1 << 63 - 2 * POSITION_BITS) - 1


@dataclass(frozen=True)
class FitRegion:
    """One fit: a blend, or a piece of one that is over the limits.

    number: in the plan; its pixels have the label number + 1; parent: id of the blend
    box: Box of the model's pixels that is fitted
    sources: indices of the plan's sources; siblings: numbers of the other pieces of its blend whose
        boxes meet this one
    pieces: how many pieces its blend was cut into, 1 = not cut; n_blend_sources: sources of the
        blend
    """

    number: int
    parent: int
    box: Box
    sources: tuple[int, ...]
    siblings: tuple[int, ...] = ()
    pieces: int = 1
    n_blend_sources: int = 1


@dataclass(frozen=True, eq=False)
class FitPlan:
    """Sources (S), patches (P) and groups of patches that are fitted side by side.

    positions (S, 2) [px]: (y, x) in the field's model pixels; ids (S,): int64; peaks (S,) [sigma]
    groups: of patch numbers, those predicted to take longest first
    cut_groups: groups of pieces only, which are fitted again with their neighbours' light
        subtracted
    failed_tiles: {tile's number: why it could not be searched}
    hosts (S,): int64, id of the source whose clump each may be, its own where there is none; None =
        their own
    stars: ids of stars with a saturated or masked core, which are fitted as points
    """

    positions: np.ndarray
    ids: np.ndarray
    peaks: np.ndarray
    patches: tuple[FitRegion, ...]
    groups: tuple[tuple[int, ...], ...]
    cut_groups: tuple[tuple[int, ...], ...] = ()
    failed_tiles: dict = field(default_factory=dict)
    hosts: np.ndarray | None = None
    stars: tuple[int, ...] = ()

    @cached_property
    def peak_of(self) -> dict[int, float]:
        """{id: peak} [sigma] of all sources."""
        return dict(zip(self.ids.tolist(), self.peaks.tolist(), strict=True))

    @cached_property
    def host_of(self) -> dict[int, int]:
        """{id: id of its host} of all sources."""
        hosts = self.ids if self.hosts is None else self.hosts
        return dict(zip(self.ids.tolist(), hosts.tolist(), strict=True))

    def to_json(self) -> str:
        """The plan as text for `from_json`, with all digits of floats."""
        return json.dumps(
            {
                "positions": self.positions.tolist(),
                "ids": self.ids.tolist(),
                "peaks": self.peaks.tolist(),
                "patches": [asdict(patch) for patch in self.patches],
                "groups": self.groups,
                "cut_groups": self.cut_groups,
                "failed_tiles": self.failed_tiles,
                "hosts": None if self.hosts is None else self.hosts.tolist(),
                "stars": self.stars,
            }
        )

    def restricted_to(self, core) -> FitPlan:
        """The plan of the sources in a Box: the blends with a source there."""
        inside = core.contains(self.positions)
        parents = {p.parent for p in self.patches if inside[list(p.sources)].any()}

        def kept(groups):
            few = (tuple(n for n in g if self.patches[n].parent in parents) for g in groups)
            return tuple(group for group in few if group)

        return replace(self, groups=kept(self.groups), cut_groups=kept(self.cut_groups))

    @classmethod
    def from_json(cls, text) -> FitPlan:
        """The plan that `to_json` wrote."""
        about = json.loads(text)
        patches = [
            FitRegion(
                **(p | {"box": Box(*p["box"])} | {k: tuple(p[k]) for k in ("sources", "siblings")})
            )
            for p in about["patches"]
        ]
        return cls(
            np.array(about["positions"], float).reshape(-1, 2),
            np.array(about["ids"], np.int64),
            np.array(about["peaks"], float),
            tuple(patches),
            tuple(map(tuple, about["groups"])),
            tuple(map(tuple, about["cut_groups"])),
            about["failed_tiles"],
            about["hosts"] and np.array(about["hosts"], np.int64),
            tuple(about["stars"]),
        )


def source_ids(positions, field_number=0) -> np.ndarray:
    """Ids (S,) int64 of sources at positions (S, 2) [px] of the field's model pixels.

        id = (field number << 40) + (row << 20) + column

    of the source's pixel: the same in every run over the field, whole or in parts. Rows and columns
    are those of the model's grid, modulo 1,048,576: negative ones count from there down. If an id
    is taken, the next free column is used, in the order of the positions.
    """
    at = nearest(positions).astype(np.int64) % (1 << POSITION_BITS)
    base = (int(field_number) << 2 * POSITION_BITS) + (at[:, 0] << POSITION_BITS)
    ids, used = base + at[:, 1], set()
    for i, one in enumerate(ids.tolist()):
        while one in used:
            one += 1
        ids[i] = one
        used.add(one)
    return ids


def make_fit_plan(
    positions,
    peaks,
    footprints,
    region,
    *,
    limits=None,
    field_number=0,
    memory=None,
    n_channels=1,
    most=32,
    hosts=None,
    stars=None,
) -> FitPlan:
    """Blends from sources and the labels of their light, oversized ones cut, in groups by cost.

    positions (S, 2) [px], peaks (S,) [sigma]: blends are numbered in the order of peaks
    footprints: LinkedFootprints of `region`, whose labels are renumbered here: label n + 1 is
        patch n's
    memory [bytes]: limit for the fits of one group; None = no limit; n_channels: of all mosaics
    most: largest number of blends in a group, that of a CPU's batch. Larger groups share launches,
        which take longer than the arithmetic of small blends, but are lost together if their
        worker dies
    hosts (S, 2) [px]: see TileDetections; cut blends keep them with their clumps if the limits
        permit it
    stars (S,): bool, see TileDetections; None = no source is one
    """
    limits = replace(limits or FitLimits(), n_channels=n_channels)
    ids = source_ids(positions, field_number)
    hosts = ids if hosts is None else host_ids(positions, peaks, ids, hosts)
    labels, corner = footprints.labels, np.array(region[:2])
    of_label = _by_label(labels, nearest(positions) - corner)
    made: list[dict] = []
    order = sorted((label for label in of_label if label), key=lambda label: of_label[label][0])
    pending = []
    for label in order:
        sources, box = of_label[label], footprints.boxes[label - 1]
        brightest = max(sources, key=lambda s: (peaks[s], -s))
        own = {"parent": int(ids[brightest]), "n_blend_sources": len(sources)}
        inner = box.relative_to(region)
        inside = labels[inner.slices] == label
        if limits.quick(len(sources), box.grown(MARGIN_PX).area) or len(sources) == 1:
            pending.append((inner, inside, len(made)))
            made.append(own | {"box": box, "sources": tuple(sources)})
            continue
        light = footprints.light[inner.slices]
        local = positions[sources] - box[:2]
        territory, number = cut_blend(light, inside, local, limits, MARGIN_PX, hosts[sources])
        n_pieces = int(number.max()) + 1
        for i, where in enumerate(ndimage.find_objects(territory)):
            part = territory[where] == i + 1
            small = Box(where[0].start, where[1].start, where[0].stop, where[1].stop)
            there = Box(*(np.array(small) + np.array([*box[:2], *box[:2]])).tolist())
            pending.append((there.relative_to(region), part, len(made)))
            few = tuple(s for s, piece in zip(sources, number, strict=True) if piece == i)
            made.append(own | {"box": there, "sources": few, "pieces": n_pieces})
    _number(labels, pending)
    patches = _patches(made)
    groups = _groups(patches, memory, n_channels, most)
    giants = _groups([p for p in patches if p.pieces > 1], memory, n_channels, most)
    points = () if stars is None else tuple(ids[stars].tolist())
    return FitPlan(
        positions, ids, np.asarray(peaks), patches, groups, giants, hosts=hosts, stars=points
    )


def host_ids(positions, peaks, ids, hosts) -> np.ndarray:
    """Ids (S,) int64 of sources' hosts, whose positions (S, 2) [px] are `hosts`.

    Without a source at a host's position, the brightest source with that host is used.
    """
    at = {tuple(p): i for i, p in enumerate(np.asarray(positions).tolist())}
    of_host: dict[tuple, list[int]] = {}
    for i, host in enumerate(np.asarray(hosts).tolist()):
        of_host.setdefault(tuple(host), []).append(i)
    found = np.array(ids)
    for host, members in of_host.items():
        found[members] = ids[at.get(host, max(members, key=lambda i: peaks[i]))]
    return found


def _by_label(labels, at):
    """{label: numbers of the sources} at pixels (S, 2) of labels (Ny, Nx), taken to the edge."""
    at = np.clip(at, 0, np.array(labels.shape) - 1)
    found: dict[int, list[int]] = {}
    for s, label in enumerate(labels[at[:, 0], at[:, 1]].tolist()):
        found.setdefault(label, []).append(s)
    return found


def _number(labels, pending):
    """Writes the numbers of patches, from 1, into labels (Ny, Nx); pending: (Box, mask, number)."""
    labels[:] = 0
    for inner, inside, i in pending:
        labels[inner.slices][inside] = i + 1


def _patches(made):
    """Patches with the boxes of their fits, and the other pieces that each of them meets."""
    boxes = [round_up_size(one["box"].grown(MARGIN_PX), STEP_PX) for one in made]
    of_parent: dict[int, list[int]] = {}
    for i, one in enumerate(made):
        of_parent.setdefault(one["parent"], []).append(i)
    patches = []
    for i, one in enumerate(made):
        others = [k for k in of_parent[one["parent"]] if k != i]
        meet = tuple(k for k in others if boxes[i].intersection(boxes[k]).area)
        patches.append(FitRegion(i, **(one | {"box": boxes[i], "siblings": meet})))
    return tuple(patches)


def predicted_bytes(patch, n_channels) -> float:
    """Memory [bytes] of its fit, see `fit_bytes`."""
    return fit_bytes(len(patch.sources), patch.box.area, n_channels)


def predicted_cost(patch) -> float:
    """Relative time of fits: pixels times sources, and three more for the common part."""
    return patch.box.area * (len(patch.sources) + 3.0)


def _groups(patches, memory, n_channels, most):
    """Numbers of patches in groups of one size of box, the largest first."""
    of_shape: dict[tuple, list[FitRegion]] = {}
    for patch in sorted(patches, key=lambda p: (-predicted_cost(p), p.number)):
        of_shape.setdefault(patch.box.shape, []).append(patch)
    groups = []
    for alike in of_shape.values():
        group, n_bytes = [], 0.0
        for patch in alike:
            more = predicted_bytes(patch, n_channels)
            if group and (len(group) >= most or (memory and n_bytes + more > memory)):
                groups.append(group)
                group, n_bytes = [], 0.0
            group.append(patch)
            n_bytes += more
        groups.append(group)
    groups.sort(key=lambda g: (-sum(map(predicted_cost, g)), g[0].number))
    return tuple(tuple(p.number for p in group) for group in groups)
