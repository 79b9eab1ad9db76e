"""The keys of FIELD.toml, what each takes, and the error for each mistake in one."""

from __future__ import annotations

from ...files.scene_keys import (
    COUNT,
    FRACTION,
    HDU,
    NUMBERS,
    POSITIVE,
    TABLES,
    TEXT,
    Rule,
    SceneError,
    check_names,
    check_table,
    is_number,
    is_text,
    is_whole,
    many,
    one_or_many,
    read_tables,
)
from ..psfs.read import FORMATS
from ..readers.formats import READERS

FILES = Rule("the name of a file, or a list with one for each channel", one_or_many(is_text))
PLANES = Rule(
    "the name of a file, a number above 0, or a list with one for each channel",
    one_or_many(is_text, POSITIVE.fits),
)
PAIR = Rule(
    "a number, or two: [y, x]",
    lambda value: is_number(value) or (many(is_number)(value) and len(value) == 2),
)

MOSAIC = {
    "name": TEXT,
    "image": FILES,
    "hdu": HDU,
    "channels": Rule("a list of names", one_or_many(is_text)),
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
        one_or_many(is_whole, is_text),
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
    "psf_stamp_px": COUNT,
    "psf_detector": COUNT,
    "psf_cell_px": PAIR,
    "psf_origin_px": PAIR,
}
SHARED = ("name", "channels", "mask_bits", "zero_point", "background", "noise")
SURVEY = {  # a [[mosaic]] of a survey's files
    "format": Rule(" or ".join(f'"{form}"' for form in READERS), lambda v: v in READERS),
    "path": Rule("the name of a folder or a file, or a list of files", one_or_many(is_text)),
    "bands": Rule("a list of the format's bands", one_or_many(is_text)),
    **{key: MOSAIC[key] for key in (*SHARED, *(key for key in MOSAIC if key.startswith("psf")))},
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
    "fit": {key: TABLES["fit"][key] for key in ("max_iter", "enough", "fit_sky", "flux_floor")}
    | {"psf_tolerance": FRACTION},
}
NEEDED = {"mosaic": ("name", "image", "psf"), "sources": ("catalogue",)}
WEIGHTS = "weight", "variance", "rms"


def parse_field(path) -> dict:
    """The tables of a field file, every key checked; "mosaic" is a list, the others are there.

    Raises SceneError, one line with the file, the table and the key.
    """
    tables = read_tables(path, "field file")
    check_names(path, tables, FIELD_TABLES, "table")
    mosaics = tables.get("mosaic")
    if not isinstance(mosaics, list) or not mosaics:
        raise SceneError(f"{path}: mosaic is missing: one [[mosaic]] for each instrument")
    for i, table in enumerate(mosaics):
        where = f"{path}: mosaic {i + 1}"
        if isinstance(table, dict) and "format" in table:
            check_table(where, "mosaic", table, {"mosaic": SURVEY}, {"mosaic": ("path",)})
        else:
            check_table(where, "mosaic", table, FIELD_TABLES, NEEDED)
        given = [key for key in WEIGHTS if key in table]
        if len(given) > 1:
            raise SceneError(f"{where}: {' and '.join(given)} are given, a mosaic takes one")
    for name in FIELD_TABLES:
        if name != "mosaic" and name in tables:
            check_table(f"{path}: {name}", name, tables[name], FIELD_TABLES, NEEDED)
    return {name: tables.get(name, {}) for name in FIELD_TABLES} | {"mosaic": mosaics}
