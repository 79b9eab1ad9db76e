"""Light of a star by distance from it, all directions together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

# [sigma] Rings of less light are left to medians along rays; pixels of a ring, at least; rings over
# which the slope at either end is taken.
RING_SIGMAS, MIN_RING, END_RINGS = 3.0, 6, 3
LOG_STEP = 0.1  # of a radius, over which the slope at the rim is taken


@dataclass(frozen=True, eq=False)
class Fall:
    """Light of a star by distance, all directions together.

    log_radius, log_light (n,): of its rings, n > 2, between which it is interpolated; it goes on as
    a power of the distance beyond both ends
    """

    log_radius: np.ndarray
    log_light: np.ndarray

    @classmethod
    def of(cls, data, usable, away, sigma):
        """Measures rings one pixel wide in pixels (My, Mx) at distances `away` [px].

        Rings end where their light rises or is below RING_SIGMAS. None if fewer than three remain.
        """
        rings, found = np.rint(away[usable]).astype(int), []
        value, radius = data[usable], away[usable]
        for r in range(rings.min(initial=0), rings.max(initial=-1) + 1):
            own = rings == r
            if own.sum() < MIN_RING:
                continue
            light = np.median(value[own])
            if light < RING_SIGMAS * sigma or (found and light > found[-1][1]):
                break
            found.append((np.median(radius[own]), light))
        return cls(*np.log(found).T) if len(found) > 2 else None

    def at(self, radius):
        """The light at distances [px], any shape; those under a pixel count as one."""
        x = np.log(np.maximum(radius, 1.0))
        u, v = self.log_radius, self.log_light
        found = PchipInterpolator(u, v)(np.clip(x, u[0], u[-1]))
        k = min(END_RINGS, len(u) - 1)
        for end, far, outside in ((0, k, x < u[0]), (-1, -1 - k, x > u[-1])):
            slope = (v[end] - v[far]) / (u[end] - u[far])
            found = found + np.where(outside, slope * (x - u[end]), 0.0)
        return np.exp(found)

    def power(self, radius) -> float:
        """Power of the distance by which the light falls at a radius [px]."""
        ends = self.at(np.array([1.0, np.exp(LOG_STEP)]) * radius)
        return float(np.log(ends[0] / ends[1]) / LOG_STEP)

    def outside(self, radius, core):
        """The same with the Gaussian in a core [px] that has its light and slope at the rim.

        What nobody sees of a star is rendered with errors of rounding that are parts of the
        brightest sample: a Gaussian is fainter, and as smooth as can be.
        """
        inside = self.at(core) * np.exp(0.5 * self.power(core) * (1 - (radius / core) ** 2))
        return np.where(radius < core, inside, self.at(radius))
