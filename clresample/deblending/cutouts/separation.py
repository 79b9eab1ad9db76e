"""Divides the data of a window between chosen sources and all others, with their noise.

With the data d (its sky subtracted), the model t of the chosen sources and u of all others:

    data           d - u                 model        t
    residual       d - t - u             neighbours   u
    redistributed  d f,   f = (sum of max(model, 0) over the chosen) / (the same sum over all)

so that data = model + residual. The error of `data` against the light of the chosen sources is

    <(d - u - t_true)^2> = 1 / w - var(u) - 2 cov(t, u),

with the posterior covariance of t and u. var(u) is subtracted because u was fitted to the same
data: u follows their noise, and d - u contains less of it. Where light could belong to either,
cov(t, u) is negative and the error grows. `Separation.variance` is never below the noise, 1 / w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..component_images import source_image

# Values of a Separation's arrays in pixels outside the image; NaN in all other arrays.
OUTSIDE = {"weights": 0.0}
KINDS = "data", "model", "residual", "neighbours", "redistributed"
# [1] of a channel's brightest model pixel: if all models are fainter, a pixel's light is assigned
# to no source, because the rounding of float32 renderings (1e-6) would decide.
MIN_LIGHT_FRACTION = 1e-5


@dataclass(frozen=True, eq=False)
class Separation:
    """Chosen sources and their neighbours on a window of one observation.

    data (C, Ny, Nx) [counts]: without the fitted sky; NaN where there are no data
    weights (C, Ny, Nx) [counts^-2]: inverse variances, 0 = ignore this pixel
    own, others (C, Ny, Nx) [counts]: models of the chosen sources and of all others
    fraction (C, Ny, Nx) [1]: part of each pixel's light that belongs to the chosen sources' models
    own_variance, others_variance (C, Ny, Nx) [counts^2]: of `own` and `others`
    added_variance (C, Ny, Nx) [counts^2]: contribution of the models' errors to the noise of `data`
    fraction_variance (C, Ny, Nx) [1]: of `fraction`
    """

    data: np.ndarray
    weights: np.ndarray
    own: np.ndarray
    others: np.ndarray
    fraction: np.ndarray
    own_variance: np.ndarray
    others_variance: np.ndarray
    added_variance: np.ndarray
    fraction_variance: np.ndarray

    def image(self, what) -> np.ndarray:
        """Image (C, Ny, Nx) [counts] of one of KINDS.

        Kinds that include the data are NaN in pixels without weight. Raises ValueError for another
        kind.
        """
        check_kind(what)
        data = np.where(self.weights > 0, self.data, np.nan)
        if what == "data":
            return data - self.others
        if what == "model":
            return self.own.copy()
        if what == "neighbours":
            return self.others.copy()
        if what == "residual":
            return data - self.own - self.others
        return data * self.fraction

    def variance(self, what) -> np.ndarray:
        """Variance (C, Ny, Nx) [counts^2] of `image`; NaN where the image is NaN."""
        check_kind(what)
        if what == "model":
            return self.own_variance.copy()
        if what == "neighbours":
            return self.others_variance.copy()
        good = self.weights > 0
        noise = np.divide(1.0, self.weights, out=np.full(good.shape, np.nan), where=good)
        if what == "residual":
            return noise
        if what == "data":
            return noise + self.added_variance
        return self.fraction**2 * noise + self.fraction_variance * self.data**2

    @property
    def mask(self) -> np.ndarray:
        """Pixels (C, Ny, Nx) bool without weight: True = ignore."""
        return ~(self.weights > 0)

    def padded(self, origin, shape) -> Separation:
        """The same Separation on a larger window, without data or models in the added pixels.

        shape (2,) [px]: of the larger window; origin (2,) [px]: this window's first pixel in it
        """
        n_y, n_x = self.data.shape[1:]
        sides = [(before, size - before - n) for before, size, n in
                 zip(origin, shape, (n_y, n_x), strict=True)]  # fmt: skip
        if not any(map(any, sides)):
            return self
        return Separation(
            **{
                name: np.pad(image, [(0, 0), *sides], constant_values=OUTSIDE.get(name, np.nan))
                for name, image in vars(self).items()
            }
        )

    def part(self, window) -> Separation:
        """Cuts the Separation to slices (y, x)."""
        return Separation(**{name: image[:, *window] for name, image in vars(self).items()})


def separation_of(data, weights, images, chosen, deviations, faintest=None, *, joint=True):
    """The Separation of a window from its sources' models.

    data, weights: see Separation
    images {source: (C, Ny, Nx) [counts]}: models of all sources with light there
    chosen: the selected sources, a set or sequence
    deviations: own and others (K, C, Ny, Nx) [counts], changes of the two models, whose sums of
        squares over K are their variances
    faintest (C,) [counts]: a pixel's light is divided between sources only if their models exceed
        this together; None = MIN_LIGHT_FRACTION of the brightest pixel of the window
    joint: True if the sums over K of own times others are covariances of the two models. If False,
        these are unknown. cov(t, u) = -var(u) is then assumed (light that u lacks is in t), so that
        var(u) is added to the noise
    """
    own, others, own_shared, shared = np.zeros((4, *data.shape))
    for source, image in images.items():
        light = np.maximum(image, 0)
        shared += light
        if source in chosen:
            own += image
            own_shared += light
        else:
            others += image
    faintest = faintest_light(shared) if faintest is None else faintest
    fraction = fraction_of(own_shared, shared, faintest)
    own_change, others_change = deviations
    others_variance = (others_change**2).sum(axis=0)
    added = others_variance
    if joint:
        added = np.maximum(-others_variance - 2 * (own_change * others_change).sum(axis=0), 0)
    # change of the fraction: d(t / (t + u)) = (u dt - t du) / (t + u)^2
    over = fraction_of(np.ones(shared.shape), shared, faintest)
    change = ((1 - fraction) * own_change - fraction * others_change) * over
    return Separation(
        data=data,
        weights=weights,
        own=own,
        others=others,
        fraction=fraction,
        own_variance=(own_change**2).sum(axis=0),
        others_variance=others_variance,
        added_variance=added,
        fraction_variance=(change**2).sum(axis=0),
    )


def check_kind(what):
    """Raises ValueError unless the kind is one of KINDS."""
    if what not in KINDS:
        raise ValueError(f"what is {what!r}, must be one of {', '.join(map(repr, KINDS))}")


def fraction_of(part, total, faintest):
    """Divides part by total (C, Ny, Nx) where total exceeds `faintest` (C,); 0 elsewhere.

    part, returned (..., C, Ny, Nx)
    """
    lit = np.broadcast_to(total > faintest[:, None, None], part.shape)
    return np.divide(part, total, out=np.zeros(part.shape), where=lit)


def models_on(result, i_observation, window) -> dict[int, np.ndarray]:
    """{source: model (C, ny, nx) [counts]} of all with light on a window of an observation."""
    images = {
        source: source_image(result, source, i_observation, window)
        for source in range(len(result.sources))
    }
    return {source: image for source, image in images.items() if image is not None}


def faintest_light(total) -> np.ndarray:
    """Light (C,) [counts] of all models below which a pixel is divided between no sources.

    total (C, My, Mx): of all models on the whole image.
    """
    return MIN_LIGHT_FRACTION * total.max(axis=(1, 2), initial=0)
