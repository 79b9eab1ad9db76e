"""Radial profile of a star, averaged over all directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# [sigma] Smallest light of a ring; smallest number of its pixels; number of rings over which the
# slope at either end is measured.
RING_SIGMAS, MIN_RING, END_RINGS = 3.0, 6, 3
# Powers of the distance among which a halo's is chosen; smallest light of it, in its errors, and
# its unevenness from ring to ring, which is that of diffraction rings.
HALO_POWERS, HALO_SIGMAS, HALO_UNEVEN = np.arange(2.0, 8.1, 0.25), 3.0, 0.3
LOG_STEP = 0.1  # of a radius, over which the slope at the rim is taken


@dataclass(frozen=True, eq=False)
class RadialProfile:
    """Radial profile of a star, averaged over all directions.

    log_radius, log_light (n,): of its rings, n > 2. Light is interpolated between them and
    continued by a power of the distance beyond both ends.
    rise: by how much the brightest of the next END_RINGS rings exceeds the last of them, or 0
    """

    log_radius: np.ndarray
    log_light: np.ndarray
    rise: float = 0.0

    @classmethod
    def measure(cls, data, usable, away, sigma):
        """Measures rings one pixel wide in pixels (My, Mx) at distances `away` [px].

        Rings end where their light rises or is below RING_SIGMAS. None if fewer than three remain.
        """
        rings, found = np.rint(away[usable]).astype(int), []
        value, radius, rise = data[usable], away[usable], 0.0
        for r in range(rings.min(initial=0), rings.max(initial=-1) + 1):
            own = rings == r
            if own.sum() < MIN_RING:
                continue
            light = np.median(value[own])
            if found and light > found[-1][1]:
                beyond = (value[rings == k] for k in range(r, r + END_RINGS))
                rise = max(np.median(v) for v in beyond if v.size >= MIN_RING) - found[-1][1]
                break
            if light < RING_SIGMAS * sigma:
                break
            found.append((np.median(radius[own]), light))
        return cls(*np.log(found).T, rise) if len(found) > 2 else None

    def at(self, radius):
        """Light at distances [px], of any shape; distances below one pixel count as one."""
        from scipy.interpolate import PchipInterpolator  # 0.1 s, for saturated stars alone

        x = np.log(np.maximum(radius, 1.0))
        u, v = self.log_radius, self.log_light

        found = PchipInterpolator(u, v)(np.clip(x, u[0], u[-1]))
        k = min(END_RINGS, len(u) - 1)
        for end, far, outside in ((0, k, x < u[0]), (-1, -1 - k, x > u[-1])):
            slope = (v[end] - v[far]) / (u[end] - u[far])
            found = found + np.where(outside, slope * (x - u[end]), 0.0)
        return np.exp(found)

    @property
    def end(self) -> float:
        """Radius [px] of the outermost ring."""
        return float(np.exp(self.log_radius[-1]))

    @classmethod
    def measure_halo(cls, data, usable, away, sigma, radius):
        """Fits a power of the distance to rings of all pixels (My, Mx), that is light at `radius`.

        Diffraction rings average out. None if the halo is below HALO_SIGMAS of its error.
        """
        rings, r, light, error = np.rint(away[usable]).astype(int), [], [], []
        value = data[usable]
        for k in range(rings.min(initial=0), rings.max(initial=-1) + 1):
            own = value[rings == k]
            if own.size >= MIN_RING:
                r.append(k)
                light.append(np.median(own))
                error.append(sigma / np.sqrt(own.size))
        if not r:
            return None
        light, relative = np.array(light), np.array(r) / radius
        weight = 1 / (np.square(error) + np.square(HALO_UNEVEN * light))
        shape = relative ** -HALO_POWERS[:, None]
        power = (weight * shape**2).sum(axis=1)
        found = (weight * shape * light).sum(axis=1) / power
        best = int(np.argmax(found * np.abs(found) * power))
        if found[best] < HALO_SIGMAS / np.sqrt(power[best]):
            return None
        ends = np.log([radius, 2 * radius])
        return cls(ends, np.log(found[best]) - HALO_POWERS[best] * (ends - ends[0]))

    def power(self, radius) -> float:
        """Exponent of the power of the distance by which the light falls at a radius [px]."""
        ends = self.at(np.array([1.0, np.exp(LOG_STEP)]) * radius)
        return float(np.log(ends[0] / ends[1]) / LOG_STEP)

    def with_core(self, radius, core):
        """Light at distances [px], with a Gaussian inside a core [px].

        The Gaussian has the profile's light and slope at the core's rim. It is smooth and fainter
        than a continued power. Unobserved samples are rendered with rounding errors proportional
        to the brightest sample.
        """
        inside = self.at(core) * np.exp(0.5 * self.power(core) * (1 - (radius / core) ** 2))
        return np.where(radius < core, inside, self.at(radius))
