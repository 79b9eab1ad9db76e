"""Data of the page's script: the frame, tiles, sources, and single sources in detail."""

from __future__ import annotations

import numpy as np

from ..measurement.catalogue import FLAG_MEANINGS, Flag
from ..sky.wcs import local_axes
from .charts import channel_fluxes, magnitudes
from .codes import KNEE, NOISY_STEP, SMOOTH_STEP
from .colours import EMPTY as NO_DATA
from .html import EMPTY, format_number
from .stamps import plain, positions, stamps_of
from .table import columns_of

OK, FLAGGED, FAILED = 0, 1, 2  # states of a source, as the script counts them
# [bytes] of a source on the field, of one of its numbers there, of its measurements
SOURCE_BYTES, NUMBER_BYTES, DETAIL_BYTES = 76, 6, 1000
SHAPE = {"size": "rms_size", "e1": "e1", "e2": "e2"}  # the script's names: columns
# of the page: places of sources, their measurements, their pictures
SOURCES_PART, DETAILS_PART, STAMPS_PART = 0.25, 0.1, 0.25


def order_of(run) -> np.ndarray:
    """Rows of the catalogue, the highest signal to noise first, those without one last."""
    if "snr" not in run.sources.colnames:
        return np.arange(len(run.sources))
    snr = plain(run.sources["snr"])
    return np.argsort(np.where(np.isfinite(snr), -snr, np.inf), kind="stable")


def source_states(run) -> np.ndarray:
    """(S,) OK, FLAGGED or FAILED."""
    found = np.zeros(len(run.sources), int)
    if "flags" in run.sources.colnames:
        found[np.nan_to_num(plain(run.sources["flags"])) != 0] = FLAGGED
    if "status" in run.sources.colnames:
        status = np.array([str(s) for s in run.sources["status"]], dtype=object)
        found[np.array([s.startswith("failed") for s in status], bool)] = FAILED
    return found


def flag_names(value) -> str:
    """Names of the flags in a sum, those without a name by their numbers."""
    value = int(value)
    names = [flag.name for flag in FLAG_MEANINGS if value & flag]
    rest = value & ~int(sum(FLAG_MEANINGS))
    return ", ".join([*map(str, names), *([str(rest)] if rest else [])]) or "none"


def data_of(run, most_bytes, notes) -> dict:
    """All that the script reads but the instruments' tiles.

    most_bytes: of the page; notes: a list that gets what is missing
    """
    frame = run.instruments[0].grid if run.instruments else None
    order = order_of(run)
    columns = columns_of(run)
    each = SOURCE_BYTES + NUMBER_BYTES * (len(columns) + len(SHAPE))
    most = int(SOURCES_PART * most_bytes / each)
    if len(order) > most:
        notes.append(
            f"the field shows {most} sources of {len(order)}, those of the highest signal to noise"
        )
        order = order[:most]
    state, at = source_states(run)[order], positions(run)[order]
    known = "snr" in run.sources.colnames
    snr = plain(run.sources["snr"])[order] if known else np.full(len(order), np.nan)
    # failed sources first, then those whose models misfit
    misfit = np.zeros(len(order), bool)
    if "flags" in run.sources.colnames:
        misfit = (np.nan_to_num(plain(run.sources["flags"]))[order].astype(int) & Flag.MISFIT) > 0
    first = np.lexsort((np.arange(len(order)), ~misfit, state != FAILED))
    stamps = {}
    if frame is not None:
        stamps = stamps_of(run, frame, order[first], STAMPS_PART * most_bytes, notes)
    detailed = first[: int(DETAILS_PART * most_bytes / DETAIL_BYTES)]
    return {
        "frame": _frame(run, frame, at),
        "instruments": [],
        "sources": {
            "id": _texts(run, "id", order),
            "parent": _texts(run, "parent_id", order),
            "x": [_short(v, 2) for v in at[:, 1]],
            "y": [_short(v, 2) for v in at[:, 0]],
            "state": state.tolist(),
            "snr": [_short(v, 1) for v in snr],
            "flags": _whole(run, "flags", order),
            "status": _places(run, "status", order),
            **{name: _numbers(run, column, order) for name, column in SHAPE.items()},
            "columns": [[_shown(v, one.form) for v in one.values[order]] for one in columns],
        },
        "statuses": _different(run, "status"),
        "flags": [[str(flag.name), int(flag)] for flag in FLAG_MEANINGS],
        "columns": [one.as_json() for one in columns],
        "codes": {"knee": KNEE, "noisy": NOISY_STEP, "smooth": SMOOTH_STEP},
        "empty": NO_DATA,
        "flux_columns": _flux_columns(run),
        "details": _details(run, order, detailed, stamps),
    }


def _flux_columns(run):
    """Titles of the fluxes' table, with their unit where all have one."""
    units = {unit for *_, unit in channel_fluxes(run)}
    unit = units.pop().replace("uJy", "µJy") if len(units) == 1 else ""
    system = "AB mag" if unit == "µJy" else "Mag"
    flux = f"Flux [{unit}]" if unit else "Flux"
    return ["Channel", flux, "Error", "S/N", system, "Residual [σ]"]


def _texts(run, name, order):
    """A column of whole numbers as texts: scripts' numbers hold 53 bits."""
    if name not in run.sources.colnames:
        return []
    return [str(int(v)) for v in np.asarray(run.sources[name])[order]]


def _whole(run, name, order):
    """A column of small whole numbers, 0 where there is none."""
    if name not in run.sources.colnames:
        return [0] * len(order)
    return np.nan_to_num(plain(run.sources[name]))[order].astype(int).tolist()


def _different(run, name):
    """The different texts of a column."""
    return sorted({str(v) for v in run.sources[name]}) if name in run.sources.colnames else []


def _places(run, name, order):
    """For each source the place of its text in `_different`."""
    places = {text: k for k, text in enumerate(_different(run, name))}
    return [places[str(run.sources[name][row])] for row in order] if places else []


def _numbers(run, name, order):
    if name not in run.sources.colnames:
        return []
    return [_short(v, 3) for v in plain(run.sources[name])[order]]


def _digits(value):
    """A number to seven digits, those of float32; None for NaN."""
    return float(f"{value:.7g}") if np.isfinite(value) else None


def _shown(value, form):
    """A number to the digits that a table shows; None for NaN."""
    return float(format(value, form)) if np.isfinite(value) else None


def _short(value, digits):
    return round(float(value), digits) if np.isfinite(value) else None


def _frame(run, frame, at):
    """The pixels in which all is shown: the first instrument's, or those of the sources."""
    offset = run.offset.tolist()
    if frame is None:
        good = at[np.isfinite(at).all(axis=1)]
        shape = np.ceil(good.max(axis=0)) + 20 if len(good) else [100, 100]
        pixels = [int(n) for n in shape]
        return {"shape": pixels, "scale": None, "offset": offset, "sky": None, "axes": None}
    middle = (np.array(frame.shape) - 1) / 2
    flat = "y_sky" in run.sources.colnames
    ra, dec = frame.sky(*middle)
    names = ("RA", "Dec") if "ra" in run.sources.colnames else ("longitude", "latitude")
    sky = {
        "x": middle[1],
        "y": middle[0],
        "ra": float(ra),
        "dec": float(dec),
        "names": names,
    }
    return {
        "shape": list(frame.shape),
        "scale": float(frame.pixel_scale_arcsec),
        "offset": offset,
        "sky": None if flat else sky,
        "axes": local_axes(frame, middle).tolist(),
    }


def instrument_data(pyramid) -> dict:
    """Data of an instrument for the script."""
    one, stretch = pyramid.instrument, pyramid.stretch
    names = [one.channels[c] for c in stretch.chosen]
    return {
        "name": one.name,
        "channels": one.channels,
        "sigma": [_digits(v) for v in one.noise_sigma],
        "whites": [_digits(v) for v in stretch.whites],
        "colour": {
            "title": f"{', '.join(names)} as blue, green, red",
            "channels": stretch.chosen,
            "balance": [_digits(v) for v in stretch.balance],
            "knee": _digits(stretch.knee),
            "white": _digits(stretch.white),
        },
        "unit": "counts",
        "levels": pyramid.levels,
    }


def _details(run, order, chosen, stamps):
    """{place in `order`: facts, fluxes and pictures} of some sources."""
    found, table = {}, run.sources
    measured = list(channel_fluxes(run))
    for k in chosen.tolist():
        row = int(order[k])
        found[k] = {
            "facts": _facts(table, row),
            "fluxes": [
                [
                    channel,
                    format_number(flux[row]),
                    format_number(error[row], ".2g"),
                    format_number(flux[row] / error[row] if error[row] > 0 else np.nan, ".3g"),
                    format_number(magnitudes(flux[row], unit), ".2f"),
                    format_number(_value(table, f"max_residual_{channel}", row), ".1f"),
                ]
                for channel, flux, error, unit in measured
            ],
        }
        if row in stamps:
            found[k]["stamps"] = stamps[row]
    return found


def _value(table, name, row):
    return float(plain(table[name][row : row + 1])[0]) if name in table.colnames else np.nan


def _facts(table, row):
    """Title and text of each line of a source's panel."""
    texts = [["Fit", f"{table['status'][row]}"]] if "status" in table.colnames else []
    if "reason" in table.colnames and str(table["reason"][row]):
        texts.append(["Reason", str(table["reason"][row])])
    if "flags" in table.colnames:
        texts.append(["Flags", flag_names(np.nan_to_num(_value(table, "flags", row)))])
    for names, title, form in (
        (("ra", "dec"), "RA, Dec [deg]", ".6f"),
        (("y_sky", "x_sky"), "y, x [arcsec]", ".3f"),
        (("y", "x"), "y, x [model px]", ".2f"),
        (("snr",), "S/N, all channels", ".4g"),
        (("rms_size", "rms_size_err"), "Size, error [arcsec]", ".3f"),
        (("e1", "e2"), "e1, e2", ".3f"),
        (("n_components",), "Components", ".0f"),
        (("n_blend_sources",), "Sources in its blend", ".0f"),
        (("detection_pass",), "Found in pass", ".0f"),
    ):
        if set(names) <= set(table.colnames):
            texts.append(
                [title, ", ".join(format_number(_value(table, n, row), form) for n in names)]
            )
    for name in table.colnames:
        if name.startswith("chi2_"):
            text = format_number(_value(table, name, row), ".2f")
            texts.append([f"χ² per pixel, {name.removeprefix('chi2_')}", text])
    return [[what, value or EMPTY] for what, value in texts]
