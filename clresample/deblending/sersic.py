"""Sersic's profile behind a PSF, as a sum of Gaussians.

    exp(-b (q / w)^m) ~ sum_k a_k exp(-q / 2 v_k) / v_k,     m = 1 / (2 n),   w = 2 ln 2

    n = 1/2 + 1 / (beta + BETA_0),   b = b(n): half of the light lies within q = w

For m < 1 the left side is a mean of Gaussians, whose density over v is a stable distribution's and
nowhere negative (Zolotarev 1986, One-dimensional Stable Distributions, section 2.2). N_GAUSSIANS
variances divide ln v evenly where the light is. Their parts a_k of it are a fit of the profile by
least squares, held near the light in the interval about each. So a_k and v_k are smooth in n, and
the profile is one Gaussian at n = 1/2.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.special import gammaincinv, gammaln

# n is at most 1/2 + 1 / BETA_0, 8.2.
BETA_0 = 0.13
# Gaussians of a profile, which differ from it by 1 % up to n = 2.5, by 3 % at n = 4 and by 6 % at
# n = 6 from 0.1 to 6 half-light radii, the light within any radius by 0.3 %, 0.5 % at n = 8. With
# 10 a profile of n = 4 differs by 7 %.
N_GAUSSIANS = 12
# Parts of the light in Gaussians smaller than the first, and larger than the last.
SMALLER, LARGER = 1e-3, 1e-4
# The profile is fitted between the radii that hold these parts of the light.
INNER, OUTER = 1e-3, 1 - 1e-3
# Weight with which a_k are held near the light of their intervals. Without it some are negative.
HOLD = 0.1
# ln beta at which profiles are fitted; between them a_k and ln v_k are cubic splines.
LN_BETA = np.arange(-5, 9.1, 0.25)
HALF_LIGHT = 2 * np.log(2)  # w


def index_of(ln_beta):
    """n of ln beta."""
    return 0.5 + 1 / (np.exp(ln_beta) + BETA_0)


def gaussians(ln_beta):
    """Parts a (n, K) of the light, ln v (n, K), and the slopes of both by ln beta (n,)."""
    table, slopes = _table()
    step = LN_BETA[1] - LN_BETA[0]
    at = np.clip((np.asarray(ln_beta) - LN_BETA[0]) / step, 0, len(LN_BETA) - 1)
    i = np.minimum(at.astype(int), len(LN_BETA) - 2)
    t, inside = (at - i)[..., None], ((at > 0) & (at < len(LN_BETA) - 1))[..., None]
    low, high, by_low, by_high = table[i], table[i + 1], slopes[i], slopes[i + 1]
    rise = high - low
    second, third = 3 * rise - 2 * by_low - by_high, by_low + by_high - 2 * rise
    value = low + t * (by_low + t * (second + t * third))
    slope = inside * (by_low + t * (2 * second + 3 * t * third)) / step
    return (*np.split(value, 2, axis=-1), *np.split(slope, 2, axis=-1))


@functools.cache
def _table():
    """a_k and ln v_k (n, 2 K) at LN_BETA, and slopes of natural cubic splines there, per step."""
    table, n = np.array([np.concatenate(_fitted(n)) for n in index_of(LN_BETA)]), len(LN_BETA)
    matrix = 4 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1)
    matrix[0, 0] = matrix[-1, -1] = 2
    around = np.pad(table, ((1, 1), (0, 0)), mode="edge")
    return table, np.linalg.solve(matrix, 3 * (around[2:] - around[:-2]))


def _fitted(n):
    """a (K,) and ln v (K,) of index n."""
    y = np.linspace(-25, 16, 300)
    for margin in (2, 0.02):
        within = np.cumsum(_light(y, n))
        low, high = np.interp([SMALLER, 1 - LARGER], within / within[-1], y)
        y = np.linspace(low - margin * (high - low), high + margin * (high - low), 800)
    within = np.cumsum(_light(y, n))
    ln_v = np.linspace(low, high, N_GAUSSIANS)
    held = np.interp((ln_v[1:] + ln_v[:-1]) / 2, y, within / within[-1])
    held = np.diff(held, prepend=0, append=1)
    b = gammaincinv(2 * n, 0.5)
    x = np.geomspace(*gammaincinv(2 * n, [INNER, OUTER]) / b, 400)  # (q / w)^m
    q = HALF_LIGHT * x ** (2 * n)
    ln_light = np.log(np.pi * HALF_LIGHT * 2 * n) - 2 * n * np.log(b) + gammaln(2 * n)
    profile = np.exp(-b * x - ln_light)
    drawn = np.exp(-q[:, None] / (2 * np.exp(ln_v)) - ln_v) / (2 * np.pi)
    weight = np.sqrt(q / profile)  # relative differences, by the light at each radius
    hold = HOLD / np.sqrt(held + LARGER)
    matrix = np.vstack([drawn * weight[:, None], np.diag(hold)])
    part = np.linalg.lstsq(matrix, np.append(profile * weight, hold * held), rcond=None)[0]
    part = np.maximum(part, 0)
    return part / part.sum(), ln_v


def _light(y, n, n_nodes=100):
    """Light (k,) of Gaussians in equal intervals of ln v about y (k,), but for a factor."""
    m, u = 0.5 / n, (np.arange(n_nodes) + 0.5) * np.pi / n_nodes
    # ln of b^(-2n) w / 2 v
    t = np.log(HALF_LIGHT / 2) - 2 * n * np.log(gammaincinv(2 * n, 0.5)) - y[:, None]
    a = m * np.log(np.sin(m * u)) + (1 - m) * np.log(np.sin((1 - m) * u)) - np.log(np.sin(u))
    x = np.exp(np.clip((a - m * t) / (1 - m), -300, 7))
    return np.mean(x * np.exp(-x), axis=1) * np.exp(y)
