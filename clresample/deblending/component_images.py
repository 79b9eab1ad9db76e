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

    def window(self, i):
        """Slices (y, x) of component i's window."""
        return box_slices(self.low[i], self.images[i].shape[1:])

    def within(self, i, window):
        """Component i's image (Co, ny, nx) on a window (slices y, x) that holds its own."""
        image, start = self.images[i], [part.start for part in window]
        if tuple(window) == self.window(i):
            return image
        out = np.zeros((self.shape[1], *(part.stop - part.start for part in window)), self.dtype)
        out[:, *box_slices(self.low[i] - start, image.shape[1:])] = image
        return out

    def total(self, spectra):
        """sum_i spectra[i] rendered[i], (Co, My, Mx); spectra (n, Co)."""
        out = np.zeros(self.shape[1:])
        for i, (a, image) in enumerate(zip(spectra, self.images, strict=True)):
            out[:, *self.window(i)] += a[:, None, None] * image
        return out

    def _image(self, i):
        """Component i's image (Co, My, Mx)."""
        out = np.zeros(self.shape[1:], self.dtype)
        out[:, *self.window(i)] = self.images[i]
        return out


def weighted_sum(rendered, spectra):
    """sum_i spectra[i] rendered[i], (Co, My, Mx), of a ComponentImages or an array.

    spectra (n, Co).
    """
    if isinstance(rendered, ComponentImages):
        return rendered.total(spectra)
    return np.einsum("nc,ncyx->cyx", spectra, rendered)


def window_of(rendered, i, margin=0):
    """Slices (y, x) of component i's window and a margin [px] around it, in the observation.

    The whole observation for an array.
    """
    whole = [slice(0, n) for n in rendered.shape[-2:]]
    own = rendered.window(i) if isinstance(rendered, ComponentImages) else whole
    return tuple(
        slice(max(part.start - margin, 0), min(part.stop + margin, every.stop))
        for part, every in zip(own, whole, strict=True)
    )


def joint_window(rendered, parts):
    """Slices (y, x) of a window that holds the light of some components, and so their boxes."""
    windows = [window_of(rendered, i) for i in parts]
    return tuple(
        slice(min(w[k].start for w in windows), max(w[k].stop for w in windows)) for k in (0, 1)
    )


def image_within(rendered, i, window):
    """Component i's image (Co, ny, nx) on a window (slices y, x) that contains its own."""
    if isinstance(rendered, ComponentImages):
        return rendered.within(i, window)
    return rendered[i][:, *window]


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
