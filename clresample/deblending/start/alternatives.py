"""Other profiles of some components, rendered beside the present fit, and their gains.

With u the whitened image of a profile, r the data minus all other models, and M the models of other
galaxies, of which a part NEIGHBOUR_MODEL_ERROR is wrong (population.py), the profile's gain is

    sum_c max(0, <u, r>)^2 / (<u, u> + (NEIGHBOUR_MODEL_ERROR <u, M>)^2).

A wide profile has much of the light of a bright galaxy far from it, and of what that one's smooth
profile leaves: a faint source beside a galaxy with a bulge of another colour took a third of its
light in one band.
"""

from __future__ import annotations

import numpy as np

from ..linear.component_batch import peaks_of, renumbered
from ..linear.spectra import MODEL_ERROR
from .population import NEIGHBOUR_MODEL_ERROR, STAR_MODEL_ERROR


class Alternatives:
    """Profiles of some components of a ProfileFit, of each the present one and then others.

    The scenes of these components must be those that `fit.looking` rendered and solved last. Its
    equations and solution stay; what it renders is replaced.

    own: {component: [theta (p,), ...]}, the present ones first
    instead: {component: StartComponent} whose profiles the others are; by default its own
    faint: draw profiles as far as where they are faint beside the noise, else beside their peaks

    component, owner (n,): of each profile, and its place in `own`; first (q,): the present ones
    listed (n): StartComponents; theta (n): their parameters; around: their LinearisedScenes
    right, alone, level (n, C): products with r, with themselves, and with a level of 1
    explained (n, C): part of `right` by the present profile
    wrong (n, C): products with the errors of other models; those of stars are STAR_MODEL_ERROR
    """

    def __init__(self, fit, own, instead=None, *, faint=True):
        looking, instead = fit.looking, instead or {}
        counts = [len(some) for some in own.values()]
        self.component = np.repeat(list(own), counts)
        self.owner = np.repeat(np.arange(len(own)), counts)
        self._is_first = np.diff(self.component, prepend=-1) != 0
        self.first = np.flatnonzero(self._is_first)
        self.theta = [theta for some in own.values() for theta in some]
        self.listed = [
            looking.components[i] if present else instead.get(i, looking.components[i])
            for i, present in zip(self.component, self._is_first, strict=True)
        ]
        stars, spectra = fit.population.stars[fit.at][:, None], looking.spectra
        # no models, those of stars, and last all, as `looking.of_level` is about what these leave
        models = [0, stars, 1] if stars.any() else [0, 1]
        parts = [_residuals(looking, spectra * which) for which in models]
        peaks = peaks_of(self.listed, self.theta)
        brightness = fit.brightness[self.component] * faint
        brightness *= np.minimum(peaks / peaks[self.first][self.owner], 1)
        self.around = looking.with_components(renumbered(self.listed))
        scenes = np.unique(self.around.scene)
        self.around.render(scenes, self.theta, brightness, slopes=False)
        products = [self._products(part) for part in parts]
        (light, _), (unstarred, _), (rest, self.level) = products[0], products[-2], products[-1]
        self.alone, self.explained = self._products_of_own(spectra)
        self.right = rest + self.explained
        others = unstarred + self.explained * stars[self.component] - self.right
        self.wrong = NEIGHBOUR_MODEL_ERROR * others + STAR_MODEL_ERROR * (light - unstarred)

    def _products(self, residuals):
        """Products (n, C) with these residuals of each sight, and with a level of 1."""
        found = np.zeros((2, len(self.owner), self.around.n_channels))
        for sight, residual in zip(self.around.sights, residuals, strict=True):
            sight.residual = residual
            pull = sight.residual_products(1)[:, :, 0]
            found[:, self.around.at, sight.channels] = np.moveaxis(pull, -1, 0)
        return found

    def _products_of_own(self, spectra):
        """Products (n, C) of profiles with themselves and with the present models of the same."""
        alone, explained = np.zeros((2, len(self.owner), self.around.n_channels))
        is_first = self._is_first
        for sight, (table, _) in zip(
            self.around.sights, self.around.overlapping_pairs, strict=True
        ):
            one, other = self.around.at[table[:, :2]].T
            use = self.owner[one] == self.owner[other]
            use &= (one == other) | is_first[one] | is_first[other]
            gram = sight.gram(self.around.device.put(table[use].astype(np.int32)), 1)[..., 0, 0]
            a, b = np.where(is_first[other], (one, other), (other, one))[:, use]
            same, seen = a == b, is_first[b]
            alone[a[same], sight.channels] = gram[same]
            explained[a[seen], sight.channels] = (
                spectra[self.component[b[seen]]][:, sight.channels] * gram[seen]
            )
        return alone, explained

    def full_gain(self, right, alone):
        """Gains (n,) of products (n, C) with the data and with themselves, sums as of `tied`."""
        return self.total(_quotient(np.maximum(right, 0) ** 2, alone))

    def certain_gain(self, right, alone):
        """Gains (n,) of such products with the errors of other models."""
        return self.total(_quotient(np.maximum(right, 0) ** 2, self._variance(alone)))

    def colour_gain(self, right, alone, spectra):
        """Gains (n,) of free spectra with these errors, beyond those in proportion to one (n, C).

        Free ones may be negative.
        """
        variance = self._variance(alone)
        part = self.total(_quotient(spectra * alone * right, variance)) ** 2
        power = self.total(_quotient((spectra * alone) ** 2, variance))
        return self.total(_quotient(right**2, variance)) - _quotient(part, power)

    def tied(self, values):
        """Products (n, C), those of all channels of a band summed."""
        ties = self.around.ties
        return values if ties is None else ties.spread(ties.total(values))

    def total(self, values):
        """Sums (n,) of values (n, C) over the bands."""
        ties = self.around.ties
        return (values if ties is None else values[:, ties.first]).sum(axis=1)

    def _variance(self, alone):
        return np.where(alone > 0, alone + self.tied(self.wrong) ** 2, 0)


def _residuals(looking, spectra):
    """The data less models with spectra (N, C), on the device, in each observation.

    looking: LinearisedScenes
    """
    kept, looking.spectra = looking.spectra, spectra
    for sight in looking.sights:
        sight.residual = sight.device.empty(sight.root.shape, sight.dtype)
    looking.compute_residuals(MODEL_ERROR)
    looking.spectra = kept
    return [sight.residual for sight in looking.sights]


def _quotient(a, b):
    """a / b, 0 where b is."""
    return np.divide(a, b, out=np.zeros_like(b), where=b > 0)
