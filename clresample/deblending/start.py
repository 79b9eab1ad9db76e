"""Where a fit starts: smooth profiles and the positions of free stars, fitted to all data at once.

Gauss-Newton on the shapes with the spectra eliminated (variable projection), over every channel of
every instrument, so that a source that only one of them sees still starts right:

    min  sum_pixels w (d - sum_s A_s R S_s)^2 + sum ((theta - mean) / scatter)^2,     A >= 0

Smooth profiles leave a tenth of a bright galaxy's light unexplained; the weights know it,
1/w = sigma^2 + (MODEL_ERROR * model)^2, or spiral arms would be taken for faint neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.frame import Frame
from ..sky.sources import Extended, Point
from .profiles import moment, point, profile
from .spectra import MODEL_ERROR, RIDGE, solve_spectra
from .view import WhitenedView

# What galaxies are before anyone looks: Gaussian sigma 0.25" (half-light radius 0.3") with a
# scatter of 0.4 in its logarithm, as in deep fields; ellipticity 0.26 per component (Leauthaud et
# al. 2007); wings between exponential and Gaussian.
SIZE_ARCSEC, SIZE_SCATTER = 0.25, 0.4
ELLIPTICITY_SCATTER = 0.26
WINGS, WINGS_SCATTER = 5.0, 0.7
# Several components of a source start this far apart in ln(size), a bulge and a disk.
COMPONENT_SPREAD = 1.0
# A star's position is known to this [px].
STAR_SCATTER_PX = 0.5
# Gauss-Newton: longest step of a parameter, iterations, and the part of chi2 that ends them when
# it is all that one gains
LONGEST_STEP, N_ITERATIONS, ENOUGH = 0.7, 10, 1e-3


@dataclass(eq=False)
class StartingPoint:
    """Components of a scene before their own structure is fitted.

    source (n): the source of each component
    base (n, Ny, Nx): profiles over the frame, unit integral
    spectra (n, C), sky (C,) [counts]: total fluxes and constants, by the weights that know of the
        model error
    positions (S, 2) [px]
    """

    source: np.ndarray
    base: np.ndarray
    spectra: np.ndarray
    sky: np.ndarray
    positions: np.ndarray


def start(
    frame: Frame, sources, positions, views: list[WhitenedView], *, fit_sky=False
) -> StartingPoint:
    """Fit profiles and free stars; see the module's text.

    sources (S), positions (S, 2) [px]: those inside the frame
    """
    fit = _ProfileFit(frame, sources, positions, views, fit_sky)
    fit.run()
    return fit.start()


class _ProfileFit:
    def __init__(self, frame, sources, positions, views, fit_sky):
        self.frame, self.views, self.fit_sky = frame, views, fit_sky
        self.psf_moment = moment(frame.psf)
        self.positions = np.array(positions, dtype=np.float64)
        self.kinds, self.source, self.given, mean, scatter = [], [], {}, [], []
        scale = float(np.mean(frame.grid.pixel_scale_arcsec))
        for i, source in enumerate(sources):
            count = source.n_components if isinstance(source, Extended) else 1
            for k in range(count):
                self.source.append(i)
                if isinstance(source, Point):
                    self.kinds.append("star" if source.free else "fixed")
                    n = 2 if source.free else 0
                    mean.append(np.zeros(n))
                    scatter.append(np.full(n, STAR_SCATTER_PX))
                elif source.profile is not None:
                    self.kinds.append("given")
                    self.given[i] = np.asarray(source.profile) / np.sum(source.profile)
                    mean.append(np.zeros(0))
                    scatter.append(np.zeros(0))
                else:
                    self.kinds.append("galaxy")
                    size = np.log(SIZE_ARCSEC / scale) + COMPONENT_SPREAD * (k - (count - 1) / 2)
                    mean.append(np.array([size, 0, 0, np.log(WINGS)]))
                    scatter.append(
                        np.array([SIZE_SCATTER, *[ELLIPTICITY_SCATTER] * 2, WINGS_SCATTER])
                    )
        self.counts = [len(m) for m in mean]
        self.mean, self.scatter = np.concatenate(mean), np.concatenate(scatter)

    def images(self, theta):
        """Per component, (1 + its parameters, Ny, Nx): the profile and its slopes."""
        shape, out = self.frame.shape, []
        for kind, source, part in zip(self.kinds, self.source, self._parts(theta), strict=True):
            position = self.positions[source]
            if kind == "galaxy":
                out.append(profile(part, position, shape, self.psf_moment))
            elif kind == "given":
                out.append(self.given[source][None])
            else:
                moved = position + (part if kind == "star" else 0)
                out.append(point(self.frame.psf, moved, shape, slopes=kind == "star"))
        return out

    def linearise(self, theta):
        """At theta: spectra, chi2, and its normal equations with the spectra eliminated."""
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
        n = len(theta)
        state = {
            "spectra": spectra,
            "sky": sky,
            "theta": theta,
            "chi2": 0.0,
            "normal": np.zeros((n, n)),
            "right": np.zeros(n),
        }
        channel = 0
        for i, view in enumerate(self.views):
            for c in range(rendered[i].shape[1]):
                a = spectra[:, channel]
                columns = a[owner, None] * rendered[i][slopes, c]
                weight = 1 / (1 + (MODEL_ERROR * models[i][c]) ** 2)
                residual = (view.data[c] * view.root[c]).ravel() - models[i][c]
                state["chi2"] += float(weight @ residual**2)
                lit = units[i][a > 0, c]
                if self.fit_sky:
                    lit = np.concatenate([lit, [view.root[c].ravel()]])
                _accumulate(state, columns, lit, weight, residual)
                channel += 1
        pull = (self.mean - theta) / self.scatter
        state["chi2"] += float(pull @ pull)
        state["normal"] += np.diag(self.scatter**-2.0)
        state["right"] += pull / self.scatter
        return state

    def run(self):
        """Levenberg-Marquardt; the last accepted state is kept."""
        damping, best = 1e-2, self.linearise(self.mean)
        for _ in range(N_ITERATIONS if len(self.mean) else 0):
            matrix = best["normal"] + damping * np.diag(np.diag(best["normal"]))
            step = np.linalg.solve(matrix, best["right"])
            step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            new = self.linearise(best["theta"] + step)
            gain = best["chi2"] - new["chi2"]
            if gain > 0:
                best, damping = new, damping / 3
                if gain < ENOUGH * new["chi2"]:
                    break
            else:
                damping *= 10
                if damping > 1e3:
                    break
        self.best = best

    def start(self):
        theta = self.best["theta"]
        images = [i[0] for i in self.images(theta)]
        for kind, source, part in zip(self.kinds, self.source, self._parts(theta), strict=True):
            if kind == "star":
                self.positions[source] += part
        return StartingPoint(
            np.array(self.source),
            np.array(images),
            self.best["spectra"],
            self.best["sky"],
            self.positions,
        )

    def _parts(self, theta):
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


def _accumulate(state, columns, lit, weight, residual):
    """Add one channel's normal equations, its spectra (the rows `lit`) eliminated."""
    weighted = columns * weight
    state["normal"] += weighted @ columns.T
    state["right"] += weighted @ residual
    if not len(lit):
        return
    lit_weighted = lit * weight
    inner = lit_weighted @ lit.T
    inner += RIDGE * np.trace(inner) * np.eye(len(inner))
    cross = lit_weighted @ columns.T
    solved = np.linalg.solve(inner, cross)
    state["normal"] -= cross.T @ solved
    state["right"] -= solved.T @ (lit_weighted @ residual)
