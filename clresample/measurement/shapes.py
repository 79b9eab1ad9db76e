"""Centroids and second moments of morphologies, in pixels and on the sky."""

from __future__ import annotations

import numpy as np


def moments(components, light, beyond=None):
    """Centroid and second moments of a source's components, weighted by their light.

        c = sum_x x I(x) / sum_x I(x),   Q = sum_x (x - c)(x - c)^T I(x) / sum_x I(x)

    components (k): with `origin` and `morphology`; light (k,): weight of each in I, in its box, in
        any unit; without any light, components have equal weights
    beyond (k, 6): sums over the light of each beyond its box, see Errors.outside_box_moments;
        None = none
    returns c (2,) [px] and Q (2, 2) [px^2], rows and columns (y, x); NaN where every morphology is
        zero, or the light no number
    """
    if not np.any(light):
        light = np.ones(len(components))
    beyond = np.zeros((len(components), 6)) if beyond is None else beyond
    parts = []
    for component, weight, more in zip(components, light, beyond, strict=True):
        morphology = np.asarray(component.morphology, dtype=np.float64)
        if morphology.any():
            inside = morphology.sum()
            parts.append((weight, *_moments(morphology, component.origin)))
            if more[0] > 0:
                parts.append((weight * more[0] / inside, *_moments_of_sums(more)))
    if not parts:
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    weights, centroids, seconds = (np.array(values) for values in zip(*parts, strict=True))
    weights = weights / weights.sum()
    centroid = weights @ centroids
    away = centroids - centroid
    seconds = seconds + away[:, :, None] * away[:, None, :]
    return centroid, np.tensordot(weights, seconds, 1)


def _moments_of_sums(sums):
    """Centroid and second moments about it, of sums (6,) as in `moments`."""
    y, x, yy, yx, xx = sums[1:] / sums[0]
    return np.array([y, x]), np.array([[yy - y * y, yx - y * x], [yx - y * x, xx - x * x]])


def _moments(image, origin):
    y, x = (np.arange(n) + o for n, o in zip(image.shape, origin, strict=True))
    rows, columns, total = image.sum(axis=1), image.sum(axis=0), image.sum()
    c_y, c_x = rows @ y / total, columns @ x / total
    y, x = y - c_y, x - c_x
    cross = y @ image @ x
    return np.array([c_y, c_x]), np.array([[rows @ y**2, cross], [cross, columns @ x**2]]) / total


def shape(second):
    """Size, ellipticity and angle of second moments Q, rows and columns (north, east).

        size = sqrt((Q_nn + Q_ee) / 2),   e1 = (Q_nn - Q_ee) / (Q_nn + Q_ee),
        e2 = 2 Q_ne / (Q_nn + Q_ee),      angle = atan2(e2, e1) / 2

    so that an ellipse of half-axes a and b has |e| = (a^2 - b^2) / (a^2 + b^2), e1 > 0 when
    stretched north - south and e2 > 0 when stretched north-east - south-west.

    second (2, 2) [arcsec^2]
    returns size [arcsec], e1, e2, angle of the long axis, east of north [deg], in [0, 180); a
        single pixel has size 0 and no ellipticity (NaN)
    """
    (nn, ne), (_, ee) = second
    total = nn + ee
    if not total > 0:
        return np.sqrt(max(total, 0)), np.nan, np.nan, np.nan
    e1, e2 = (nn - ee) / total, 2 * ne / total
    return np.sqrt(total / 2), e1, e2, np.degrees(np.arctan2(e2, e1)) / 2 % 180


def shape_slopes(second, axes):
    """Derivatives of `shape` of axes Q axes^T with respect to Q: (4, 3), by (Q_yy, Q_yx, Q_xx).

    second (2, 2) [px^2]: Q; axes (2, 2) [arcsec/px]: see `local_axes`; NaN where the size is 0, and
    in the angle's row where there is no ellipticity
    """
    (nn, ne), (_, ee) = axes @ second @ axes.T
    total = nn + ee
    if not total > 0:
        return np.full((4, 3), np.nan)
    (a, b), (c, d) = axes
    turned = np.array([[a * a, 2 * a * b, b * b], [a * c, a * d + b * c, b * d],
                       [c * c, 2 * c * d, d * d]])  # fmt: skip
    size = np.array([1, 0, 1]) / (4 * np.sqrt(total / 2))
    e1 = 2 * np.array([ee, 0, -nn]) / total**2
    e2 = 2 * np.array([-ne, total, -ne]) / total**2
    e = (nn - ee) / total, 2 * ne / total
    power = e[0] ** 2 + e[1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        angle = np.degrees((e[0] * e2 - e[1] * e1) / (2 * power))
    return np.array([size, e1, e2, angle]) @ turned
