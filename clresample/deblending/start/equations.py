"""Normal equations of all parameters of a group of scenes, from sums of the device."""

from __future__ import annotations

import numpy as np

from ..spectra import RIDGE

# Largest number of parameters of a component; others are padded.
N_PARAMETERS = 4


def normal_equations(looking):
    """Normal matrices (k, P, P) and right sides (k, P) of Gauss-Newton steps; P = 4 n.

    Spectra and sky levels are eliminated. Call it after `render` with slopes and
    `compute_residuals`.
    """
    k, n, rows = len(looking.scenes), looking.n_most, looking.rows
    own, p = looking.index[looking.at], N_PARAMETERS
    normal, right = np.zeros((k, n, p, n, p)), np.zeros((k, n, p))
    inner = np.zeros((k, looking.n_channels, n + 1, n + 1))
    cross = np.zeros((k, looking.n_channels, n + 1, n, p))
    rest = np.zeros((k, looking.n_channels, n + 1))
    known = np.arange(p) < (looking.slots.n_images - 1)[:, None]  # (slots, p)
    if looking.fit_sky:
        rest[..., n], inner[..., n, n] = looking.of_level()
    for sight, (table, on_device) in zip(looking.sights, looking.overlapping_pairs, strict=True):
        c, channels = np.arange(looking.n_channels)[sight.channels][None], sight.channels
        gram, pull = sight.gram(on_device, 1 + p), sight.residual_products(1 + p)
        pairs = table[:, :2]
        a = looking.spectra[looking.at][:, channels]
        (i, j), b = own[pairs].T, rows[pairs[:, 0]]
        one, other = pairs.T
        mask = known[one][:, :, None] & known[other][:, None]
        both = np.einsum("xc,xc,xckl->xkl", a[one], a[other], gram[..., 1:, 1:]) * mask
        apart = one != other
        normal[b, i, :, j] += both
        normal[b[apart], j[apart], :, i[apart]] += both[apart].swapaxes(1, 2)
        at = b[:, None], c
        inner[*at, i[:, None], j[:, None]] = inner[*at, j[:, None], i[:, None]] = gram[..., 0, 0]
        of_other = a[other][..., None] * gram[..., 0, 1:] * known[other][:, None]
        of_one = a[one][..., None] * gram[..., 1:, 0] * known[one][:, None]
        cross[*at, i[:, None], j[:, None]] = of_other
        cross[*at, j[:, None], i[:, None]] = of_one
        slope = a[..., None, None] * pull[:, :, 1:] * known[:, None, :, None]
        right[rows, own] += slope[..., 0].sum(axis=1)
        at = rows[:, None], c
        rest[*at, own[:, None]] = pull[:, :, 0, 0]
        if looking.fit_sky:
            inner[*at, own[:, None], n] = inner[*at, n, own[:, None]] = pull[:, :, 0, 1]
            cross[*at, n, own[:, None]] = slope[..., 1]
    lit = looking.solution() > 0
    lit[..., n] = inner[..., n, n] > 0  # 0 in a channel without weights, or if it is not fitted
    parts = normal, right, inner, cross, rest, lit
    if looking.fit_sky or looking.ties is not None:
        parts = _of_bands(looking.ties, *parts)
    return _eliminated(*parts)


def _of_bands(ties, normal, right, inner, cross, rest, lit):
    """Arguments of `_eliminated`, with the sky levels eliminated and tied channels summed.

    `inner`, `cross`, `rest` and `lit` then have n spectra and, with Ties, B bands in place of C
    channels. A level has thousands of times the curvature of a spectrum: a ridge relative to that
    would hold the spectra.
    """
    n = rest.shape[-1] - 1
    level = np.divide(1, inner[..., n, n], where=lit[..., n], out=np.zeros(lit.shape[:-1]))
    side, by_level = inner[..., :n, n] * level[..., None], cross[..., n, :, :]
    normal = normal - np.einsum("kcip,kcjq,kc->kipjq", by_level, by_level, level)
    right = right - np.einsum("kcip,kc->kip", by_level, level * rest[..., n])
    gram = inner[..., :n, :n] - side[..., None] * inner[..., n, None, :n]
    cross = cross[..., :n, :, :] - side[..., None, None] * by_level[..., None, :, :]
    rest = rest[..., :n] - side * rest[..., n, None]
    if ties is None:
        return normal, right, gram, cross, rest, lit[..., :n]
    of_bands = (ties.total(a, axis=1) for a in (gram, cross, rest, lit[..., :n]))
    gram, cross, rest, lit = of_bands
    return normal, right, gram, cross, rest, lit > 0


def _eliminated(normal, right, inner, cross, rest, lit):
    """Normal matrices (k, P, P) and right sides (k, P) of parameters without the spectra.

    normal (k, n, p, n, p), right (k, n, p): of the parameters; inner (k, C, m, m), rest (k, C, m):
    of the spectra, of which those `lit` (k, C, m) are free; cross (k, C, m, n, p): of both
    """
    k, n_channels, m, n, p = cross.shape
    normal, right = normal.reshape(k, n * p, n * p), right.reshape(k, n * p)
    cross, rest = cross.reshape(k, n_channels, m, n * p) * lit[..., None], rest * lit
    inner = inner * lit[..., None] * lit[..., None, :]
    ridge = RIDGE * np.trace(inner, axis1=2, axis2=3)[..., None] + ~lit
    inner += ridge[..., None] * np.eye(m)
    solved = np.linalg.solve(inner, cross)
    for c in range(n_channels):
        normal = normal - cross[:, c].swapaxes(1, 2) @ solved[:, c]
    return normal, right - np.einsum("kcmp,kcm->kp", solved, rest)
