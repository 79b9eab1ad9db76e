"""The normal matrix of a scene about its solution: modes, spectra and sky in one.

Each component's modes are rendered from its box to the observed pixels that it reaches, by an
operator of these alone, so that the cost follows the sources rather than the frame; components
whose reaches meet have a block of the matrix together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...resampling.plan import Precision, make_plan
from ...resampling.resampler import Resampler
from ...sky.extent import box_slices
from ...sky.psf import PSF
from ..view import WhitenedView, without_dark

# [FWHM of the observation's PSF] How far about its box a component's light is followed: beyond lie
# 1 % of a Moffat profile's light and 1e-4 of its square, which the matrix is made of.
REACH_FWHM = 3.0
# Added to the unit diagonal of the matrix, so that what neither data nor prior know has a number.
RIDGE = 1e-9
# [model px] Departure from an affine mapping that a box of a distorted one may have, as for frames.
TOLERANCE_PX = 1e-4


@dataclass(frozen=True, eq=False)
class Exposure:
    """An observation as the matrix needs it: its view, and what operators of boxes are made of.

    psf_in, psf_out: PSFs of the model and of the view; reach_px [model px]: see REACH_FWHM
    """

    view: WhitenedView
    psf_in: PSF
    psf_out: PSF
    reach_px: float

    @classmethod
    def of(cls, view, frame, observation):
        """That of an Observation and its view."""
        scale = np.sqrt(abs(np.linalg.det(view.mapping.matrix)))
        reach = REACH_FWHM * float(observation.psf.fwhm_px.max()) * scale
        return cls(view, frame.psf, observation.white.psf, reach)

    def observe(self, images, origin, low, size):
        """Unit-spectrum images (k, Co, ry, rx) on `size` observed pixels from `low` on, of images
        (k, ny, nx) in a box of the frame from `origin` on."""
        op, margin = self.view.op, int(np.ceil(self.reach_px)) + 1  # pixels off a model are 0
        images = np.pad(images, ((0, 0), (margin, margin), (margin, margin)))
        mapping = op.plans[0].mapping.window(
            np.asarray(origin) - margin, images.shape[1:], low, size, tolerance_px=TOLERANCE_PX
        )
        plan = make_plan(mapping, self.psf_in, self.psf_out, precision=Precision.of(op.dtype))
        boxed = Resampler.from_plans([plan], dtype=op.dtype, device=op.device, shift=op.shift)
        return boxed.render(without_dark(images.astype(op.dtype)))


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


def normal_matrix(scene, exposures, morphs, modes, spectra, layout):
    """J^T J + prior^-1 (N, N).

    scene: Scene; exposures: an Exposure of each observation
    morphs (n): arrays (ny, nx); modes (n): Modes; spectra (n, C), in the views' units
    """
    matrix = np.zeros((layout.size,) * 2)
    columns = [
        np.concatenate([m.images, s[None]]).astype(np.float32)
        for m, s in zip(modes, morphs, strict=True)
    ]
    channels = scene.channels()
    for exposure, part in zip(exposures, channels, strict=True):
        rows, root = _Rows(scene, exposure, columns), exposure.view.root
        for i, j, c, gram in rows.products():
            block = _Block(layout, i, j, part.start + c)
            block.add(matrix, gram, spectra)
        if layout.n_sky:
            for c in range(part.stop - part.start):
                at = layout.sky(part.start + c)
                matrix[at, at] += (root[c] ** 2).sum()
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

    def __init__(self, scene, exposure, columns):
        self._root = exposure.view.root
        self.low, self.high = _rectangles(scene, exposure.view, exposure.reach_px)
        self.images = [None] * len(columns)
        for i, images in enumerate(columns):
            if (self.high[i] > self.low[i]).all():
                cut = self.low[i], self.high[i] - self.low[i]
                seen = exposure.observe(images, scene.origin[i], *cut)
                self.images[i] = seen * self._root[:, *self._cut(i)].astype(seen.dtype)

    def _cut(self, i):
        return box_slices(self.low[i], self.high[i] - self.low[i])

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
