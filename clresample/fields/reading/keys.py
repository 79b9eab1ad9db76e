"""The keys of FIELD.toml, what each takes, and the error for each mistake in one."""

from __future__ import annotations

import tomllib
from pathlib import Path

from ...files.scene_keys import HDU, POSITIVE, TABLES, TEXT, Rule, SceneError
from ..psfs.read import FORMATS


def _number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def _whole(value):
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _one_or_many(fits):
    return lambda value: (
        fits(value) or (isinstance(value, list) and len(value) > 0 and all(map(fits, value)))
    )


def _text(value):
    return isinstance(value, str) and bool(value.strip())


FILES = Rule("the name of a file, or a list with one for each channel", _one_or_many(_text))
NUMBERS = Rule("a number, or a list with one for each channel", _one_or_many(_number))
PLANES = Rule(
    "the name of a file, a number above 0, or a list with one for each channel",
    _one_or_many(lambda value: _text(value) or (_number(value) and value > 0)),
)
PAIR = Rule(
    "a number, or two: [y, x]",
    lambda value: (
        _number(value) or (isinstance(value, list) and len(value) == 2 and all(map(_number, value)))
    ),
)
COUNT = Rule("a whole number, 0 or more", _whole)

MOSAIC = {
    "name": TEXT,
    "image": FILES,
    "hdu": HDU,
    "channels": Rule("a list of names", _one_or_many(_text)),
    "weight": PLANES,
    "weight_hdu": HDU,
    "variance": PLANES,
    "variance_hdu": HDU,
    "rms": PLANES,
    "rms_hdu": HDU,
    "mask": FILES,
    "mask_hdu": HDU,
    "mask_bits": Rule(
        "a list of bits to ignore, by number from 0 or by the name in the mask's header",
        _one_or_many(lambda value: _whole(value) or _text(value)),
    ),
    "zero_point": NUMBERS,
    "background": Rule(
        '"subtract", or "none" where it is subtracted already',
        lambda value: value in ("subtract", "none"),
    ),
    "noise": Rule('"estimate", or "white"', lambda value: value in ("estimate", "white")),
    "psf": FILES,
    "psf_format": Rule(" or ".join(f'"{form}"' for form in FORMATS), lambda v: v in FORMATS),
    "psf_hdu": HDU,
    "psf_spacing": POSITIVE,
    "psf_cell_px": PAIR,
    "psf_origin_px": PAIR,
}
FIELD_TABLES = {
    "mosaic": MOSAIC,
    "field": {
        "number": COUNT,
        "tile_px": COUNT,
        "overlap_px": COUNT,
        "border_px": COUNT,
        "max_sources": COUNT,
        "max_pixels": COUNT,
    },
    "sources": {key: TABLES["sources"][key] for key in ("catalogue", "format", "ra", "dec")},
    "detection": TABLES["detection"],
    "fit": {key: TABLES["fit"][key] for key in ("max_iter", "enough", "fit_sky", "flux_floor")},
}
NEEDED = {"mosaic": ("name", "image", "psf"), "sources": ("catalogue",)}
WEIGHTS = "weight", "variance", "rms"


def parse_field(path) -> dict:
    """The tables of a field file, every key checked; "mosaic" is a list, the others are there.

    Raises SceneError, one line with the file, the table and the key.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            tables = tomllib.load(file)
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: not TOML ({error})") from error
    _known(path, tables, FIELD_TABLES, "table")
    mosaics = tables.get("mosaic")
    if not isinstance(mosaics, list) or not mosaics:
        raise SceneError(f"{path}: mosaic is missing: one [[mosaic]] for each instrument")
    for i, table in enumerate(mosaics):
        where = f"{path}: mosaic {i + 1}"
        _check(where, "mosaic", table)
        given = [key for key in WEIGHTS if key in table]
        if len(given) > 1:
            raise SceneError(f"{where}: {' and '.join(given)} are given, a mosaic takes one")
    for name in FIELD_TABLES:
        if name != "mosaic" and name in tables:
            _check(f"{path}: {name}", name, tables[name])
    return {name: tables.get(name, {}) for name in FIELD_TABLES} | {"mosaic": mosaics}


def _check(where, name, table):
    """Raise SceneError for a key that is unknown, missing, or holds what it does not take."""
    rules = FIELD_TABLES[name]
    if not isinstance(table, dict):
        raise SceneError(f"{where} is {table!r}, must be a table, [{name}]")
    _known(where, table, rules, "key")
    for key in NEEDED.get(name, ()):
        if key not in table:
            raise SceneError(f"{where}: {key} is missing, it takes {rules[key].text}")
    for key, value in table.items():
        if not rules[key].fits(value):
            raise SceneError(f"{where}: {key} is {value!r}, it takes {rules[key].text}")


def _known(where, given, known, what):
    for key in given:
        if key not in known:
            raise SceneError(f"{where}: {what} {key} is unknown; allowed are {', '.join(known)}")
