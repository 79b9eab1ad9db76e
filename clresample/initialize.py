"""Where a fit starts: smooth profiles, free stars' positions and shifts, fitted to all data.

Gauss-Newton on the shapes with the spectra eliminated (variable projection), over every channel of
every instrument, so that a source that only one of them sees still starts right:

    min  sum_pixels w (d - sum_s A_s R S_s)^2 + sum ((theta - mean) / scatter)^2,     A >= 0

Smooth profiles leave a tenth of a bright galaxy's light unexplained; the weights know it,
1/w = sigma^2 + (MODEL_ERROR * model)^2, or spiral arms would be taken for faint neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from .frame import Frame
from .profiles import moment, point, profile
from .resample import Resampler
from .sources import Extended, Point

# What galaxies are before anyone looks: Gaussian sigma 0.25" (half-light radius 0.3") with a
# scatter of 0.4 in its logarithm, as in deep fields; ellipticity 0.26 per component (Leauthaud et
# al. 2007); wings between exponential and Gaussian.
SIZE_ARCSEC, SIZE_SCATTER = 0.25, 0.4
ELLIPTICITY_SCATTER = 0.26
WINGS, WINGS_SCATTER = 5.0, 0.7
# Several components of a source start this far apart in ln(size), a bulge and a disk.
COMPONENT_SPREAD = 1.0
# A star's position is known to this [px]; an observation's shift to that [model px].
STAR_SCATTER_PX, SHIFT_SCATTER_PX = 0.5, 2.0
MODEL_ERROR = 0.15
# Gauss-Newton: longest step of a parameter, iterations, and the part of chi2 that ends them when
# it is all that one gains
LONGEST_STEP, N_ITERATIONS, ENOUGH = 0.7, 10, 1e-3
# Sources exactly on top of each other share their light: a ridge on the scaled normal matrix
RIDGE = 1e-8
# A box holds what reaches this part of the noise: the profile, or the structure that the prior
# allows about it (alpha = 0.1 of the root of the light); as a part of the peak, within bounds.
BOX_NOISE, BOX_FAINTEST, BOX_BRIGHTEST = 0.1, 1e-7, 5e-3
SMALLEST_RADIUS_PX = 5
# Light this far under the brightest is none: float32 would keep it as denormals, 20 times slower.
DARK = 1e-20


@dataclass(frozen=True, eq=False)
class View:
    """One observation ready to be fitted: its operator and whitened data.

    op: model frame -> observation
    root (Co, My, Mx): square root of the weights, 0 where the model does not cover
    data (Co, My, Mx): the observation's data
    """

    op: Resampler
    root: np.ndarray
    data: np.ndarray

    def render(self, images):
        """Whitened unit-spectrum images (n, Co, My * Mx) of model images (n, Ny, Nx).

        Images smaller than the operator's frame are zero beyond.
        """
        images = _padded(images, self.op.shape_in).astype(self.op.dtype)
        images[np.abs(images) < DARK * np.abs(images).max(initial=0)] = 0
        out = self.op.render(images) * self.root
        return out.reshape(*out.shape[:2], -1).astype(np.float64)


@dataclass(eq=False)
class Start:
    """Components of a scene before their own structure is fitted.

    source (n): the source of each component
    base (n, Ny, Nx): profiles over the frame, unit integral
    spectra (n, C) [counts]: total flux; covariance (C, n, n); sky (C,)
    positions (S, 2) [px]; shifts (n_observations, 2) [model px]
    """

    source: np.ndarray
    base: np.ndarray
    spectra: np.ndarray
    sky: np.ndarray
    positions: np.ndarray
    shifts: np.ndarray


def start(frame: Frame, sources, positions, views: list[View], *, fit_shifts=False,
          fit_sky=False) -> Start:
    """Fit profiles, free stars and shifts; see the module's text.

    sources (S), positions (S, 2) [px]: those inside the frame
    fit_shifts: let every observation but the first move; its operators are left shifted
    """
    fit = _ProfileFit(frame, sources, positions, views, fit_shifts, fit_sky)
    fit.run()
    return fit.start()


def solve_spectra(units, views, sky=False, model=None):
    """Non-negative spectra (n, C) by weighted least squares over all components at once.

    units: per view, whitened unit-spectrum images (n, Co, P); sky: also a constant per channel
    model: per view (Co, P) whitened, inflates the variance by (MODEL_ERROR model)^2
    returns spectra (n, C), sky (C,), covariance (C, n, n): inverse normal matrix, sky marginalised
    """
    spectra, levels, covariances = [], [], []
    for i, (view, unit) in enumerate(zip(views, units, strict=True)):
        for c in range(unit.shape[1]):
            rows = unit[:, c]
            target = (view.data[c] * view.root[c]).ravel()
            if sky:
                rows = np.concatenate([rows, [view.root[c].ravel()]])
            weight = 1.0 if model is None else 1 / (1 + (MODEL_ERROR * model[i][c]) ** 2)
            a, covariance = _non_negative(rows, target, weight, n_free=int(sky))
            spectra.append(a[: len(unit)])
            levels.append(a[-1] if sky else 0.0)
            covariances.append(covariance[: len(unit), : len(unit)])
    return np.array(spectra).T, np.array(levels), np.array(covariances)


def _non_negative(rows, target, weight, n_free=0):
    """min |target - a rows|^2, a >= 0 but for the last n_free; and a's unconstrained covariance."""
    normal = (rows * weight) @ rows.T
    size = np.sqrt(np.diag(normal))
    seen = size > 1e-12 * size.max(initial=0)
    scale = np.where(seen, size, 1)
    normal = normal / scale[:, None] / scale + RIDGE * np.eye(len(rows))
    lower = np.linalg.cholesky(normal)
    right = np.linalg.solve(lower, (rows * weight) @ target / scale)
    matrix = lower.T
    if n_free:  # a free coefficient is the difference of two non-negative ones
        matrix = np.concatenate([matrix, -matrix[:, -n_free:]], axis=1)
    a = nnls(matrix, right)[0]
    if n_free:
        a = np.concatenate([a[: -2 * n_free], a[-2 * n_free : -n_free] - a[-n_free:]])
    covariance = np.linalg.inv(normal) / scale[:, None] / scale
    covariance[~seen, :] = covariance[:, ~seen] = 0
    covariance[~seen, ~seen] = np.inf
    return np.where(seen, a / scale, 0), covariance


class _ProfileFit:
    def __init__(self, frame, sources, positions, views, fit_shifts, fit_sky):
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
                    scatter.append(np.array([SIZE_SCATTER, *[ELLIPTICITY_SCATTER] * 2,
                                             WINGS_SCATTER]))
        self.counts = [len(m) for m in mean]
        self.n_shifts = 2 * (len(views) - 1) if fit_shifts else 0
        self.mean = np.concatenate([*mean, np.zeros(self.n_shifts)])
        self.scatter = np.concatenate([*scatter, np.full(self.n_shifts, SHIFT_SCATTER_PX)])
        self.theta = self.mean.copy()
        self.n_shape = len(self.mean) - self.n_shifts
        self.shift_start = np.array([view.op.shift[0] for view in views])

    def images(self, theta):
        """Per component, (1 + its parameters, Ny, Nx): the profile and its slopes."""
        parts = np.split(theta[: self.n_shape], np.cumsum(self.counts)[:-1])
        shape, out = self.frame.shape, []
        for kind, source, part in zip(self.kinds, self.source, parts, strict=True):
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
        self._set_shifts(theta)
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
        state = {"spectra": spectra, "sky": sky, "theta": theta, "chi2": 0.0,
                 "normal": np.zeros((n, n)), "right": np.zeros(n)}
        channel = 0
        for i, view in enumerate(self.views):
            moves = self._shift_slopes(i, images, spectra[:, channel:]) if self.n_shifts else None
            for c in range(rendered[i].shape[1]):
                a = spectra[:, channel]
                columns = np.zeros((n, rendered[i].shape[2]))
                columns[: self.n_shape] = a[owner, None] * rendered[i][slopes, c]
                if i and self.n_shifts:
                    columns[self.n_shape + 2 * (i - 1) : self.n_shape + 2 * i] = moves[:, c]
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
        damping, best = 1e-2, self.linearise(self.theta)
        for _ in range(N_ITERATIONS if len(self.theta) else 0):
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
        self._set_shifts(theta)
        images = [i[0] for i in self.images(theta)]
        parts = np.split(theta[: self.n_shape], np.cumsum(self.counts)[:-1])
        for kind, source, part in zip(self.kinds, self.source, parts, strict=True):
            if kind == "star":
                self.positions[source] += part
        shifts = np.array([view.op.shift[0] for view in self.views])
        return Start(np.array(self.source), np.array(images), self.best["spectra"],
                     self.best["sky"], self.positions, shifts)

    def _models(self, units, spectra, sky):
        """Whitened models (Co, P) per view."""
        out, channel = [], 0
        for unit, view in zip(units, self.views, strict=True):
            part = slice(channel, channel + unit.shape[1])
            channel = part.stop
            level = sky[part, None] * view.root.reshape(unit.shape[1], -1)
            out.append(np.einsum("nc,ncp->cp", spectra[:, part], unit) + level)
        return out

    def _set_shifts(self, theta):
        if self.n_shifts:
            moves = np.concatenate([np.zeros(2), theta[self.n_shape :]]).reshape(-1, 2)
            for view, first, move in zip(self.views, self.shift_start, moves, strict=True):
                if not np.array_equal(view.op.shift[0], first + move):
                    view.op.shift = first + move

    def _shift_slopes(self, i_view, images, spectra):
        """Derivatives (2, Co, P) of a view's whitened model by its shift: R of its slopes."""
        op = self.views[i_view].op
        units = np.array([i[0] for i in images])
        model = np.einsum("nc,nyx->cyx", spectra[:, : op.shape_out[0]], units)
        slopes = np.array([_slope(model, axis) for axis in (-2, -1)])
        out = op.forward(_padded(slopes, op.shape_in).astype(op.dtype)) * self.views[i_view].root
        return out.reshape(*out.shape[:2], -1).astype(np.float64)


def _padded(images, shape):
    """Images (..., Ny, Nx) with zeros beyond, up to the last two of `shape`."""
    more = [(0, n - m) for n, m in zip(shape[-2:], images.shape[-2:], strict=True)]
    return np.pad(images, [(0, 0)] * (images.ndim - 2) + more)


def _slope(images, axis):
    """Derivative along an axis of band-limited images (..., Ny, Nx)."""
    n = images.shape[axis]
    nu = np.fft.fftfreq(n)
    if n % 2 == 0:
        nu[n // 2] = 0  # a lone Nyquist term has no slope
    shape = [1] * images.ndim
    shape[axis] = n
    waves = np.fft.fft(images, axis=axis) * (2j * np.pi * nu).reshape(shape)
    return np.fft.ifft(waves, axis=axis).real


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


def box_threshold(brightness):
    """Part of the peak above which a pixel is worth its place; the peak is `brightness` sigma."""
    brightness = max(brightness, 1.0)
    return np.clip(min(BOX_NOISE / brightness, brightness**-2), BOX_FAINTEST, BOX_BRIGHTEST)


def box_around(base, position, brightness):
    """Box of one profile: origin (2,) and shape (2,) inside the frame, and its centre pixel (2,).

    base (Ny, Nx): profile; position (2,) [px]; brightness: its peak over the noise of a model
    pixel, in the channel that sees it best
    """
    threshold = box_threshold(brightness) * base.max()
    pixel = np.clip(np.floor(np.asarray(position) + 0.5).astype(int), 0, np.array(base.shape) - 1)
    lit = base > threshold
    low, high = np.zeros(2, int), np.zeros(2, int)
    for axis in (0, 1):
        along = np.flatnonzero(lit.any(axis=1 - axis))
        first, last = (along[0], along[-1]) if len(along) else (pixel[axis], pixel[axis])
        low[axis] = max(min(first, pixel[axis] - SMALLEST_RADIUS_PX), 0)
        high[axis] = min(max(last, pixel[axis] + SMALLEST_RADIUS_PX), base.shape[axis] - 1)
    return low, high - low + 1, pixel - low
