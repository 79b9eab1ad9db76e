"""Renders the final morphologies in every observation and solves for their spectra."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...resampling.plan import Precision
from ...sky.box import intersect_boxes
from ..component_images import ComponentImages
from ..profiles import MIN_LIGHT, ComponentProfile
from ..view import WhitenedView
from .component_batch import StartComponent
from .linearised_scenes import linearise

# [px] Frames of at most this many pixels are rendered whole, by the views' own operators, since
# making operators for boxes would take longer. In larger frames the boxes' operators agree with
# that of the frame to 2e-5 of the brightest pixel, the effect of aliases of boxes that cut light.
WHOLE_PX = 160**2


@dataclass(frozen=True, eq=False)
class MorphologyModel:
    """The morphologies of a scene, and the views that render them.

    frame (2,) [px]: its shape, padding included
    views: WhitenedViews; unfiltered_views: the same without whitening filter, or None if the view
        has none
    source (n,): number of each one's source, which selects its PSF in the views
    origin (n, 2) [px], morphs (n): arrays (ny, nx), in boxes of the frame
    spectra (n, C), sky (C,): those about which slopes are asked for, None for none
    min_light (n,) [1]: of their ComponentProfiles; None: that of galaxies
    """

    frame: tuple[int, int]
    views: list[WhitenedView]
    unfiltered_views: list
    source: np.ndarray
    origin: np.ndarray
    morphs: list
    spectra: np.ndarray | None = None
    sky: np.ndarray | None = None
    min_light: list | None = None


@dataclass(frozen=True, eq=False)
class RenderedModel:
    """Images of a MorphologyModel in the observations.

    spectra (n, C), sky (C,): least squares; covariance (C, n, n): of the spectra. In the views'
        units
    observed: per view, ComponentImages (n, Co, My, Mx); unfiltered_views: likewise, None where it
        is the same
    held (n, C): products of the whitened images with the residual, for spectra that the least
        squares hold at 0, where they are not positive; 0 for others
    power, slope (n, C): products of the whitened images with themselves, and with what the model's
        own spectra and sky leave of the data; None without these
    """

    spectra: np.ndarray
    sky: np.ndarray
    covariance: np.ndarray
    observed: tuple[ComponentImages, ...]
    unfiltered_views: tuple
    held: np.ndarray | None = None
    power: np.ndarray | None = None
    slope: np.ndarray | None = None

    def residuals(self, channels, views):
        """Data minus model (Co, My, Mx) of each of the WhitenedViews, in their units.

        channels: the slices of all channels that these have.
        """
        out = []
        for part, view, rendered in zip(channels, views, self.observed, strict=True):
            model = rendered.total(self.spectra[:, part]) + self.sky[part, None, None]
            out.append(view.data - model)
        return out


class _ImageProfile(ComponentProfile):
    """An image (ny, nx) in a box of the frame from `origin` on; no parameters.

    frame (2,) [px]: its shape
    """

    def __init__(self, image, origin, frame, min_light=MIN_LIGHT):
        self.image, self.origin, self.frame = image, np.asarray(origin), np.array(frame)
        self.light, self.min_light = image.sum(), min_light

    def bounding_box(self, theta, position, threshold):
        """All of the box, or of the frame if that is small."""
        if self.frame.prod() <= WHOLE_PX:
            return (self.frame - 1) / 2, np.full(2, self.frame.max())
        size = np.array(self.image.shape)
        return self.origin + (size - 1) / 2, size / 2

    def draw_box(self, theta, position, origin, size, *, slopes=True):
        """A part of it, 0 beyond."""
        out = np.zeros((1, *size))
        here, there = intersect_boxes(origin, size, self.origin, self.image.shape)
        out[0][here] = self.image[there]
        return out


def render_models(models: list[MorphologyModel], *, fit_sky=False) -> list[RenderedModel]:
    """Renders the morphologies of all models, and solves for their spectra, side by side.

    models: of equal numbers of observations, these of equal shapes, as of one batch
    fit_sky: also solve for a level per channel
    """
    looking = _rendered(models, [m.views for m in models], fit_sky)
    observed = _taken(looking)
    looking.whiten()
    looking.solve(0.0)
    bare = [[None] * len(m.views) for m in models]
    others = [[b or v for b, v in zip(m.unfiltered_views, m.views, strict=True)] for m in models]
    if any(b is not None for m in models for b in m.unfiltered_views):
        bare = _taken(_rendered(models, others, False))
    found = []
    for b in range(len(models)):
        spectra = looking.spectra[looking.scene == b]
        found.append(
            RenderedModel(
                spectra,
                looking.sky[b],
                looking.covariance(b),
                tuple(observed[b]),
                tuple(bare[b]),
                np.where(spectra == 0, _slopes(looking, b, spectra, looking.sky[b]), 0),
                *_products(looking, b, models[b]),
            )
        )
    return found


def solve_models(models: list[MorphologyModel], *, fit_sky=False):
    """Spectra (n, C) and sky (C,) of least squares of each model, and chi2 with the sky's prior.

    For its arguments see `render_models`.
    """
    looking = _rendered(models, [m.views for m in models], fit_sky)
    looking.whiten()
    looking.solve(0.0)
    spectra = [looking.spectra[looking.scene == b] for b in range(len(models))]
    return list(zip(spectra, looking.sky, looking.compute_residuals(0.0), strict=True))


def model_of(fit, which=()):
    """All morphologies of a fit, and after them the cores of the components `which` (k,)."""
    scene, morphs, which = fit.scene, list(fit.state.morph), np.array(which, int)
    cores = [morphs[i] * scene.profile[i] for i in which]
    source, origin = (np.concatenate([of, of[which]]) for of in (fit.start.source, scene.origin))
    bare = [None] * len(fit.views)
    spectra = np.concatenate([fit.state.spectra, np.zeros_like(fit.state.spectra[which])])
    least = [shape.min_light for shape in fit.start.shapes]
    least += [least[i] for i in which]
    given = source, origin, morphs + cores, spectra, fit.state.sky, least
    return MorphologyModel(fit.padded.shape, fit.views, bare, *given)


def _rendered(models, views, fit_sky):
    """The LinearisedScenes of MorphologyModels in views of each, rendered but not whitened."""
    components = []
    for b, model in enumerate(models):
        least = model.min_light or [MIN_LIGHT] * len(model.morphs)
        rows = zip(model.source, model.origin, model.morphs, least, strict=True)
        for i, (source, origin, morph, lowest) in enumerate(rows):
            shape = _ImageProfile(morph, origin, model.frame, lowest)
            place = np.asarray(origin, float)
            components.append(StartComponent(b, i, int(source), shape, place, model.frame))
    precision, n = Precision.of(views[0][0].op.dtype), len(components)
    looking = linearise(views, components, precision, 0.0, fit_sky=fit_sky)
    given = np.arange(len(models)), [np.zeros(0)] * n, np.zeros(n)
    looking.render(*given, slopes=False, whiten=False)
    return looking


def _products(looking, b, model):
    """See RenderedModel.power, slope."""
    if model.spectra is None:
        return None, None
    power = np.einsum("cii->ic", looking.normal[b])[: len(model.morphs)].copy()
    return power, _slopes(looking, b, model.spectra, model.sky)


def _slopes(looking, b, spectra, sky):
    """Products (n, C) of whitened images with what spectra (n, C), sky (C,) leave of the data."""
    n, known = len(spectra), np.zeros_like(looking.right[b])
    known[:, :n], known[:, -1] = spectra.T, sky
    left = looking.right[b] - np.einsum("cij,cj->ci", looking.normal[b], known)
    return left[:, :n].T


def _taken(looking):
    """Per scene and view, the ComponentImages of the present components."""
    found = [[] for _ in range(looking.n_scenes)]
    for sight in looking.sights:
        images = list(sight.lit_images())
        for b, ends in enumerate(found):
            own = np.flatnonzero(looking.slots.scene == b)
            own = own[np.argsort(looking.at[own])]
            low = [[side.start for side in images[k][0]] for k in own]
            shape = len(own), sight.n_bands, sight.my, sight.mx
            part = [np.ascontiguousarray(images[k][1][0]) for k in own]
            ends.append(ComponentImages(shape, np.reshape(low, (-1, 2)), part))
    return found
