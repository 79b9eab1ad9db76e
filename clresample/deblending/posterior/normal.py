"""The normal matrix of a scene about its solution: modes, spectra and sky in one.

Each component's modes are rendered on the observed pixels that its box reaches, so that the cost
follows the sources rather than the frame: components whose reaches do not meet in an observation
share its renderings, and only those whose reaches meet have a block of the matrix together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.extent import box_slices

# [FWHM of the observation's PSF] How far about its box a component's light is followed: beyond lie
# 1 % of a Moffat profile's light and 1e-4 of its square, which the matrix is made of.
REACH_FWHM = 3.0
# Added to the unit diagonal of the matrix, so that what neither data nor prior know has a number.
RIDGE = 1e-9
# [bytes] Model images of one call of an operator: 16 times as many take a tenth longer on a CPU.
CHUNK = 1 << 22


@dataclass(frozen=True, eq=False)
class Layout:
    """Where unknowns are: modes of all n components, then spectra (n, C), then sky levels (C or 0).

    ends (n + 1,): of the components' modes; n_channels, n_sky; size: of all
    """

    ends: np.ndarray
    n_channels: int
    n_sky: int

    @property
    def size(self) -> int:
        """N."""
        return int(self.ends[-1]) + (len(self.ends) - 1) * self.n_channels + self.n_sky

    def modes(self, i):
        """Unknowns (k,) that are the modes of component i."""
        return np.arange(self.ends[i], self.ends[i + 1])

    def spectrum(self, i):
        """Unknowns (C,) that are the spectrum of component i."""
        return self.ends[-1] + i * self.n_channels + np.arange(self.n_channels)

    def sky(self, c):
        """The unknown that is the level of channel c."""
        return self.size - self.n_sky + c


def normal_matrix(scene, views, reaches, morphs, modes, spectra, layout):
    """J^T J + prior^-1 (N, N).

    scene: Scene; views: WhitenedViews; reaches [model px]: of each view's PSF
    morphs (n): arrays (ny, nx); modes (n): Modes; spectra (n, C), in the views' units
    """
    matrix = np.zeros((layout.size,) * 2)
    columns = [
        np.concatenate([m.images, s[None]]).astype(np.float32)
        for m, s in zip(modes, morphs, strict=True)
    ]
    channels = scene.channels()
    for view, reach, part in zip(views, reaches, channels, strict=True):
        rows = _Rows(scene, view, reach, columns)
        for i, j, c, gram in rows.products():
            block = _Block(layout, i, j, part.start + c)
            block.add(matrix, gram, spectra)
        if layout.n_sky:
            for c in range(part.stop - part.start):
                at = layout.sky(part.start + c)
                matrix[at, at] += (view.root[c] ** 2).sum()
            for i, c, product in rows.levels():
                at, channel = layout.sky(part.start + c), part.start + c
                scaled = np.append(product[:-1] * spectra[i, channel], product[-1])
                own = np.append(layout.modes(i), layout.spectrum(i)[channel])
                matrix[at, own] += scaled
                matrix[own, at] += scaled
    for i, m in enumerate(modes):
        own = layout.modes(i)
        matrix[np.ix_(own, own)] += m.precision
    return matrix


def factor(matrix):
    """lower (N, N) and scale (N,) with matrix = (scale lower) (scale lower)^T, but for RIDGE."""
    scale = np.sqrt(np.diag(matrix))
    scale[scale == 0] = 1
    lower = np.linalg.cholesky(matrix / scale[:, None] / scale + RIDGE * np.eye(len(scale)))
    return lower, scale


@dataclass(frozen=True, eq=False)
class _Block:
    """Where products of components i and j in one channel go."""

    layout: Layout
    i: int
    j: int
    channel: int

    def add(self, matrix, gram, spectra):
        """Add gram (k_i + 1, k_j + 1), of modes and morphologies, times what the model has of each:
        modes come with a spectrum, spectra with the morphology."""
        one, other = (np.append(spectra[s, self.channel] * np.ones(n - 1), 1)
                      for s, n in zip((self.i, self.j), gram.shape, strict=True))  # fmt: skip
        at, to = (
            np.append(self.layout.modes(s), self.layout.spectrum(s)[self.channel])
            for s in (self.i, self.j)
        )
        values = gram * one[:, None] * other
        matrix[np.ix_(at, to)] += values
        if self.i != self.j:
            matrix[np.ix_(to, at)] += values.T


class _Rows:
    """What one observation sees of all components' images, each in a rectangle of its pixels.

    low, high (n, 2): the rectangles; images (n): (k_i + 1, Co, ry, rx), whitened; None where empty
    """

    def __init__(self, scene, view, reach, columns):
        self._root = view.root
        self.low, self.high = _rectangles(scene, view, reach)
        self.images = [None] * len(columns)
        for group in self._groups():
            longest = max(len(columns[i]) for i in group)
            step = max(1, CHUNK // (4 * int(np.prod(scene.shape))))
            parts = {i: [] for i in group}
            for first in range(0, longest, step):
                self._render(scene, view, group, columns, slice(first, first + step), parts)
            for i in group:
                self.images[i] = np.concatenate(parts[i])

    def _render(self, scene, view, group, columns, part, parts):
        """Append what is seen of the images `part` of a group's components to `parts`."""
        n = max(len(columns[i][part]) for i in group)
        stack = np.zeros((n, *scene.shape), np.float32)
        for i in group:
            images = columns[i][part]
            box = box_slices(scene.origin[i], images.shape[1:])
            stack[: len(images), *box] += images
        seen = view.observe(stack)
        for i in group:
            cut = self._cut(i)
            root = self._root[:, *cut].astype(np.float32)
            parts[i].append(seen[: len(columns[i][part]), :, *cut] * root)

    def _cut(self, i):
        return box_slices(self.low[i], self.high[i] - self.low[i])

    def _groups(self):
        """Lists of components whose rectangles do not meet; first come, first served."""
        groups = []
        for i in range(len(self.low)):
            if (self.high[i] <= self.low[i]).any():
                continue
            home = next((g for g in groups if not any(self._meet(i, j) for j in g)), None)
            if home is None:
                groups.append([i])
            else:
                home.append(i)
        return groups

    def _meet(self, i, j):
        low, high = np.maximum(self.low[i], self.low[j]), np.minimum(self.high[i], self.high[j])
        return bool((high > low).all())

    def products(self):
        """(i, j, channel, products (k_i + 1, k_j + 1)) of all pairs i <= j that meet."""
        n = len(self.images)
        for i in range(n):
            for j in range(i, n):
                if self.images[i] is None or self.images[j] is None or not self._meet(i, j):
                    continue
                low = np.maximum(self.low[i], self.low[j])
                size = np.minimum(self.high[i], self.high[j]) - low
                one, other = (
                    self.images[s][:, :, *box_slices(low - self.low[s], size)] for s in (i, j)
                )
                for c in range(one.shape[1]):
                    a, b = (x[:, c].reshape(len(x), -1).astype(np.float64) for x in (one, other))
                    yield i, j, c, a @ b.T

    def levels(self):
        """(i, channel, products (k_i + 1,)) of all components' images with a level of 1."""
        for i, images in enumerate(self.images):
            if images is not None:
                root = self._root[:, *self._cut(i)]
                sums = np.einsum("kcyx,cyx->ck", images.astype(np.float64), root)
                for c, row in enumerate(sums):
                    yield i, c, row


def _rectangles(scene, view, reach):
    """First and one-past-last observed pixels (n, 2) that lie within `reach` of each box."""
    n, m = np.indices(view.mapping.shape_out)
    at = view.mapping.at(n, m) + view.op.shift
    low, high = np.zeros((2, len(scene.profile), 2), int)
    for i, (origin, profile) in enumerate(zip(scene.origin, scene.profile, strict=True)):
        near = ((at >= origin - reach) & (at <= origin + profile.shape + reach)).all(2)
        near &= view.covered
        for axis in (0, 1):
            along = np.flatnonzero(near.any(1 - axis))
            if len(along):
                low[i, axis], high[i, axis] = along[0], along[-1] + 1
    return low, high
