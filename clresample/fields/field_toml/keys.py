"""The keys of scene and field files: one set for an image in both, and the tables of each."""

from __future__ import annotations

from dataclasses import dataclass

from ...files.scene_keys import (
    ABOVE_ZERO,
    COUNT,
    FRACTION,
    HDU,
    NUMBER,
    NUMBERS,
    POSITIVE,
    SOME_TEXT,
    TABLES,
    TEXT,
    WHOLE,
    KeyRule,
    SceneError,
    any_schema,
    check_names,
    check_table,
    is_any_of,
    is_list_of,
    is_number,
    is_text,
    is_whole,
    list_schema,
    one_or_many,
    one_or_many_schema,
    read_tables,
    word_rule,
)
from ..area import AREAS
from ..plugins import Formats
from ..psfs.read import FORMATS
from ..readers.formats import READERS

TEXTS = one_or_many_schema(SOME_TEXT)
TWO_NUMBERS = list_schema(NUMBER, minItems=2, maxItems=2)
FILES = KeyRule(
    "the name of a file, or a list with one for each channel", one_or_many(is_text), TEXTS
)
NAMES = KeyRule("a name, or a list of names", one_or_many(is_text), TEXTS)
BANDS = KeyRule(
    "numbers from 0 or names of the file's bands, one or a list",
    one_or_many(is_whole, is_text),
    one_or_many_schema(WHOLE, SOME_TEXT),
)
PLANES = KeyRule(
    "the name of a file, a number above 0, or a list with one for each channel",
    one_or_many(is_text, POSITIVE.fits),
    one_or_many_schema(SOME_TEXT, ABOVE_ZERO),
)


def _is_pair(value):
    return is_list_of(is_number)(value) and len(value) == 2


@dataclass(frozen=True)
class OneOf:
    """A Rule for one of the names of Formats, which other packages may add to."""

    formats: Formats

    @property
    def text(self):
        """The permitted names as messages quote them."""
        return " or ".join(f'"{form}"' for form in self.formats)

    @property
    def schema(self):
        """The names as JSON Schema."""
        return {"enum": list(self.formats)}

    def fits(self, value):
        """Returns True if a value is one of the names."""
        return isinstance(value, str) and value in self.formats


PAIR = KeyRule(
    "a number, or two: [y, x]", is_any_of(is_number, _is_pair), any_schema(NUMBER, TWO_NUMBERS)
)

# An [[observation]] of a scene and a [[mosaic]] of a field.
IMAGE: dict[str, KeyRule | OneOf] = {
    "name": TEXT,
    "image": FILES,
    "hdu": HDU,
    "bands": BANDS,
    "channels": NAMES,
    "band": NAMES,
    "psf": FILES,
    "psf_format": OneOf(FORMATS),
    "psf_hdu": HDU,
    "psf_bands": BANDS,
    "psf_center": KeyRule(
        '"middle", "core" or [y, x]',
        lambda value: value in ("middle", "core") or _is_pair(value),
        any_schema({"enum": ["middle", "core"]}, TWO_NUMBERS),
    ),
    "psf_spacing": POSITIVE,
    "psf_stamp_px": COUNT,
    "psf_detector": KeyRule(
        "a whole number, 0 or more, or a name",
        is_any_of(is_whole, is_text),
        any_schema(WHOLE, SOME_TEXT),
    ),
    "psf_cell_px": PAIR,
    "psf_origin_px": PAIR,
    "psf_cutout_px": KeyRule("two numbers: [y, x]", _is_pair, TWO_NUMBERS),
    "psf_crpix": KeyRule("two numbers: [CRPIX1, CRPIX2]", _is_pair, TWO_NUMBERS),
    "weight": PLANES,
    "weight_hdu": HDU,
    "variance": PLANES,
    "variance_hdu": HDU,
    "rms": PLANES,
    "rms_hdu": HDU,
    "mask": FILES,
    "mask_hdu": HDU,
    "mask_bits": KeyRule(
        "a list of bits to ignore, by number from 0 or by the name in the mask's header",
        one_or_many(is_whole, is_text),
        one_or_many_schema(WHOLE, SOME_TEXT),
    ),
    "saturation": KeyRule(
        "a number above 0, or a list with one for each channel",
        one_or_many(POSITIVE.fits),
        one_or_many_schema(ABOVE_ZERO),
    ),
    "zero_point": NUMBERS,
    "background": word_rule(
        '"subtract", or "none" where it is subtracted already', ("subtract", "none")
    ),
    "noise": KeyRule(
        '"estimate", "white", or the name of a file with the autocorrelation of the noise',
        is_text,
        SOME_TEXT,
    ),
}
SHARED = ("name", "channels", "band", "mask_bits", "zero_point", "background", "saturation")
SURVEY: dict[str, KeyRule | OneOf] = {  # the same of a survey's files
    "format": OneOf(READERS),
    "path": KeyRule(
        "the name of a folder or a file, or a list of files", one_or_many(is_text), TEXTS
    ),
    "bands": KeyRule("a list of the format's bands", one_or_many(is_text), TEXTS),
    **{key: IMAGE[key] for key in (*SHARED, *(key for key in IMAGE if key.startswith("psf")))},
    "noise": word_rule('"estimate", or "white"', ("estimate", "white")),
}
SCENE_TABLES = {"observation": IMAGE} | TABLES
FIELD_TABLES = {
    "mosaic": IMAGE,
    "field": {
        "field_number": COUNT,
        "area": word_rule(" or ".join(f'"{area}"' for area in AREAS), AREAS),
        "tile_px": COUNT,
        "overlap_px": COUNT,
        "margin_px": COUNT,
        "max_sources": COUNT,
        "max_pixels": COUNT,
    },
    "sources": {key: TABLES["sources"][key] for key in ("catalogue", "format", "ra", "dec")},
    "detection": TABLES["detection"],
    "fit": {
        key: TABLES["fit"][key]
        for key in ("max_iter", "loss_tol", "fit_shifts", "fit_sky", "flux_error_floor")
    }
    | {"psf_tolerance": FRACTION},
}
IMAGE_NEEDS = "name", "image", "psf"
REQUIRED: dict[str, tuple[str, ...]] = {"observation": IMAGE_NEEDS, "mosaic": IMAGE_NEEDS}
REQUIRED |= {"sources": ("catalogue",)}
WEIGHTS = "weight", "variance", "rms"


def parse_scene(path) -> dict:
    """The tables of a scene file, each key checked; [frame] and [fit] are always among them.

    returns {table: {key: value}}, and for "observation" a list of such dicts
    Raises SceneError, one line with the file, the table and the key.
    """
    tables = read_tables(path, "scene file")
    check_names(path, tables, SCENE_TABLES, "table")
    observations = _images(path, tables, "observation", SCENE_TABLES)
    for name, table in tables.items():
        if name != "observation":
            check_table(f"{path}: {name}", name, table, SCENE_TABLES, REQUIRED)
    plain = [table for table in observations if "format" not in table]
    with_zero_point = ["zero_point" in table for table in plain]
    if len(set(with_zero_point)) > 1:
        one, other = (plain[with_zero_point.index(has)]["name"] for has in (True, False))
        raise SceneError(
            f"{path}: observation {one!r} has zero_point, {other!r} has none: give all or none"
        )
    if "sources" in tables and "detection" in tables:
        raise SceneError(f"{path}: sources and detection are both given: a scene takes one")
    return {"frame": {}, "fit": {}} | tables


def parse_field(path) -> dict:
    """The tables of a field file, every key checked; "mosaic" is a list, the others are there.

    Raises SceneError, one line with the file, the table and the key.
    """
    tables = read_tables(path, "field file")
    check_names(path, tables, FIELD_TABLES, "table")
    mosaics = _images(path, tables, "mosaic", FIELD_TABLES)
    for name in FIELD_TABLES:
        if name != "mosaic" and name in tables:
            check_table(f"{path}: {name}", name, tables[name], FIELD_TABLES, REQUIRED)
    return {name: tables.get(name, {}) for name in FIELD_TABLES} | {"mosaic": mosaics}


def _images(path, tables, name, known):
    """The tables of a file's images, checked; name: "observation" or "mosaic"."""
    given = tables.get(name)
    if not isinstance(given, list) or not given:
        raise SceneError(f"{path}: {name} is missing: one [[{name}]] for each instrument")
    for i, table in enumerate(given):
        where = f"{path}: {name} {i + 1}"
        if isinstance(table, dict) and "format" in table:
            check_table(where, name, table, {name: SURVEY}, {name: ("path",)})
        else:
            check_table(where, name, table, known, REQUIRED)
        kinds = [key for key in WEIGHTS if key in table]
        if len(kinds) > 1:
            raise SceneError(f"{where}: {' and '.join(kinds)} are both given: an image takes one")
    return given
