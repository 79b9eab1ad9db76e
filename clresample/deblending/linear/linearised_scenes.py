"""Renders the components of a batch of scenes in all observations; solves for their spectra."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from ...device.tuning import Tuning
from .component_batch import (
    ComponentBatch,
    boxes_of,
    peaks_of,
    pixels_of,
    profile_thresholds,
    renumbered,
)
from .equations import ImageProducts
from .slot_observation import SlotObservation
from .spectra import nnls_batch, spectrum_covariance
from .ties import band_equations
from .unseen import unseen_spectra


def linearise(views, components, precision, tolerance, *, fit_sky) -> LinearisedScenes:
    """Sets up the rendering of these components in every observation.

    views: of each scene, its WhitenedViews; precision, tolerance: see SlotObservation
    """
    first = views[0]
    device, dtype = first[0].op.device, first[0].op.dtype
    tuning, ends = Tuning.of(device, dtype), np.cumsum([0, *(len(v.data) for v in first)])
    sights = [
        SlotObservation(
            [own[k] for own in views],
            slice(int(ends[k]), int(ends[k + 1])),
            device,
            dtype,
            tuning,
            precision,
            tolerance,
        )
        for k in range(len(first))
    ]
    return LinearisedScenes(components, sights, len(views), device, dtype, tuning, fit_sky=fit_sky)


class LinearisedScenes:
    """The components of a batch of scenes at given parameters, rendered in all observations.

    components (N): all scenes' Components; sights: the observations; n_scenes: B; fit_sky

    spectra (N, C), sky (B, C): of the last solution, in the views' units, for profiles of unit
        integral
    sky_precision (B, C): of the prior of each level, whose mean is 0; 0 if it is not fitted
    """

    def __init__(self, components, sights, n_scenes, device, dtype, tuning, *, fit_sky):
        self.components, self.sights, self.n_scenes = components, sights, n_scenes
        self.device, self.dtype, self.tuning, self.fit_sky = device, dtype, tuning, fit_sky
        self.scene = np.array([c.scene for c in components])
        self.index = np.array([c.index for c in components])
        self.n_most = int(self.index.max()) + 1
        self.n_channels, self.ties = sights[-1].channels.stop, sights[0].ties
        self.spectra = np.zeros((len(components), self.n_channels))
        self.sky = np.zeros((n_scenes, self.n_channels))
        known = np.concatenate([sight.sky_precision for sight in sights], axis=1)
        self.sky_precision = known * bool(fit_sky)
        self._allow_wide_pixels = np.all([s.aim.allow_wide_pixels() for s in sights], axis=0)
        self._kept: dict = {}

    def render(self, scenes, thetas, brightness, *, slopes, whiten=True):
        """Draws and renders the components of some scenes (k,).

        thetas (N): arrays; brightness (N,): see `profile_thresholds`; slopes: True to draw them
            too, or bool (N,) for each; whiten: else `whiten` is to follow
        """
        self.scenes = np.asarray(scenes)
        at = np.flatnonzero(np.isin(self.scene, self.scenes))
        chosen, theta = [self.components[i] for i in at], [thetas[i] for i in at]
        boxes = boxes_of(chosen, theta, profile_thresholds(brightness[at]))
        pixels = pixels_of(chosen, theta, boxes, self._allow_wide_pixels[self.scene[at]])
        slopes = np.broadcast_to(slopes, len(self.components))[at]
        levels = self._levels(chosen, theta, brightness[at])
        self.slots = ComponentBatch(chosen, theta, boxes, pixels, slopes=slopes, levels=levels)
        self.at = at[self.slots.order]
        self._row = np.full(self.n_scenes, -1)
        self._row[self.scenes] = np.arange(len(self.scenes))
        images = self.slots.draw(self.device, self.dtype, self.tuning, self._kept)
        for sight, level in zip(self.sights, levels, strict=True):
            sight.render(self.slots, images, level[self.slots.order])
        self.overlapping_pairs = [sight.overlapping_pairs() for sight in self.sights]
        if whiten:
            self.whiten()

    def _levels(self, components, thetas, brightness):
        """`RenderPlanner.levels` of components in each observation (observations, n)."""
        if self.sights[0].aim.is_exact:
            return np.zeros((len(self.sights), len(components)), int)
        flux = brightness / peaks_of(components, thetas)
        return np.array([sight.aim.levels(components, flux) for sight in self.sights])

    def put(self, values):
        """Values on the device, in its precision."""
        return self.device.put(values, self.dtype)

    def n_pixels(self) -> np.ndarray:
        """Numbers (B,) of pixels with weight, all channels together."""
        weights = [[view.sqrt_weights for view in sight.views] for sight in self.sights]
        return np.array([[np.count_nonzero(w) for w in own] for own in weights]).sum(axis=0)

    def whiten(self):
        """Whitens the rendered images."""
        for sight in self.sights:
            sight.whiten()

    @property
    def rows(self):
        """The row (slots,) of each slot's scene among the rendered scenes."""
        return self.rows_of(self.scene[self.at])

    def rows_of(self, scenes):
        """The rows of scenes among the rendered ones; -1 for others."""
        return self._row[scenes]

    def compute_residuals(self, error) -> np.ndarray:
        """Compares the present solution with the data.

        chi2 (k,) of the rendered scenes, with the prior of the sky.
        """
        spectra, sky = self.put(self.spectra[self.at]), self.put(self.sky)
        self.sums = [
            sight.compute_residuals(self.scenes, self.slots, spectra, sky, error)
            for sight in self.sights
        ]
        of_sky = (self.sky_precision * self.sky**2)[self.scenes].sum(axis=1)
        return sum(sums[:, :, 0].sum(axis=1) for sums in self.sums) + of_sky

    def of_level(self):
        """Right sides and curvatures (k, C) of the sky levels about the solution last compared."""
        sums = np.concatenate([s[..., 1:] for s in self.sums], axis=1)
        right, curvature = np.moveaxis(sums, -1, 0)
        known = self.sky_precision[self.scenes]
        return right - known * self.sky[self.scenes], curvature + known

    def solve(self, error):
        """Spectra and sky levels of the least squares, weights from the present solution.

        error: part of the model that adds to the noise; 0: none of it
        normal (k, C, n + 1, n + 1), right (k, C, n + 1): products of the scenes' components, and
        then of a level of 1, with each other and with the data
        """
        self.compute_residuals(error)
        k, m, levels = len(self.scenes), self.n_most + 1, self.of_level()
        self.normal = np.zeros(0)  # before there are others
        self.normal, self.right = (np.empty((k, self.n_channels, *size)) for size in ((m, m), (m,)))
        for sight, pairs in zip(self.sights, self.overlapping_pairs, strict=True):
            products = ImageProducts(self, sight, *pairs)
            for part, channels in products.portions(8 * k * m**2):
                at, own = (slice(None), channels), [x[:, channels] for x in levels]
                self.normal[at], _, self.right[at] = products.with_spectra(part, own)
        self.right += np.einsum("kcij,kcj->kci", self.normal, self.solution())
        found, own, value = self._spectra()
        unseen = unseen_spectra(self, found)
        if unseen.any():
            self.normal[:, :, :-1][unseen] = self.normal.swapaxes(2, 3)[:, :, :-1][unseen] = 0
            self.right[..., :-1][unseen] = 0
            found, own, value = self._spectra()
        self.spectra[self.at] = found[self.rows, :, self.index[self.at]]
        if self.fit_sky:
            self.sky[self.scenes] = value - (own * found).sum(axis=-1)

    def _spectra(self):
        """Spectra (k, C, n) of the present equations, and the levels' own of `band_equations`."""
        normal, right, own, value = self._band_equations()
        n = self.n_most
        found = nnls_batch(normal.reshape(-1, n, n), right.reshape(-1, n)).reshape(right.shape)
        return self._spread(found, axis=1), own, value

    def with_components(self, components) -> LinearisedScenes:
        """The same observations with other components."""
        device = self.device, self.dtype, self.tuning
        return LinearisedScenes(
            components, self.sights, self.n_scenes, *device, fit_sky=self.fit_sky
        )

    def without_light(self, spectra) -> LinearisedScenes:
        """The scenes rendered last, light of their components removed from the data.

        spectra (N, C): of the light
        """
        given = self.scenes, self.slots, self.put(spectra[self.at])
        out = copy(self)
        out.sights = [sight.without_light(*given) for sight in self.sights]
        return out

    def cut(self, numbers, chosen, scenes, windows) -> LinearisedScenes:
        """Windows of scenes (k,), which may repeat, as scenes with some of the components.

        Sky levels are fixed at the present ones.

        chosen (n,): these components, numbers (n,): the new scene of each
        windows: of each observation first pixels (k, 2) and size (2,)
        """
        pairs = zip(numbers.tolist(), chosen.tolist(), strict=True)
        components = renumbered(replace(self.components[i], scene=k) for k, i in pairs)
        pairs = zip(self.sights, windows, strict=True)
        sights = [sight.cut(scenes, *window) for sight, window in pairs]
        device = self.device, self.dtype, self.tuning
        out = LinearisedScenes(components, sights, len(scenes), *device, fit_sky=False)
        out.sky[:] = self.sky[scenes]
        return out

    def light_products(self, sky, error=0.0):
        """Products (N, C) of each component's whitened image with the data's light and with itself.

        The light excludes the sky's. Products are 0 where a component has no pixels.

        sky (B, C); error: part of the light that adds to the noise
        """
        spectra, sky = self.put(np.zeros((len(self.slots), self.n_channels))), self.put(sky)
        right, power = np.zeros((2, len(self.components), self.n_channels))
        for sight, (table, _) in zip(self.sights, self.overlapping_pairs, strict=True):
            sight.compute_residuals(self.scenes, self.slots, spectra, sky, error)
            alone = table[table[:, 0] == table[:, 1]].astype(np.int32)
            square = sight.gram(self.device.put(alone), 1)[..., 0, 0]
            power[self.at[alone[:, 0]], sight.channels] = square
            right[self.at, sight.channels] = sight.residual_products(1)[:, :, 0, 0]
        if self.ties is not None:
            right, power = (self.ties.spread(self.ties.total(a)) for a in (right, power))
        return right, power

    def signal_to_noise(self, sky, error=0.0):
        """<u, d> / |u| (N, C) of `light_products`, 0 without pixels."""
        right, power = self.light_products(sky, error)
        return np.divide(right, np.sqrt(power), out=np.zeros_like(right), where=power > 0)

    def kept_solution(self):
        """Copies of the present spectra and sky levels, for `restore`."""
        return self.spectra.copy(), self.sky.copy()

    def restore(self, kept, scenes):
        """Restores the spectra and sky levels of some scenes (k,) from a `kept_solution`."""
        (spectra, sky), here = kept, np.isin(self.scene, scenes)
        self.spectra[here], self.sky[scenes] = spectra[here], sky[scenes]

    def solution(self):
        """The present spectra and sky levels (k, C, n + 1)."""
        out = np.zeros((len(self.scenes), self.n_channels, self.n_most + 1))
        out[self.rows, :, self.index[self.at]] = self.spectra[self.at]
        out[..., self.n_most] = self.sky[self.scenes]
        return out

    def _band_equations(self, rows=slice(None)):
        """`band_equations` of the scenes rendered last, or of some rows of them."""
        return band_equations(self.ties, self.normal[rows], self.right[rows], self.fit_sky)

    def _spread(self, values, axis):
        """Values of bands for all channels, see Ties."""
        return values if self.ties is None else self.ties.spread(values, axis)

    def covariance(self, row):
        """Covariance (C, n, n) of one scene's spectra, with unknown sky levels if fitted."""
        n = int((self.scene == self.scenes[row]).sum())
        normal = self._band_equations(row)[0][:, :n, :n]
        return self._spread(spectrum_covariance(normal), axis=0)
