"""Draws components in boxes: positions, sizes and images of the boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...sky.mapping import on_wide_pixels
from ..profiles import (
    GalaxyGaussians,
    GalaxyProfile,
    galaxy_reach,
    wave_light,
)
from ..sersic import N_GAUSSIANS

# [px] Sides of boxes. There are few sizes, since each needs an operator, and components in boxes of
# one size are rendered together. With more sizes, scenes with different pixel grids take a quarter
# more time, and others gain nothing. Beyond the last the sizes double.
BOX_SIDES = (24, 40, 64, 96, 128)
# [noise of a model pixel] Brightness of the profile at the edge of its box, in the channel of
# highest signal to noise. With 0.05 a real HSC blend, of bright galaxies with wide wings, starts
# from other shapes and ends at chi2 of 1.29 instead of 1.19; with 0.02 it does not. Smaller values
# make larger boxes.
EDGE_NOISE_FRACTION = 0.01
# Smallest and largest fraction of a profile's peak at the edge of its box: the first is the
# precision of float32, the second is used before the flux is known.
FAINTEST, BRIGHTEST = 1e-6, 2e-3
# [px] Sides of pixels on which profiles are drawn in boxes beyond the last of BOX_SIDES, the widest
# beyond which no wave has more than a part UNRESOLVED of the light. On wider ones light that the
# frame cuts rings far into it, and nothing is gained: the start of r_e = 64 px takes 3.1 s on the
# model's pixels, 0.4 s with 4 px, 0.5 s with 16.
WIDE_PX, UNRESOLVED = (2, 4), 1e-4


@dataclass(frozen=True, eq=False)
class StartComponent:
    """One component of one scene.

    scene: which; index: of the component in its scene; source: number of its source there
    shape: ComponentProfile; position (2,) [px]
    frame (2,) [px]: the frame's shape
    """

    scene: int
    index: int
    source: int
    shape: object
    position: np.ndarray
    frame: tuple[int, int]


def renumbered(components) -> list[StartComponent]:
    """Renumbers components in their order, from 0 on in each scene."""
    count: dict[int, int] = {}
    out = []
    for c in components:
        out.append(replace(c, index=count.get(c.scene, 0)))
        count[c.scene] = out[-1].index + 1
    return out


def boxes_of(components, thetas, thresholds):
    """Origins and sizes (n, 2, 2) of boxes that hold components down to a part of their peaks.

    They have one of the BOX_SIDES, or the frame's, and lie inside the frame.
    """
    half, smooth = np.zeros((len(components), 2)), _galaxies(components)
    if smooth.any():
        theta, moment = _stacked(components, thetas, smooth)
        half[smooth] = galaxy_reach(theta, moment, thresholds[smooth])
    middle = np.array([c.position for c in components], float).reshape(-1, 2)
    for i in np.flatnonzero(~smooth):
        c = components[i]
        middle[i], half[i] = c.shape.bounding_box(thetas[i], c.position, thresholds[i])
    return _boxes_about(middle, half, np.array([c.frame for c in components]).reshape(-1, 2))


def pixels_of(components, thetas, boxes, wide):
    """Sides (n,) [px] of the pixels on which components are drawn in boxes (n, 2, 2), powers of 2.

    wide (n,): bool, those that may be drawn on wide pixels
    """
    pixels = np.ones(len(components), int)
    large = wide & _galaxies(components) & (boxes[:, 1].max(axis=1) > BOX_SIDES[-1])
    if large.any():
        given = _stacked(components, thetas, large)
        wider = np.array([wave_light(*given, 0.5 / pixel) <= UNRESOLVED for pixel in WIDE_PX])
        pixels[large] *= 2 ** wider.sum(axis=0)
    return pixels


def peaks_of(components, thetas):
    """Values (n,) of the profiles at their middle."""
    out, smooth = np.zeros(len(components)), _galaxies(components)
    if smooth.any():
        theta, moment = _stacked(components, thetas, smooth)
        out[smooth] = GalaxyGaussians(theta, moment).peak.sum(axis=-1)
    for i in np.flatnonzero(~smooth):
        out[i] = components[i].shape.peak
    return out


def _galaxies(components):
    """Selects components (n,) drawn from the parameters of a GalaxyProfile: bool."""
    return np.array([isinstance(c.shape, GalaxyProfile) for c in components], bool)


def _stacked(components, thetas, at):
    """Parameters (k, 4) and PSF moments (k, 2, 2) of the galaxies `at` (n,) bool."""
    at = np.flatnonzero(at)
    moment = np.array([components[i].shape.psf_moment for i in at])
    return np.array([thetas[i] for i in at]), moment


def _boxes_about(middle, half, frame):
    """Origins and sizes (n, 2, 2) of boxes with one of the BOX_SIDES inside frames.

    Middle, half, frame (n, 2).
    """
    need, largest = 2 * np.minimum(half.max(axis=1), frame.max(axis=1)) + 1, BOX_SIDES[-1]
    side = np.array(BOX_SIDES)[np.searchsorted(BOX_SIDES[:-1], need)]
    doubled = largest * 2 ** np.ceil(np.log2(np.maximum(need / largest, 1)))
    side = np.where(need > largest, doubled, side).astype(int)
    size = np.minimum(side[:, None], frame)
    low = np.floor(middle + 0.5).astype(int) - size // 2
    return np.stack([np.clip(low, 0, frame - size), size], axis=1)


def profile_thresholds(brightness):
    """Parts of their peaks (n,) down to which profiles are drawn.

    brightness (n,): these over the noise of a model pixel, in the best channel of each.
    """
    return np.clip(EDGE_NOISE_FRACTION / np.maximum(brightness, 1e-30), FAINTEST, BRIGHTEST)


class ComponentBatch:
    """Components drawn side by side; those of equal boxes and scenes follow each other.

    components (n): any; thetas (n): their parameters; boxes (n, 2, 2) [px]: origins and sizes
    pixels [px]: sides of their pixels, one or (n,)
    slopes: True to draw slopes with the profiles, or bool (n,) for each
    levels (..., n): by which they are ordered, see RenderPlanner.levels

    order (n,): the components in the order of the slots; scene, n_images, pixel (n,), origin (n, 2)
    size (n, 2): of the boxes in their pixels, of which the last may end beyond them
    begin (n,): first element of each slot's images in the device array that `draw` returns
    """

    def __init__(self, components, thetas, boxes, pixels=1, *, slopes, levels=()):
        scene = np.array([c.scene for c in components])
        origin, size = np.reshape(boxes, (-1, 2, 2)).swapaxes(0, 1)
        pixels = np.broadcast_to(pixels, len(components))
        size = -(-size // pixels[:, None])
        count = 1 + slopes * np.array([len(theta) for theta in thetas])
        self.order = order = np.lexsort((scene, *levels, pixels, count, size[:, 1], size[:, 0]))
        self.pixel = pixels[order]
        self.components = [components[i] for i in order]
        self.thetas = [thetas[i] for i in order]
        self.scene, self.n_images = scene[order], count[order]
        self.origin, self.size = origin[order], size[order]
        self.begin, self.n_elements = cumulative_offsets(self.n_images * self.size.prod(axis=1))
        self._lists = {}

    def __len__(self):
        return len(self.order)

    def runs(self, key):
        """First and last + 1 of slots that follow each other, equal in box, n_images, key (n,)."""
        rows = np.column_stack([self.size, self.n_images, self.pixel, key])
        cuts = np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1
        return list(zip([0, *cuts.tolist()], [*cuts.tolist(), len(rows)], strict=True))

    def lists(self, device, scenes):
        """Arrays of `listed_by_scene` of scenes (k,) on the device, where they are put once."""
        key = np.asarray(scenes).tobytes()
        if key not in self._lists:
            found = listed_by_scene(self.scene, scenes)
            self._lists[key] = [device.put(array, np.int32) for array in found]
        return self._lists[key]

    def draw(self, device, dtype, tuning, kept):
        """All images on the device, (n_elements,).

        kept: dict of images of shapes without parameters, which are drawn once
        """
        images = device.empty(self.n_elements, dtype)
        smooth = _galaxies(self.components)
        if smooth.any():
            self._draw_galaxies(smooth, device, dtype, tuning, images)
        runs: dict[int, list] = {}  # first element: images that follow each other
        end = -1
        for i in np.flatnonzero(~smooth):
            c, theta = self.components[i], self.thetas[i]
            key = id(c), *self.origin[i], *self.size[i]
            cut = kept.get(key)
            if cut is None:
                box = self.origin[i], self.size[i]
                cut = c.shape.draw_box(theta, c.position, *box, slopes=self.n_images[i] > 1)
                cut = np.ascontiguousarray(cut, dtype)
            if not len(theta):
                kept[key] = cut
            begin = int(self.begin[i])
            if begin != end:
                first = begin
            runs.setdefault(first, []).append(cut.ravel())
            end = begin + cut.size
        device.put_parts({begin: np.concatenate(run) for begin, run in runs.items()}, images)
        return images

    def _draw_galaxies(self, at, device, dtype, tuning, images):
        """Queues the kernel that draws the slots `at`."""
        table = np.column_stack([self.size, self.n_images, self.begin])[at].astype(np.int32)
        theta, moment = _stacked(self.components, self.thetas, at)
        pixel = self.pixel[at, None]
        theta[:, :1] -= np.log(pixel)
        place = np.array([c.position for c in self.components])[at] - self.origin[at]
        place = on_wide_pixels(place, pixel)
        tallest, widest = self.size[at].max(axis=0).tolist()
        n_images = int(self.n_images[at].max())
        shapes = _shapes(theta, place, moment / pixel[..., None] ** 2, slopes=n_images > 1)
        launch = device.launcher(
            "draw.cl",
            "draw_profiles",
            dtype=dtype,
            local_size=tuning.local_size(3),
            ROWS=tuning.row_loops,
            K=n_images,
            N_GAUSSIANS=N_GAUSSIANS,
        )
        launch(
            (1 if tuning.row_loops else widest, tallest, len(table)),
            table=device.put(table),
            shape=device.put(shapes, dtype),
            images=images,
        )


def _shapes(theta, place, moment, *, slopes):
    """Parameters of galaxies for kernels/draw.cl, see there: (n, 2 + K N)."""
    some = GalaxyGaussians(theta, moment)
    n, k = some.peak.shape
    rows = np.empty((n, k, 20 if slopes else 4))
    np.multiply(some.inverse, [0.5, 1, 0.5], out=rows[..., :3])
    rows[..., 3] = some.peak
    if slopes:
        rows[..., 4:] = some.slopes().reshape(n, k, 16)
    return np.concatenate([place, rows.reshape(n, -1)], axis=1)


def listed_by_scene(of_slots, scenes):
    """Scenes (k,), where each one's slots begin (k + 1,) in a list, and the list, not empty.

    of_slots (slots,): the scene of each slot
    """
    by_scene = np.argsort(of_slots, kind="stable")
    begin, end = (np.searchsorted(of_slots[by_scene], scenes, side) for side in ("left", "right"))
    listed = [by_scene[a:b] for a, b in zip(begin, end, strict=True)]
    return np.asarray(scenes), np.cumsum([0, *map(len, listed)]), np.concatenate([*listed, [0]])


def cumulative_offsets(sizes):
    """Start of each of some arrays that follow each other (n,), and the length of all."""
    ends = np.cumsum(sizes)
    if len(ends) and ends[-1] >= 2**31:
        raise MemoryError(f"{ends[-1]} pixels of profiles at once are more than 2^31 - 1")
    return ends - sizes, int(ends[-1]) if len(ends) else 0
