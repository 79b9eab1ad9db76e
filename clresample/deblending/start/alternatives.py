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

    fit: of which the components' scenes were rendered and solved last

    own: {component: [theta (p,), ...]}, the present ones first
    instead: {component: StartComponent} whose profiles the others are; by default its own

    component, owner (n,): of each profile, and its place in `own`; first (q,): the present ones
    listed (n): StartComponents; theta (n): their parameters
    around: LinearisedScenes of these, and of all stars beside them
    right, alone, level (n, C): products with r, with themselves, and with a level of 1
    explained (n, C): part of `right` by the present profile
    wrong (n, C): products with the errors of other models; those of stars are STAR_MODEL_ERROR
    """

    def __init__(self, fit, own, instead=None):
        looking, thetas, instead = fit.looking, fit.thetas(), instead or {}
        counts = [len(some) for some in own.values()]
        self.component = np.repeat(list(own), counts)
        self.owner = np.repeat(np.arange(len(own)), counts)
        self.first = np.flatnonzero(np.diff(self.component, prepend=-1))
        self.theta = [theta for some in own.values() for theta in some]
        self.listed = [instead.get(i, looking.components[i]) for i in self.component]
        for k in self.first:
            self.listed[k] = looking.components[self.component[k]]
        scenes = np.unique(looking.scene[self.component])
        stars = np.flatnonzero(np.isin(looking.scene, scenes) & fit.population.stars[fit.at])
        looking.compute_residuals(MODEL_ERROR)
        peaks = peaks_of(self.listed, self.theta)
        brightness = fit.brightness[self.component]
        brightness *= np.minimum(peaks / peaks[self.first][self.owner], 1)
        self.listed = renumbered(self.listed)
        self.around = looking.with_components(
            renumbered([*self.listed, *(looking.components[i] for i in stars)])
        )
        theta = [*self.theta, *(thetas[i] for i in stars)]
        brightness = np.append(brightness, fit.brightness[stars])
        self.around.render(scenes, theta, brightness, slopes=False)
        self._multiply(np.append(self.component, stars), looking.spectra, looking.sky)

    def _multiply(self, component, spectra, sky):
        """Computes the products; component (n + stars,); spectra (N, C) and sky of the fit."""
        around, n, n_all = self.around, len(self.owner), len(component)
        right, alone, level, light, own, of_stars = np.zeros((6, n_all, spectra.shape[1]))
        is_first, is_star = np.isin(np.arange(n_all), self.first), np.arange(n_all) >= n
        none, level_sky = around.put(np.zeros_like(right)), around.put(sky)
        for sight, (table, _) in zip(around.sights, around.overlapping_pairs, strict=True):
            one, other = around.at[table[:, :2]].T
            same = (component[one] == component[other]) & ~(is_star[one] | is_star[other])
            use = np.where(same, is_first[one] | is_first[other], is_star[one] != is_star[other])
            use |= one == other
            gram = sight.gram(around.device.put(table[use].astype(np.int32)), 1)[..., 0, 0]
            one, other, c = one[use], other[use], sight.channels
            right[around.at, c], level[around.at, c] = np.moveaxis(
                sight.residual_products(1)[:, :, 0], -1, 0
            )
            alone[one[one == other], c] = gram[one == other]
            twice = np.flatnonzero(one != other)
            a, b = np.concatenate([(one, other), (other[twice], one[twice])], axis=1)
            seen = spectra[component[b]][:, c] * np.concatenate([gram, gram[twice]])
            same = component[a] == component[b]
            for into, some in ((own, same & is_first[b]), (of_stars, ~same & is_star[b])):
                np.add.at(into[:, c], a[some], seen[some])
            sight.compute_residuals(around.scenes, around.slots, none, level_sky, MODEL_ERROR)
            light[around.at, c] = sight.residual_products(1)[:, :, 0, 0]
        right += own
        wrong = NEIGHBOUR_MODEL_ERROR * (light - right)
        wrong -= (NEIGHBOUR_MODEL_ERROR - STAR_MODEL_ERROR) * of_stars
        self.right, self.alone, self.level, self.explained, self.wrong = (
            values[:n] for values in (right, alone, level, own, wrong)
        )

    def full_gain(self, right, alone):
        """Gains (n,) of products (n, C) with the data and with themselves.

        Both are tied, and may be without the sky's level.
        """
        square = np.maximum(right, 0) ** 2
        return self.total(np.divide(square, alone, out=np.zeros_like(alone), where=alone > 0))

    def certain_gain(self, right, alone):
        """The same with the neighbours' errors."""
        return self.full_gain(right, np.where(alone > 0, alone + self.tied(self.wrong) ** 2, 0))

    def colour_gain(self, right, alone, spectra):
        """Gains (n,) of both signs, beyond those of one colour: that of spectra (n, C)."""
        each = np.divide(right**2, alone, out=np.zeros_like(alone), where=alone > 0)
        power = np.maximum(self.total(spectra**2 * alone), 1e-300)
        return self.total(each) - self.total(spectra * right) ** 2 / power

    def tied(self, values):
        """Products (n, C) of each channel as sums over those of its band."""
        ties = self.around.ties
        return values if ties is None else ties.spread(ties.total(values))

    def total(self, values):
        """Sums (n,) of values (n, C) over the bands."""
        ties = self.around.ties
        return (values if ties is None else values[:, ties.first]).sum(axis=1)
