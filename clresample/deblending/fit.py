"""One blend on its way from data to result: views of its observations, start, problem, result."""

from __future__ import annotations

import functools
import time
from dataclasses import replace

import numpy as np

from ..resampling.transfer import noise_warnings
from ..sky.frame import Frame, model_frame
from ..sky.observation import check_observations
from ..sky.sources import Point
from .resize import box_around
from .result import Component, Result
from .solver.curvature import damping
from .solver.problem import Problem
from .spectra import solve_spectra
from .start import start
from .view import covered_part, pixel_noise, whitened_view

# Spectrum steps come in units of the flux's error plus this part of the flux.
SPECTRUM_PART = 0.02


class Fit:
    """One blend on its way from data to result."""

    def __init__(self, blend, settings, device, dtype, *, pad):
        began = time.perf_counter()
        self.blend, self.settings = blend, settings
        check_observations(blend.observations)
        self.frame = blend.frame or model_frame(blend.observations)
        _check_profiles(blend.sources, self.frame)
        positions = self.frame.place(blend.sources)
        inside = self.frame.inside(positions)
        self.messages = [
            f"source {i} at {p} [px] lies outside the model frame {self.frame.shape}"
            for i, p in enumerate(positions)
            if not inside[i]
        ]
        self.fitted = np.flatnonzero(inside)
        if not len(self.fitted):
            raise ValueError(
                f"none of the {len(positions)} sources lies inside the model frame "
                f"{self.frame.shape}"
            )
        self.shifts = _shifts(blend)
        private = settings.fit_shifts or self.shifts.any()
        self.padded = _padded_frame(self.frame, pad)
        self.views, self.units = [], []
        for o in blend.observations:
            view, unit = whitened_view(
                self.frame, self.padded, o, pad, device, dtype, private=private
            )
            if private:
                view.op.shift = self.shifts[len(self.views)]
            self.views.append(view)
            self.units.append(unit)
        for o, view in zip(blend.observations, self.views, strict=True):
            self.messages += [f"{o.label}: {line}" for line in noise_warnings(view.op.certificate)]
        if not any(view.root.any() for view in self.views):
            raise ValueError("no observed pixel on the model frame has a weight")
        self.unit = np.concatenate(self.units)
        self.losses, self.status = [], "iteration limit"
        self.best = np.inf, None, self.shifts  # the lowest loss, its Problem and shifts
        sources = [blend.sources[i] for i in self.fitted]
        self.start = start(
            self.frame, sources, positions[inside], self.views, fit_sky=settings.fit_sky
        )
        self.problem = self._problem(sources)
        self.seconds = {"setup": time.perf_counter() - began}

    def _problem(self, sources):
        begin, views = self.start, self.views
        peak = begin.base.max(axis=(1, 2), keepdims=True)
        self.base = base = begin.base / np.where(peak > 0, peak, 1)
        self.noise = pixel_noise(views)
        units = [v.render(base) for v in views]
        spectra, sky, _ = solve_spectra(units, views, self.settings.fit_sky)
        noise = 1 / np.sqrt(
            np.maximum(np.concatenate([(u**2).sum(axis=2) for u in units], axis=1), 1e-30)
        )
        origin, center, morphs = [], [], []
        for i, image in enumerate(base):
            brightness = (spectra[i] / self.noise).max()
            low, size, middle = box_around(image, begin.positions[begin.source[i]], brightness)
            origin.append(low)
            center.append(middle)
            morphs.append(image[low[0] : low[0] + size[0], low[1] : low[1] + size[1]].copy())
        seen = noise < 1e14
        problem = Problem(
            shape=self.padded.shape,
            extent=self.frame.shape,
            ops=[v.op for v in views],
            data=[v.data for v in views],
            weights=[v.root**2 for v in views],
            origin=np.array(origin),
            center=np.array(center),
            base=morphs,
            field=[np.zeros_like(m) for m in morphs],
            morph=[m.copy() for m in morphs],
            fixed=np.array([isinstance(sources[i], Point) for i in begin.source]),
            spectra=spectra,
            scale=np.where(seen, noise + SPECTRUM_PART * spectra, 0),
            sky=sky,
            fit_sky=self.settings.fit_sky,
        )
        return replace(problem, damping=damping(problem, self.settings.prior))

    @functools.cached_property
    def bytes(self):
        """Device memory of the scene in a batch, roughly."""
        pixels = sum(2 * np.prod(o.shape_in) + 4 * np.prod(o.shape_out) for o in self.problem.ops)
        return int(8 * (pixels + 12 * sum(m.size for m in self.problem.morph)))

    def result(self) -> Result:
        """Everything back in the data's own units, spectra solved for the final morphologies."""
        began, p, n = time.perf_counter(), self.problem, len(self.problem.spectra)
        morphs = np.zeros((n, *p.shape))
        for full, (y, x), m in zip(morphs, p.origin, p.morph, strict=True):
            peak = m.max() if m.max() > 0 else 1.0
            full[y : y + m.shape[0], x : x + m.shape[1]] = m / peak
        observed = [v.observe(morphs) for v in self.views]
        units = [v.whiten(images) for v, images in zip(self.views, observed, strict=True)]
        spectra, sky, covariance = solve_spectra(units, self.views, self.settings.fit_sky)
        components = []
        for i, ((y, x), m) in enumerate(zip(p.origin, p.morph, strict=True)):
            part = morphs[i, y : y + m.shape[0], x : x + m.shape[1]]
            components.append(
                Component(
                    int(self.fitted[self.start.source[i]]),
                    (int(y), int(x)),
                    part,
                    spectra[i] * self.unit,
                )
            )
        rendered = []
        for view, o, images in zip(self.views, self.blend.observations, observed, strict=True):
            images = images.astype(np.float64) * covered_part(view.op, self.frame)
            rendered.append(images[..., : o.data.shape[1], : o.data.shape[2]])
        self.seconds["result"] = time.perf_counter() - began
        return Result(
            observations=self.blend.observations,
            frame=self.frame,
            sources=self.blend.sources,
            components=tuple(components),
            rendered=tuple(rendered),
            sky=sky * self.unit,
            covariance=covariance * self.unit[:, None, None] ** 2,
            shifts=self.shifts,
            losses=np.array(self.losses),
            status=self.status,
            messages=tuple(self.messages),
            seconds=self.seconds,
        )


def _check_profiles(sources, frame):
    for i, source in enumerate(sources):
        profile = getattr(source, "profile", None)
        if profile is not None and np.shape(profile) != frame.shape:
            raise ValueError(
                f"profile of source {i} has the shape {np.shape(profile)}, "
                f"the model frame {frame.shape}"
            )


def _shifts(blend):
    """Shifts (n_observations, 2) [model px] that a blend comes with."""
    expected = len(blend.observations), 2
    shifts = np.zeros(expected) if blend.shifts is None else np.asarray(blend.shifts, float)
    if shifts.shape != expected or not np.isfinite(shifts).all():
        raise ValueError(f"shifts is {shifts.tolist()}, must be {expected} finite numbers")
    return shifts


def _padded_frame(frame, pad):
    shape = tuple(-(-n // pad) * pad for n in frame.shape)
    return frame if shape == frame.shape else Frame(frame.grid.cutout(0, 0, shape), frame.psf)
