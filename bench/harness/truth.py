"""Compares catalogues of simulated galaxies with the truth, in units of their own errors.

quantity      columns of the catalogue, each with a column of its error; truth
flux          flux_CHANNEL [uJy]; that of the whole galaxy, also beyond the stamp
colour        colour_A_B [mag]; difference of the magnitudes
position      y_centroid, x_centroid [model px]; centroid of the galaxy's true model image
size          size [arcsec]; from second moments of the same image
ellipticity   e1, e2 [1]; likewise

A column without a column of errors is left out: what a version of the library does not offer is
not judged.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from astropy import units as u

from clresample import catalogue
from clresample.measurement.shapes import moments, shape
from clresample.sky.observation import ZERO_POINT_UJY
from clresample.sky.wcs import local_axes

from .scenes import MODES

QUANTITIES = ("flux", "colour", "position", "size", "ellipticity")
# Quantities whose bias is judged relative to the truth; that of the others is in units of errors.
RELATIVE = ("flux", "size")


def compare(result, scene, mode, *, keep=slice(None)):
    """All values of one fitted scene that have an error.

    keep (S,): which galaxies count
    returns {quantity: (4, n)}, rows: signal to noise, estimate, truth, error. Signal to noise is
        true flux over reported error: of the channel for a flux, of the fainter one of two for a
        colour, of all channels together, squares added, for what belongs to the galaxy.
    """
    table = catalogue(result, magnitudes=True)
    truths = _truths(scene, mode, table.colnames)
    snr = {name: truths[name] / _error(table, name) for name in truths if name.startswith("flux_")}
    whole = np.sqrt(sum(np.where(np.isfinite(s), s, 0) ** 2 for s in snr.values()))
    found = {quantity: [] for quantity in QUANTITIES}
    for name, truth in truths.items():
        error = _error(table, name)
        if error is None:
            continue
        value = np.asarray(table[name], float)
        parts = name.split("_")[1:]
        if _quantity(name) == "colour":
            own = np.minimum(*(snr[f"flux_{channel}"] for channel in parts))
        else:
            own = snr.get(name, whole)
        values = np.stack([own, value, truth, error])
        found[_quantity(name)].append(values[:, keep])
    joined = {name: np.concatenate(parts, axis=1) for name, parts in found.items() if parts}
    return {name: _measured(values) for name, values in joined.items()}


def _measured(values):
    """Columns of (4, n) whose error is a number above 0."""
    good = np.isfinite(values).all(axis=0) & (values[3] > 0)
    return values[:, good]


def _truths(scene, mode, columns):
    """True values {column: (S,)} of the columns that the catalogue has."""
    magnitudes = {}
    for name in MODES[mode]:
        image = getattr(scene, name)
        magnitudes |= dict(zip(image.survey.bands, image.magnitudes.T, strict=True))
    truths = {f"flux_{b}": 10 ** (-0.4 * (m - ZERO_POINT_UJY)) for b, m in magnitudes.items()}
    for a, of_a in magnitudes.items():
        for b, of_b in magnitudes.items():
            truths[f"colour_{a}_{b}"] = of_a - of_b
    axes, found = local_axes(scene.euclid.grid, np.zeros(2)), []
    for image in scene.euclid.truth:
        centroid, second = moments([SimpleNamespace(origin=(0, 0), morphology=image)], np.ones(1))
        with np.errstate(invalid="ignore"):  # negative light can make a second moment negative
            found.append((*centroid, *shape(axes @ second @ axes.T)[:3]))
    names = "y_centroid", "x_centroid", "rms_size", "e1", "e2"
    truths |= dict(zip(names, np.array(found).T, strict=True))
    return {name: truth for name, truth in truths.items() if name in columns}


def _quantity(column):
    if column.endswith("_centroid"):
        return "position"
    if column == "rms_size":
        return "size"
    return "ellipticity" if column in ("e1", "e2") else column.split("_")[0]


def _error(table, name):
    """Errors of a column (S,), by either way of naming them; None where there are none."""
    for column in (f"{name}_err", name.replace("_", "_err_", 1)):
        if column != name and column in table.colnames:
            return u.Quantity(table[column]).to_value(u.Quantity(table[name]).unit)
    return None


def negative_light(scene):
    """Share of each galaxy's light (S,) that is negative on its true model image."""
    truth = scene.euclid.truth
    return np.maximum(-truth, 0).sum(axis=(1, 2)) / np.abs(truth).sum(axis=(1, 2))
