"""Peaks inside the light of large galaxies: structure of one object, or sources of their own.

A body is the light of a galaxy much wider than the PSF: the connected pixels above a level L cover
`BODY_AREA` squared widths of the PSF, and the light below L is at least the fraction `WIDE`. For a
star or a small galaxy that fraction is a hundredth. The background B of a peak of height I is the
lower of L and the saddle between peak and body:

    contrast = I / B - 1,    part = (I - B) a / sum of the body's light,

where a is the area of a point source's image. Every disk has peaks at high resolution. The expected
number of unrelated sources in front of or behind a galaxy is n = `CHANCE` times its area. The
rules:

* A peak of low part and of a contrast under `CLUMP` (under `CLUMP` / n if n exceeds 1) is
  structure, not a source: its light belongs to the galaxy's morphology. The smoother the rest of
  the galaxy, the less its peaks can be structure: below `ROUGH` the limit decreases.
* Other peaks up to `MEMBER_PART` are sources in the galaxy's group, clumps or neighbours, unless
  their part is over `CLUMP_PART` and their contrast over `STAR`.
* For all other peaks the galaxy is a background.

The galaxy's own position is the peak nearest to the middle of its body. The middle is the maximum
of the light, clipped at L / 2 and filtered to the width of the body, so that clumps have little
weight.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from .hills import root, saddles, watershed
from .peaks import POINT_AREA

# [FWHM^2] area of a body's highest isophote, FWHM of the PSF: a star reaches it at 1e-3 of its peak
BODY_AREA = 100.0
# [FWHM^2] The same for small galaxies, whose knots cannot be told from fainter neighbours; and part
# of the galaxy's peak up to which they are in its group. Of rows of `simulate field --sky bright`,
# seeds 2 and 3, that are neither in a group nor true sources, 22 are left of 82. Brighter peaks are
# in it up to this contrast: ten of 19 such peaks are sources of their own in `simulate field --sky
# real`, seeds 1 to 6, which no image can tell from knots.
SMALL_AREA, TWIN, TWIN_CONTRAST = 20.0, 0.5, 1.0
# [thresholds] Level of a body from which its peaks can be structure. Little of a fainter body is
# above the noise, so that each of its peaks stays a source.
BRIGHT = 8.0
# [1] light under a body's level, of all that is above OUTLINE of it
WIDE = 0.3
# [1] contrast and part up to which a peak is structure, and part up to which it is in the group
CLUMP, CLUMP_PART, MEMBER_PART = 2.0, 0.03, 0.2
# [1] Median deviation of a galaxy's light from its elliptical rings below which CLUMP decreases,
# with the square, and the least one. It is 0.04 to 0.12 of early-type galaxies with nine
# satellites, 0.18 to 0.34 of clumpy ones in `simulate field --sky bright`, seeds 61 to 63. With
# STEEP in peaks.py, 3 of 100 satellites on other seeds are lost instead of 20, and groups in fields
# have a twentieth more rows.
ROUGH, SMOOTHEST = 0.2, 0.05
# [1] contrast of stars before a galaxy; most knots of simulated disks have less, some up to 86
STAR = 30.0
# [arcsec^-2] sources by chance: 90 on a square arcminute, to i = 26 (simulation/counts.py)
CHANCE = 0.025
# [1] Number of sources by chance on a small galaxy below which its peaks may be in its group: with
# more, neighbours are more frequent than knots. Of 22 peaks in groups in 50 images of Rubin or HSC
# 19 were other sources, at 1.4 to 4"; of 28 in Euclid's, whose small galaxies have a tenth of the
# area, 2 were.
MAX_BY_CHANCE = 0.1
# [1] of a body's level: a peak behind a lower saddle does not belong to the body.
FRINGE = 0.03
# [1] Two bodies are merged if the fainter one's level exceeds the saddle between them by less than
# the first number, and the saddle is at least the second number times the brighter one's level.
SAME_BODY, SAME_LIGHT = 0.4, 0.2
# [1] light of a nucleus in its basin above its saddle: over that of a point as high, and of all of
# the body's. It parts the one pair that overlaps in `simulate field --sky bright` of seeds 1 - 3
# and none of their other 14 bright bodies, nor any of seeds 4 and 5
NUCLEUS_EXTENT, NUCLEUS_PART = 4.0, 0.045
# [1] of a peak's distance from its body, in radii of outlines: nearer by this factor to another
# one, and inside that one's radius, it is the other one's. So are all of the four clumps of seeds
# 1 - 3 that rise from a neighbour's light
NEARER = 0.7
# [1] of a body's level: its outline, down to which its light is added up
OUTLINE = 0.1
# [1] of a body's level, at which light is clipped to find its centre
CENTER_LIGHT = 0.5
# [1] width of the Gaussian under which the centre is sought, in radii of the highest isophote
CENTER_WIDTH = 0.7


@dataclass(frozen=True, eq=False)
class Body:
    """A galaxy's light, that of a large one or, in the second search, of a small one.

    center (2,) [px]: (y, x); level [sigma]: of its highest isophote of the least area
    light [sigma]: all of its light as the peak of a point source; outline: (slices, mask) of it
    clump [1]: contrast up to which peaks are its structure, 0 of a faint one
    member_part [1]: part up to which peaks are in its group
    group: number of the body in whose group it is, of those of one outline: its own, or that of the
        brightest nucleus if its own one rises from their light by less than a clump may
    """

    center: np.ndarray
    level: float
    light: float
    outline: tuple
    clump: float
    member_part: float
    group: int

    @property
    def radius(self) -> float:
        """Radius [px] of a disk of the outline's area."""
        return float(np.sqrt(max(self.outline[1].sum(), 1) / np.pi))

    def distance(self, position) -> float:
        """Distance of a position (2,) [px] from the centre in radii, infinite from faint bodies."""
        away = np.hypot(*(position - self.center))
        return float(away) / self.radius if self.clump > 0 else np.inf

    def contains(self, position) -> bool:
        """Returns True if the outline contains a position (2,) [px]."""
        (rows, columns), mask = self.outline
        y, x = np.rint(position).astype(int) - [rows.start, columns.start]
        return bool(0 <= y < mask.shape[0] and 0 <= x < mask.shape[1] and mask[y, x])

    def without_holes(self) -> Body:
        """With an outline around its holes: a ring's middle is a body of its own, beyond a gap."""
        where, mask = self.outline
        return replace(self, outline=(where, ndimage.binary_fill_holes(mask)))

    def encloses(self, position, image):
        """Returns True if a peak at (2,) [px] of an image is of its group."""
        above = float(image[tuple(np.rint(position).astype(int))]) - self.level
        return self.contains(position) and self.takes(above, self.level)[1]

    def takes(self, above, base):
        """Selects peaks of heights above [sigma] on a base [sigma] that are its structure.

        Also returns whether they are in its group.
        """
        part = above / self.light
        faint = part < CLUMP_PART
        is_member = (part < self.member_part) & (faint | (above < STAR * base))
        return (above < self.clump * base) & faint, is_member


@dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies of an image, and the relation of its peaks to them.

    owners (S,): number of a peak's body, -1 for none; structure (S,) bool: peaks that are not
        sources; contrast (S,): of the peaks
    """

    bodies: tuple[Body, ...] = ()
    owners: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    structure: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    contrast: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def body_at(self, position) -> int:
        """Number of the bright body whose outline contains a position (2,) [px], -1 for none."""
        holding = [i for i, b in enumerate(self.bodies) if b.clump > 0 and b.contains(position)]
        return _owner(self.bodies, holding, np.asarray(position)) if holding else -1

    def group_at(self, position, above, base) -> int:
        """Number of the faint or small body with a peak at (2,) [px] in its group, -1 for none.

        above, base [sigma]: height of the peak, and of the light that it rises from
        """
        for i, body in enumerate(self.bodies):
            if body.clump == 0 and body.contains(position) and body.takes(above, base)[1]:
                return i
        return -1


def small_bodies_of(image, places, fwhm_px, threshold, scale) -> Bodies:
    """The Bodies of small galaxies, down to SMALL_AREA; their peaks stay sources, in groups.

    Peaks over TWIN of the galaxy's own one and over TWIN_CONTRAST are in no group. Arguments are
    those of `bodies_of`.
    """
    found = bodies_of(image, places, fwhm_px, threshold, scale, least=SMALL_AREA)
    tops = np.array([image[tuple(np.rint(b.center).astype(int))] for b in found.bodies])
    at = np.rint(np.asarray(places).reshape(-1, 2)).astype(int)
    own = found.owners >= 0
    heights, limits = image[at[own, 0], at[own, 1]], tops[found.owners[own]]
    is_twin = (heights > TWIN * limits) & (heights < limits)
    owners = found.owners.copy()
    owners[own] = np.where(is_twin & (found.contrast[own] > TWIN_CONTRAST), -1, owners[own])
    return replace(found, owners=owners)


def bodies_of(image, places, fwhm_px, threshold, scale, *, least=BODY_AREA) -> Bodies:
    """The Bodies of a signal-to-noise image.

    image (Ny, Nx) [sigma]: filtered with the PSF; places (S, 2) [px]: its peaks
    fwhm_px [px]: of the PSF; threshold [sigma]: least level of a body
    scale [arcsec]: side of a pixel
    least [FWHM^2]: area of the highest isophote; below BODY_AREA all peaks stay sources
    """
    at = np.rint(np.asarray(places).reshape(-1, 2)).astype(int)
    n, area = len(at), int(least * fwhm_px**2)
    if not n or np.count_nonzero(image > threshold) < area:
        return Bodies((), np.full(n, -1), np.zeros(n, bool), np.zeros(n))
    inside = image > threshold
    inside[at[:, 0], at[:, 1]] = True
    basins = watershed(image, inside, at)
    basin = basins[at[:, 0], at[:, 1]] - 1
    tree = _Tree(image, basins, area)
    for (a, b), height in zip(*saddles(image, basins, heights=True), strict=True):
        tree.join(a, b, height)
    tree.end(threshold)
    number, base = np.array([tree.last(b) for b in tree.body[basin]], int), tree.level[basin]
    heights = image[at[:, 0], at[:, 1]]
    point = POINT_AREA * fwhm_px**2
    found: list[Body] = []
    of_tree = []
    for one in np.unique(number[number >= 0]):
        level = tree.levels[one]
        members = np.flatnonzero((number == one) & (base > FRINGE * level))
        if not len(members):
            continue
        outline = _outline(image, basins, np.unique(basin[members]) + 1, level)
        light = image[outline[0]][outline[1]]
        if np.minimum(light, level).sum() < WIDE * light.sum():
            continue
        bright = least == BODY_AREA and level >= BRIGHT * threshold
        center = _center(image, outline, level, at[members], area, bright)
        nuclei = (
            _nuclei(image, basins, outline[0], at[members], base[members], point) if bright else []
        )
        is_peak = (at[members] == center).all(axis=1).any()
        centers = [center, *nuclei] if is_peak or not nuclei else nuclei
        chance, n_found = CHANCE * scale**2, len(found)
        own = at[members], base[members]
        crowded = least < BODY_AREA and chance * outline[1].sum() >= MAX_BY_CHANCE
        given = level, point, chance, bright, 0.0 if crowded else MEMBER_PART
        found += _divided(image, outline, centers, *given, own, n_found)
        of_tree += [(members, range(n_found, len(found)))]
    owners, structure = np.full(n, -1), np.zeros(n, bool)
    apart = np.ones(n, bool)
    for members, parts in of_tree:
        apart[members] = False
        for i in members:
            owner = _owner(found, parts, at[i])
            is_clump, is_member = found[owner].takes(heights[i] - base[i], base[i])
            structure[i] = is_clump
            owners[i] = owner if is_member else -1
    for i in np.flatnonzero(apart) if found else ():  # such as the knotty side of a disk
        owner = min(range(len(found)), key=lambda k: found[k].distance(at[i]))
        if found[owner].distance(at[i]) < 1:
            is_member = found[owner].takes(heights[i], max(base[i], threshold))[1]
            owners[i] = owner if is_member else -1
    contrast = heights / np.maximum(base, threshold) - 1
    return Bodies(tuple(found), owners, structure, contrast)


def _owner(bodies, parts, position) -> int:
    """Number of the body of a peak at (2,) [px], that rises from some bodies' (parts) light.

    It is the nearest of these, or another one that is far nearer.
    """
    away = [body.distance(position) for body in bodies]
    own, other = min(parts, key=away.__getitem__), int(np.argmin(away))
    return other if away[other] < min(1.0, NEARER * away[own]) else own


def _nuclei(image, basins, where, at, base, point):
    """Peaks at (k, 2) [px], on bases (k,) [sigma], that are nuclei: positions (2,) [px].

    where: slices of the body; point [px]: area of a point source's image
    """
    low = np.array([where[0].start, where[1].start])
    image, basins = image[where], basins[where]
    inside = ((at >= low) & (at < low + image.shape)).all(axis=1)
    at, base = at[inside] - low, base[inside]
    numbers = basins[at[:, 0], at[:, 1]]
    all_light, found = image[np.isin(basins, numbers)].sum(), []
    for place, number, saddle in zip(at, numbers, base, strict=True):
        above = np.maximum(image[basins == number] - saddle, 0).sum()
        height = image[tuple(place)] - saddle
        if above > max(NUCLEUS_EXTENT * point * height, NUCLEUS_PART * all_light):
            found.append((place + low).astype(float))
    return found


def _divided(image, outline, centers, level, point, chance, bright, member_part, peaks, first):
    """The Bodies of an outline, one of each centre (2,) [px]: its pixels nearest to that.

    level [sigma]: of all; point [px]: area of a point source's image; chance [px^-2]: of sources
    by chance; bright: whether peaks on them can be structure; member_part: see Body; peaks: places
    (k, 2) [px] and bases (k,) [sigma] of all; first: number of the first Body
    """
    where, mask = outline
    centers, corner = np.unique(centers, axis=0), np.array([where[0].start, where[1].start])
    y, x = np.indices(mask.shape)
    away = [np.hypot(y - c[0], x - c[1]) for c in centers - corner]
    nearest = np.argmin(away, axis=0)
    heights = image[tuple(np.rint(centers).astype(int).T)]
    places, bases = peaks
    found = []
    for i, center in enumerate(centers):
        base = bases[(places == center).all(axis=1)].max(initial=0.0)
        group = int(heights.argmax()) if heights[i] < (1 + CLUMP) * base else i
        own = mask & (nearest == i)
        clump = 0.0
        if bright:
            rough = max(SMOOTHEST, _roughness(image[where], own, center - corner, level)) / ROUGH
            clump = CLUMP * min(1.0, rough**2, 1 / (chance * mask.sum()))
        light = float(image[where][own].sum()) / point
        found.append(Body(center, level, light, (where, own), clump, member_part, first + group))
    return found


def _roughness(light, mask, center, level):
    """Median deviation [1] of a galaxy's light (Ny, Nx) [sigma] from that of its elliptical rings.

    mask: its pixels; center (2,) [px]; level [sigma]: of its body
    """
    at, values = np.argwhere(mask) - center, light[mask]
    axes = (at.T * np.minimum(values, CENTER_LIGHT * level)) @ at  # peaks have little weight
    axes /= max(np.linalg.det(axes), 1e-12) ** 0.5
    ring = np.rint(np.sqrt(np.sum(at @ np.linalg.pinv(axes) * at, axis=1))).astype(int)
    usual = ndimage.median(values, ring, np.arange(ring.max(initial=0) + 1))
    return float(np.median(np.abs(values / usual[ring] - 1))) if len(ring) else 0.0


class _Tree:
    """Basins merged at decreasing levels; bodies are those that have become wide enough.

    body (n,), level (n,): of each basin the number of its body, -1 for none, and the level at which
    it is part of it; levels: of each body, the highest of those that were joined
    """

    def __init__(self, image, basins, area):
        order = np.argsort(basins, axis=None, kind="stable")
        labels, values = basins.ravel()[order], image.ravel()[order]
        n = int(basins.max())
        ends = np.searchsorted(labels, np.arange(1, n + 2))
        self.area = area
        self.parts = [[np.sort(values[ends[i] : ends[i + 1]])] for i in range(n)]
        self.basins = [[i] for i in range(n)]
        self.parent = np.arange(n)
        self.of_root = [-1] * n
        self.body, self.level = np.full(n, -1), np.zeros(n)
        self.levels: list[float] = []
        self.joined: list[int] = []

    def last(self, number):
        """The number of the body that a body has become part of."""
        while number >= 0 and self.joined[number] != number:
            number = self.joined[number]
        return number

    def join(self, a, b, height):
        """Joins two basins at the height of their saddle."""
        a, b = root(self.parent, a), root(self.parent, b)
        if a == b:
            return
        for one in (a, b):
            self._widen(one, height)
        first, second = self.of_root[a], self.of_root[b]
        if first >= 0 and second >= 0:
            lower = min(self.levels[first], self.levels[second])
            higher = max(self.levels[first], self.levels[second])
            if lower < (1 + SAME_BODY) * height and height > SAME_LIGHT * higher:
                self.joined[second] = first
                self.levels[first] = higher
            elif self.levels[second] > self.levels[first]:  # later basins are of the brighter one
                self.of_root[a] = second
        elif first >= 0 or second >= 0:
            number = max(first, second)
            for i in self.basins[b if first >= 0 else a]:
                self.body[i], self.level[i] = number, height
            self.of_root[a] = number
        self.parent[b] = a
        self.parts[a] += self.parts[b]
        self.basins[a] += self.basins[b]

    def end(self, threshold):
        """Makes bodies of the basins that are wide enough at the threshold."""
        for i in range(len(self.parent)):
            if self.parent[i] == i:
                self._widen(i, threshold)

    def _widen(self, one, height):
        """Makes a body of a root's basins if they are wide enough above a height."""
        if self.of_root[one] >= 0:
            return
        n = sum(len(p) - np.searchsorted(p, height) for p in self.parts[one])
        if n < self.area:
            return
        values = np.concatenate(self.parts[one])
        level = float(np.partition(values, len(values) - self.area)[len(values) - self.area])
        number = len(self.levels)
        self.levels.append(level)
        self.joined.append(number)
        self.of_root[one] = number
        for i in self.basins[one]:
            self.body[i], self.level[i] = number, level


def _outline(image, basins, numbers, level):
    """(slices, mask) of the pixels of some basins above OUTLINE of a level."""
    inside = np.isin(basins, numbers) & (image > OUTLINE * level)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    where = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return where, inside[where]


def _center(image, outline, level, at, area, bright):
    """The peak of those at (k, 2) [px] in the middle of an outline, or the middle itself (2,).

    For a faint body it is the brightest peak.
    """
    where, mask = outline
    radius = np.sqrt(area / np.pi)
    light = np.where(mask, np.minimum(image[where], CENTER_LIGHT * level), 0.0)
    light = ndimage.gaussian_filter(light, CENTER_WIDTH * radius, mode="constant")
    middle = np.unravel_index(light.argmax(), light.shape)
    middle = np.array(middle) + [where[0].start, where[1].start]
    away = np.hypot(*(at - middle).T) / radius
    if not bright:
        return at[int(image[at[:, 0], at[:, 1]].argmax())].astype(float)
    if (away < 1).any():  # the brightest for its distance, since a galaxy fades outwards
        heights = np.log(np.maximum(image[at[:, 0], at[:, 1]], 1e-3))
        return at[int(np.where(away < 1, heights - away, -np.inf).argmax())].astype(float)
    return middle.astype(float)
