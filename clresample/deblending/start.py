"""Where a fit starts: smooth profiles and the positions of free stars, fitted to all data at once.

Gauss-Newton on the shapes with the spectra eliminated (variable projection), over every channel of
every instrument, so that a source that only one of them sees still starts right:

    min  sum_pixels w (d - sum_s A_s R S_s)^2 + sum ((theta - mean) / scatter)^2,     A >= 0

Smooth profiles leave a tenth of a bright galaxy's light unexplained. The weights allow for it,
1/w = sigma^2 + (MODEL_ERROR * model)^2: without, spiral arms would be taken for faint neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.frame import Frame
from .profiles import Galaxy, Star, components_of
from .spectra import MODEL_ERROR, RIDGE, solve_spectra
from .view import WhitenedView

# Longest step of a parameter: far from the minimum the quadratic model of chi2 promises too much.
LONGEST_STEP = 0.7
# Most steps, and the part of chi2 that ends them when one of them gains no more than it.
N_STEPS, ENOUGH = 10, 1e-3
# Levenberg-Marquardt: damping of the first step as a part of the normal matrix's diagonal, what it
# is divided by after a step that gains, multiplied by after one that does not, and where it ends.
FIRST_DAMPING, LESS, MORE, MOST_DAMPING = 1e-2, 3, 10, 1e3
# [sigma] What counts as light at a source: noise alone reaches it once in 740 times, what `detect`
# finds has 5. A source is far from any light where neither its expected profile at its position
# shows that, nor a galaxy NEARBY times larger than expected does, 1.5" in sigma: a source that is
# too faint by itself, but beside others, is probably meant.
LIGHT_SIGMAS, NEARBY = 3.0, 6.0


@dataclass(frozen=True, eq=False)
class StartingPoint:
    """Components of a scene before their own structure is fitted.

    source (n): the source of each component
    profiles (n, Ny, Nx): over the frame, unit integral
    positions (S, 2) [px]: of the sources, free stars where they were found
    dark (S,): bool, whether a source is far from any light, see `_is_dark`
    shapes (n): the components' Shapes; thetas (n): arrays of their parameters
    spectra (n, C): least squares for these profiles
    """

    source: np.ndarray
    profiles: np.ndarray
    positions: np.ndarray
    dark: np.ndarray
    shapes: list
    thetas: list
    spectra: np.ndarray

    def stars(self):
        """The point sources: each one's Star, place (2,) [px] and spectrum (C,), a list."""
        rows = zip(self.shapes, self.positions[self.source], self.spectra, strict=True)
        return [row for row in rows if isinstance(row[0], Star)]


def start(
    frame: Frame, sources, positions, views: list[WhitenedView], *, fit_sky=False
) -> StartingPoint:
    """Fit profiles and free stars; see the module's text.

    sources (S), positions (S, 2) [px]: those inside the frame; fit_sky: also a level per channel
    """
    fit = _ProfileFit(frame, sources, positions, views, fit_sky)
    first, best = fit.run()
    dark = _is_dark(first.snr)
    if dark.any():
        wide = Galaxy(frame, widened=NEARBY)
        images = [wide.draw(wide.mean, p)[:1] for p in fit.positions[dark]]
        units = [view.render(np.concatenate(images)) for view in views]
        dark[dark] = _is_dark(_signal_to_noise(units, views, first.sky))
    return StartingPoint(
        np.array(fit.source),
        np.array([images[0] for images in fit.images(best.theta)]),
        fit.places(best.theta),
        dark,
        fit.components,
        fit.parts(best.theta),
        best.spectra,
    )


def _signal_to_noise(units, views, sky):
    """Signal to noise (n, C) of all light but the sky's through n filters: <u, d> / |u|, 0 where
    the filter sees nothing.

    units: per view, whitened images u (n, Co, P); sky (C,)
    """
    found, channel = [], 0
    for unit, view in zip(units, views, strict=True):
        for c in range(unit.shape[1]):
            light = ((view.data[c] - sky[channel]) * view.root[c]).ravel()
            size = np.sqrt((unit[:, c] ** 2).sum(axis=1))
            out = np.zeros(len(size))
            found.append(np.divide(unit[:, c] @ light, size, out=out, where=size > 0))
            channel += 1
    return np.array(found).T


def _is_dark(snr):
    """Where (n,) there is no light, from its signal to noise (n, C).

    Neither in any channel nor in all that see the place together, each with the same weight: that
    finds what is faint in each of many channels.
    """
    n_seen = np.maximum(np.count_nonzero(snr, axis=1), 1)
    together = snr.sum(axis=1) / np.sqrt(n_seen)
    return np.maximum(snr.max(axis=1), together) < LIGHT_SIGMAS


@dataclass(frozen=True, eq=False)
class _Linearised:
    """The fit at some theta, to first order.

    theta (n,), spectra (n_components, C), sky (C,): where
    snr (S, C): signal to noise of all light as the sources see it, see `_signal_to_noise`; of
        several components of a source that which sees most
    chi2: with the prior of theta; normal (n, n), right (n,): of the Gauss-Newton step, the spectra
        eliminated, normal step = right
    """

    theta: np.ndarray
    spectra: np.ndarray
    sky: np.ndarray
    snr: np.ndarray
    chi2: float
    normal: np.ndarray
    right: np.ndarray


class _ProfileFit:
    """The least-squares problem of all components' parameters theta together.

    components (n), source (n): what is drawn, and the source each belongs to
    positions (S, 2) [px]: as given; mean, scatter: of theta, one component's after the other's
    """

    def __init__(self, frame, sources, positions, views, fit_sky):
        self.views, self.fit_sky = views, fit_sky
        self.positions = np.array(positions, dtype=np.float64)
        pairs = [(i, c) for i, source in enumerate(sources) for c in components_of(source, frame)]
        self.source, self.components = [i for i, _ in pairs], [c for _, c in pairs]
        self.counts = [len(c.mean) for c in self.components]
        self.mean = np.concatenate([c.mean for c in self.components])
        self.scatter = np.concatenate([c.scatter for c in self.components])

    def images(self, theta):
        """Per component, (1 + its parameters, Ny, Nx): the profile and its slopes."""
        parts = zip(self.components, self.parts(theta), self.source, strict=True)
        return [c.draw(part, self.positions[source]) for c, part, source in parts]

    def places(self, theta):
        """Positions (S, 2) [px] of the sources at theta."""
        positions = self.positions.copy()
        for c, part, source in zip(self.components, self.parts(theta), self.source, strict=True):
            positions[source] = c.place(part, self.positions[source])
        return positions

    def linearise(self, theta) -> _Linearised:
        """Spectra, chi2, and its normal equations with the spectra eliminated, at theta."""
        images = self.images(theta)
        rendered = [view.render(np.concatenate(images)) for view in self.views]
        heads = np.cumsum([0, *(len(i) for i in images)])[:-1]
        slopes = np.setdiff1d(np.arange(sum(map(len, images))), heads)
        owner = np.repeat(np.arange(len(images)), self.counts)
        units = [r[heads] for r in rendered]
        spectra, sky, _ = solve_spectra(units, self.views, self.fit_sky)
        for _ in range(2):  # the weights follow the model
            models = self._models(units, spectra, sky)
            spectra, sky, _ = solve_spectra(units, self.views, self.fit_sky, models)
        models = self._models(units, spectra, sky)
        equations = _NormalEquations(len(theta))
        channel = 0
        for i, view in enumerate(self.views):
            for c in range(rendered[i].shape[1]):
                a = spectra[:, channel]
                columns = a[owner, None] * rendered[i][slopes, c]
                weight = 1 / (1 + (MODEL_ERROR * models[i][c]) ** 2)
                residual = (view.data[c] * view.root[c]).ravel() - models[i][c]
                lit = units[i][a > 0, c]
                if self.fit_sky:
                    lit = np.concatenate([lit, [view.root[c].ravel()]])
                equations.add_channel(columns, lit, weight, residual)
                channel += 1
        equations.add_prior((self.mean - theta) / self.scatter, self.scatter)
        snr = np.full((len(self.positions), len(sky)), -np.inf)
        np.maximum.at(snr, self.source, _signal_to_noise(units, self.views, sky))
        e = equations
        return _Linearised(theta, spectra, sky, snr, e.chi2, e.normal, e.right)

    def run(self) -> tuple[_Linearised, _Linearised]:
        """Levenberg-Marquardt: where it began, at the mean, and the last step that gained."""
        damping, first = FIRST_DAMPING, self.linearise(self.mean)
        best = first
        for _ in range(N_STEPS if len(self.mean) else 0):
            matrix = best.normal + damping * np.diag(np.diag(best.normal))
            step = np.linalg.solve(matrix, best.right)
            step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            new = self.linearise(best.theta + step)
            gain = best.chi2 - new.chi2
            if gain > 0:
                best, damping = new, damping / LESS
                if gain < ENOUGH * new.chi2:
                    break
            else:
                damping *= MORE
                if damping > MOST_DAMPING:
                    break
        return first, best

    def parts(self, theta):
        """The parameters of each component."""
        return np.split(theta, np.cumsum(self.counts)[:-1])

    def _models(self, units, spectra, sky):
        """Whitened models (Co, P) per view."""
        out, channel = [], 0
        for unit, view in zip(units, self.views, strict=True):
            part = slice(channel, channel + unit.shape[1])
            channel = part.stop
            level = sky[part, None] * view.root.reshape(unit.shape[1], -1)
            out.append(np.einsum("nc,ncp->cp", spectra[:, part], unit) + level)
        return out


class _NormalEquations:
    """chi2 and the normal equations of n parameters, summed channel by channel."""

    def __init__(self, n):
        self.chi2, self.normal, self.right = 0.0, np.zeros((n, n)), np.zeros(n)

    def add_channel(self, columns, lit, weight, residual):
        """One channel's part, its spectra eliminated.

        columns (n, P): slopes of the model by the parameters; lit (L, P): by the spectra (and the
        sky) that are free; weight, residual (P,)
        """
        self.chi2 += float(weight @ residual**2)
        weighted = columns * weight
        self.normal += weighted @ columns.T
        self.right += weighted @ residual
        if not len(lit):
            return
        lit_weighted = lit * weight
        inner = lit_weighted @ lit.T
        inner += RIDGE * np.trace(inner) * np.eye(len(inner))
        cross = lit_weighted @ columns.T
        solved = np.linalg.solve(inner, cross)
        self.normal -= cross.T @ solved
        self.right -= solved.T @ (lit_weighted @ residual)

    def add_prior(self, pull, scatter):
        """The parameters' own expectation: pull (n,) = (mean - theta) / scatter."""
        self.chi2 += float(pull @ pull)
        self.normal += np.diag(scatter**-2.0)
        self.right += pull / scatter
