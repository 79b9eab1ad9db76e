"""Renders component images in one observation of a batch of scenes and sums their products."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter

from ...resampling.plan import Precision
from ...sky.box import box_slices, intersect_boxes
from .component_batch import ComponentBatch, cumulative_offsets
from .render_planner import RenderPlanner

FILE = "start.cl"
# [px] Sigma by which data are smoothed for the model's error, a fraction of them. Noise is then 10
# times smaller. SDRs of simulated COSMOS galaxies are the same with 2 to 4, and 0.1 dB lower with
# 1.
LIGHT_PX = 3.0


class SlotObservation:
    """One observation of each of B scenes, and the slots rendered in it at present.

    views (B): WhitenedViews of equal shapes; channels: slice of all the scenes' channels
    precision, tolerance: see RenderPlanner

    lit (slots, 4): first pixels and sizes of the parts reached by the light of the last slots
    n_elements: of the last rendered slots; n_pixels: of all products so far
    ties: Ties of all channels, or None; scale (B, Co): WhitenedView.error_scale
    sky_precision (B, Co): the views', 0 where they have none
    origin (B, 2) [px]: first pixel of those that are here among the views' own, see `cut`
    root (B, Co, My, Mx): on the device, as are data, residual and weight, and, in `_errors`, the
        scale times each error of the light so far
    """

    def __init__(self, views, channels, device, dtype, tuning, precision: Precision, tolerance):
        self.views, self.channels, self.device, self.dtype = views, channels, device, dtype
        self.tuning = tuning
        self.n_bands, self.my, self.mx = views[0].sqrt_weights.shape
        self.root = device.resident.stack([v.sqrt_weights for v in views], dtype)
        self.data = device.resident.stack([v.data for v in views], dtype)
        self._reserve()
        self.ties, self.scale = views[0].ties, np.array([v.error_scale for v in views])
        known = [v.sky_precision for v in views]
        self.sky_precision = np.zeros(self.root.shape[:2]) if known[0] is None else np.array(known)
        self.aim = RenderPlanner(views, device, dtype, precision, tolerance)
        self.n_elements = self.n_pixels = 0
        self.origin = np.zeros((len(views), 2), int)
        self._errors: dict = {}

    def _reserve(self):
        """Reserves memory for residuals and weights."""
        self.residual, self.weight = (
            self.device.empty(self.root.shape, self.dtype) for _ in range(2)
        )
        b, c, my = self.root.shape[:3]
        self.sums = self.device.empty((b, c, 3, my), self.dtype)

    def cut(self, scenes, low, size) -> SlotObservation:
        """Windows of scenes (k,), which may repeat, as scenes of their own.

        low (k, 2), size (2,) [px]: first pixels and size of the windows, which lie inside
        """
        out, given = copy(self), self.device.get_all([self.root, self.data, self._light])
        rows = [(b, slice(None), *box_slices(at, size)) for b, at in zip(scenes, low, strict=True)]
        cuts = (self.device.put(np.array([values[row] for row in rows])) for values in given)
        out.root, out.data, out._light = cuts
        out.views, out.origin, (out.my, out.mx) = [self.views[b] for b in scenes], low, size
        out.scale, out.sky_precision = self.scale[scenes], self.sky_precision[scenes]
        out.aim, out._errors = self.aim.of_scenes(scenes), {}
        out._reserve()
        return out

    @cached_property
    def _light(self):
        """`smoothed_light` of all views, on the device."""
        return self.device.put(np.array([smoothed_light(v) for v in self.views]), self.dtype)

    def _launch(self, name, size, *, local_size=None, **arguments):
        """Queues a kernel of start.cl; K of them: images of a slot that are summed."""
        options = {"K": 1} | {k: arguments.pop(k) for k in ("K", "PER_ROOT") if k in arguments}
        launch = self.device.launcher(
            FILE,
            name,
            dtype=self.dtype,
            local_size=local_size or self.tuning.local_size(3),
            ROWS=self.tuning.row_loops,
            WG=self.tuning.sum_group,
            **options,
        )
        launch(size, n_bands=self.n_bands, my=self.my, mx=self.mx, **arguments)

    def render(self, slots: ComponentBatch, images, level):
        """Renders the slots' images, stores their observed parts; level: see RenderPlanner.runs."""
        low, size = np.zeros((2, len(slots), 2), int)
        self.lit, runs = np.zeros((len(slots), 4), int), []
        for run in self.aim.runs(slots, level):
            part = slice(run.first, run.last)
            low[part], self.lit[part] = run.low, run.lit_window
            if run.renderer is not None:
                size[part] = run.renderer.size
                runs.append(run)
        low -= self.origin[slots.scene]
        self.lit[:, :2] -= self.origin[slots.scene]
        begin, n = cumulative_offsets(slots.n_images * self.n_bands * size.prod(axis=1))
        self.place = np.column_stack([slots.scene, low, size, slots.n_images, begin])
        self.place_on_device = self.device.put(self.place.astype(np.int32))
        self.n_elements, self.seen = n, self.device.empty(n, self.dtype)
        for run in runs:
            at = int(slots.begin[run.first]), int(begin[run.first])
            n, shares = int(slots.n_images[run.first]), self.aim.shares(slots, run.first, run.last)
            run.renderer(images, at[0], self.seen, at[1], n, run.plan_index, run.offsets_px, shares)

    def lit_images(self):
        """Of each slot its lit window on the observation (slices y, x), and its images there.

        Images (K, Co, ny, nx): float64
        """
        seen = self.device.get(self.seen)
        for (_, y0, x0, wy, wx, k, begin), lit in zip(self.place, self.lit, strict=True):
            images = seen[begin : begin + k * self.n_bands * wy * wx]
            images = images.reshape(k, self.n_bands, wy, wx)
            images = images[..., *box_slices(lit[:2] - (y0, x0), lit[2:])]
            window, inside = intersect_boxes((0, 0), (self.my, self.mx), lit[:2], lit[2:])
            yield window, images[..., *inside].astype(np.float64)

    def whiten(self):
        """Whitens the rendered images."""
        tallest, widest = self.place[:, 3:5].max(axis=0).tolist()
        self._launch(
            "whiten",
            (1 if self.tuning.row_loops else widest, tallest, len(self.place)),
            place=self.place_on_device,
            root=self.root,
            images=self.seen,
        )

    def compute_residuals(self, scenes, slots, spectra, sky, error):
        """Residuals and weights of the scenes (k,) of the slots rendered last.

        Also returns sums (k, Co, 3) over the pixels.

        spectra (slots, C), sky (B, C): of the model, on the device; error: part of the light that
        adds to the noise
        """
        scenes_on_device, first, listed = slots.lists(self.device, scenes)
        if error not in self._errors:
            self._errors[error] = self.device.put(error * self.scale, self.dtype)
        group = self.tuning.sum_group
        self._launch(
            "compute_residuals",
            (group * self.my, self.n_bands, len(scenes)),
            local_size=(group, 1, 1),
            scenes=scenes_on_device,
            first=first,
            listed=listed,
            place=self.place_on_device,
            channel=self.channels.start,
            n_channels=spectra.shape[1],
            error=self._errors[error],
            spectra=spectra,
            sky=sky,
            root=self.root,
            data=self.data,
            light=self._light if error else self.data,  # times 0 without an error
            images=self.seen,
            residual=self.residual,
            weight=self.weight,
            sums=self.sums,
        )
        return self.device.get(self.sums)[scenes].sum(axis=-1, dtype=np.float64)

    def without_light(self, scenes, slots, spectra) -> SlotObservation:
        """This observation without the slots' light in the data of scenes (k,).

        spectra (slots, C): of the light, on the device
        """
        sky = self.device.zeros((len(self.views), spectra.shape[1]), self.dtype)
        self.compute_residuals(scenes, slots, spectra, sky, 0.0)
        data, root, rest = self.device.get_all([self.data, self.root, self.residual])
        seen = np.isin(np.arange(len(root)), scenes)[:, None, None, None] & (root > 0)
        out, rest = copy(self), np.divide(rest, root, out=data, where=seen)
        out.data = self.device.put(rest)
        return out

    def overlapping_pairs(self):
        """Table (pairs, 6) of slots a <= b of one scene whose windows overlap on the pixels.

        It has the first pixel and size of the overlap; NumPy's, and on the device. Slots without
        pixels are left out.
        """
        table = _pairs(self.place[:, 0], self.lit, (self.my, self.mx))
        self.n_pixels += int(table[:, 4:].prod(axis=1).sum())
        return table, self.device.put(table.astype(np.int32))

    def gram(self, pairs, n_images):
        """Products (pairs, Co, K, K) of pairs' images, under the present weights.

        K = n_images, of which images that a slot does not have repeat its last. pairs: a table on
        the device
        """
        return self._sums("gram", len(pairs), (n_images, n_images), pairs=pairs)

    def residual_products(self, n_images):
        """Products (slots, Co, K, 2) of the slots' images with the residual, and with the root."""
        given = {"residual": self.residual, "root": self.root}
        return self._sums("residual_products", len(self.place), (n_images, 2), **given)

    def light_on_pixels(self):
        """Returns the light (slots, Co) on pixels with weight, less where errors lower weights."""
        given = {"residual": self.residual, "root": self.root, "PER_ROOT": 1}
        return self._sums("residual_products", len(self.place), (1, 2), **given)[:, :, 0, 1]

    def _sums(self, name, n, shape, **given):
        """Sums (n, Co, *shape) over pixels by a kernel of start.cl, in a group each."""
        out, group = self.device.empty((n, self.n_bands, *shape), self.dtype), self.tuning.sum_group
        if n:
            self._launch(
                name,
                (group * n, self.n_bands),
                local_size=(group, 1),
                K=shape[0],
                place=self.place_on_device,
                images=self.seen,
                weight=self.weight,
                out=out,
                **given,
            )
        return self.device.get(out).astype(np.float64)


def smoothed_light(view):
    """Light of a WhitenedView's pixels over their noise (Co, My, Mx), smoothed over neighbours.

    Pixels without weight are ignored, and get no light.
    """
    sigma = 0, LIGHT_PX, LIGHT_PX
    seen, light = (
        gaussian_filter(part, sigma, mode="constant")
        for part in (view.weights, view.weights * view.data)
    )
    return view.sqrt_weights * np.divide(
        light, seen, out=np.zeros_like(light), where=view.sqrt_weights > 0
    )


def _pairs(scenes, lit, shape):
    """Overlapping pairs of slots of `scenes` (n,), `lit` (n, 4) on an observation of this shape."""
    low = np.maximum(lit[:, :2], 0)
    high = np.minimum(lit[:, :2] + lit[:, 2:], shape)
    at = np.argsort(scenes, kind="stable")
    # of each slot the later ones of its scene, from itself on
    count = np.searchsorted(scenes[at], scenes[at], "right") - np.arange(len(at))
    first = np.repeat(np.arange(len(at)), count)
    later = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    i, j = at[first], at[first + later]
    start, end = np.maximum(low[i], low[j]), np.minimum(high[i], high[j])
    meet = (end > start).all(axis=1)
    return np.column_stack([i, j, start, end - start])[meet]
