"""Images of many components in one observation, each stored within its own window."""

from __future__ import annotations

import numpy as np

from ..sky.box import box_slices, intersect_boxes


class ComponentImages:
    """An array (n, Co, My, Mx) of one image a component, 0 outside of a window each.

    shape: of all; low (n, 2) [px]: first pixels of the windows, which lie inside
    images (n): arrays (Co, ny, nx), of one dtype

    Like an array, it is indexed by components, rendered[i] (Co, My, Mx), converted by np.asarray,
    and has shape, dtype, ndim and len.
    """

    def __init__(self, shape, low, images):
        self.shape, self.low, self.images = tuple(shape), np.asarray(low), list(images)
        self.dtype = np.dtype(np.float64) if not self.images else self.images[0].dtype
        self.ndim = len(self.shape)

    @classmethod
    def of(cls, rendered):
        """The ComponentImages of an array (n, Co, My, Mx), with windows of all pixels."""
        if isinstance(rendered, cls):
            return rendered
        return cls(np.shape(rendered), np.zeros((len(rendered), 2), int), rendered)

    @classmethod
    def cropped(cls, shape, low, images):
        """ComponentImages of windows that may lie partly or wholly outside of the observation."""
        lows, parts = [], []
        for at, image in zip(low, images, strict=True):
            here, there = intersect_boxes((0, 0), shape[2:], at, image.shape[1:])
            lows.append([part.start for part in here])
            parts.append(np.ascontiguousarray(image[:, *there]))
        return cls(shape, np.array(lows).reshape(-1, 2), parts)

    def __len__(self):
        return self.shape[0]

    def __iter__(self):
        return (self._image(i) for i in range(len(self)))

    def __getitem__(self, key):
        i, *more = key if isinstance(key, tuple) else (key,)
        if not isinstance(i, (int, np.integer)):
            return np.asarray(self)[key]
        image = self._image(range(len(self))[i])
        return image[tuple(more)] if more else image

    def __array__(self, dtype=None, copy=None):
        out = np.zeros(self.shape, self.dtype if dtype is None else dtype)
        for i, image in enumerate(self.images):
            out[i, :, *self.window(i)] = image
        return out

    def window(self, *parts, margin=0):
        """Slices (y, x) of the window of all of some components, and of a margin [px] around it."""
        if len(parts) == 1 and not margin:
            return box_slices(self.low[parts[0]], self.images[parts[0]].shape[1:])
        low = np.min([self.low[i] for i in parts], axis=0) - margin
        high = np.max([self.low[i] + self.images[i].shape[1:] for i in parts], axis=0) + margin
        low, high = np.maximum(low, 0), np.minimum(high, self.shape[2:])
        return box_slices(low, high - low)

    def within(self, i, window):
        """Component i's image (Co, ny, nx) on a window (slices y, x), 0 beyond its own."""
        image, low = self.images[i], [part.start for part in window]
        if tuple(window) == self.window(i):
            return image
        shape = [part.stop - part.start for part in window]
        out = np.zeros((self.shape[1], *shape), self.dtype)
        here, there = intersect_boxes(low, shape, self.low[i], image.shape[1:])
        out[:, *here] = image[:, *there]
        return out

    def lit_within(self, i, window):
        """The same, or None where component i has no pixels of its own on the window."""
        pairs = zip(self.window(i), window, strict=True)
        meet = all(max(a.start, b.start) < min(a.stop, b.stop) for a, b in pairs)
        return self.within(i, window) if meet else None

    def total(self, spectra):
        """sum_i spectra[i] rendered[i], (Co, My, Mx); spectra (n, Co)."""
        out = np.zeros(self.shape[1:])
        for i, (a, image) in enumerate(zip(spectra, self.images, strict=True)):
            out[:, *self.window(i)] += a[:, None, None] * image
        return out

    def _image(self, i):
        """Component i's image (Co, My, Mx)."""
        return self.within(i, box_slices((0, 0), self.shape[2:]))


def source_image(result, source, i_observation, window) -> np.ndarray | None:
    """Model (Co, ny, nx) [counts] of one source on a window (slices y, x) of an observation.

    None where it has no light there.
    """
    channels, rendered = result.channel_slices()[i_observation], result.rendered[i_observation]
    total = None
    for i, c in enumerate(result.components):
        if c.source == source and (own := rendered.lit_within(i, window)) is not None:
            image = c.spectrum[channels, None, None] * own
            total = image if total is None else total + image
    return total


def local_chi2(observed, views, channels, spectra, residuals):
    """chi2 per pixel (n,) where each component's light is, by A^2 times its image.

    observed: per view, ComponentImages of n components; channels: slices of the views among all;
    spectra (n, C): A; residuals: per view (Co, My, Mx)
    """
    found, light = np.zeros((2, len(spectra)))
    for view, rendered, left, part in zip(views, observed, residuals, channels, strict=True):
        weight, power = view.sqrt_weights**2, spectra[:, part] ** 2
        chi2 = weight * left**2
        for i, image in enumerate(rendered.images):
            image = image * weight[:, *rendered.window(i)]
            light[i] += power[i] @ image.sum((1, 2))
            found[i] += power[i] @ (image * chi2[:, *rendered.window(i)]).sum((1, 2))
    return found / np.maximum(light, 1e-30)
