"""Rules for the keys of TOML files, and the error for each mistake in one."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

# Integers above this exceed float64; infinity does too.
LARGEST = sys.float_info.max


class SceneError(ValueError):
    """A scene or field file that cannot be used: one line with the file, the table and the key."""


@dataclass(frozen=True)
class KeyRule:
    """Rule of a key.

    text: valid values, for messages and editors; fits(value): tests one; schema: the same test as
        JSON Schema
    """

    text: str
    fits: object
    schema: dict


def is_number(value):
    """Returns True if a value is a finite number, and a float can hold it."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= LARGEST  # of integers, which may be too large for a float, and not NaN


def is_list_of(fits):
    """Returns True if a value is a list, not empty, of valid items."""
    return lambda value: isinstance(value, list) and len(value) > 0 and all(map(fits, value))


def is_text(value):
    """Returns True if a value is a text with more than blanks in it."""
    return isinstance(value, str) and bool(value.strip())


def is_whole(value):
    """Returns True if a value is a whole number, 0 or more."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def is_any_of(*kinds):
    """Returns True if a value fits one of several."""
    return lambda value: any(fits(value) for fits in kinds)


def one_or_many(*kinds):
    """Returns True if a value, or each of a list, fits one of several."""
    return is_any_of(*kinds, is_list_of(is_any_of(*kinds)))


def _above(value):
    return is_number(value) and value > 0


# The tests above as JSON Schema.
SOME_TEXT = {"type": "string", "pattern": r"\S"}
NUMBER, WHOLE = {"type": "number"}, {"type": "integer", "minimum": 0}
ABOVE_ZERO = NUMBER | {"exclusiveMinimum": 0}


def any_schema(*schemas):
    """JSON Schema of values that fit one of several."""
    return {"anyOf": list(schemas)}


def list_schema(*schemas, **limits):
    """JSON Schema of lists, not empty, of items that fit one of several."""
    items = schemas[0] if len(schemas) == 1 else any_schema(*schemas)
    return {"type": "array", "items": items, "minItems": 1, **limits}


def one_or_many_schema(*schemas):
    """JSON Schema of what `one_or_many` tests."""
    return any_schema(*schemas, list_schema(*schemas))


TEXT = KeyRule("a text", is_text, SOME_TEXT)
FRACTION = KeyRule(
    "a number x with 0 <= x < 1",
    lambda value: is_number(value) and 0 <= value < 1,
    NUMBER | {"minimum": 0, "exclusiveMaximum": 1},
)
COUNT = KeyRule("a whole number, 0 or more", is_whole, WHOLE)
FILE = KeyRule("the name of a file", is_text, SOME_TEXT)
HDU = KeyRule(
    'a number from 0, "NAME" or "NAME,VERSION"',
    is_any_of(is_whole, is_text),
    any_schema(WHOLE, SOME_TEXT),
)
NUMBERS = KeyRule(
    "a number, or a list with one for each channel",
    one_or_many(is_number),
    one_or_many_schema(NUMBER),
)
SWITCH = KeyRule("true or false", lambda value: isinstance(value, bool), {"type": "boolean"})


def word_rule(text, words):
    """KeyRule of one of some words; text: these, for messages."""
    return KeyRule(text, lambda value: value in words, {"enum": list(words)})


def _switch_or(*words):
    """The rule of a switch that may be one of some words too."""
    known = ["true", "false", *(f'"{word}"' for word in words)]
    return KeyRule(
        f"{', '.join(known[:-1])} or {known[-1]}",
        lambda value: isinstance(value, bool) or value in words,
        any_schema({"type": "boolean"}, {"enum": list(words)}),
    )


POSITIVE = KeyRule("a number above 0", _above, ABOVE_ZERO)

# Tables that scene files and field files share; that of an image: fields/field_toml/keys.py.
TABLES = {
    "sources": {
        "catalogue": FILE,
        "format": TEXT,
        **dict.fromkeys(("ra", "dec", "y", "x", "observation", "name", "type", "components"), TEXT),
    },
    "detection": {
        "threshold": POSITIVE,
        "passes": KeyRule(
            "1, or 2 to look at the residuals too", lambda value: value in (1, 2), {"enum": [1, 2]}
        ),
    },
    "frame": {
        "reference": TEXT,
        "footprint": word_rule('"union" or "intersection"', ("union", "intersection")),
        "psf_sigma_px": POSITIVE,
    },
    "fit": {
        "max_iter": COUNT,
        "rel_tol": FRACTION,
        "loss_tol": POSITIVE,
        "monotone": SWITCH,
        "correlation_px": POSITIVE,
        "fit_shifts": _switch_or("auto"),
        "fit_sky": _switch_or("auto", "small"),
        "flux_error_floor": FRACTION,
        "psf_error": FRACTION,
    },
}


def read_tables(path, what) -> dict:
    """The tables of a TOML file, unchecked; `what`: its kind in messages. Raises SceneError."""
    if Path(path).exists() and not Path(path).is_file():  # reading it might never end
        raise SceneError(f"{path}: is not a regular file")
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except RecursionError:
        raise SceneError(f"{path}: not a {what} (lists or tables nested too deeply)") from None
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # of TOML, of UTF-8, and of whole numbers of 5000 digits
        raise SceneError(f"{path}: not TOML ({error})") from error


def check_table(where, name, table, tables, needed):
    """Raises SceneError unless a table follows the rules of its name.

    where: file and table, for messages; tables {name: {key: KeyRule}}; needed {name: keys}
    """
    rules = tables[name]
    if not isinstance(table, dict):
        raise SceneError(f"{where} is {table!r}, must be a table, [{name}]")
    check_names(where, table, rules, "key")
    for key in needed.get(name, ()):
        if key not in table:
            raise SceneError(f"{where}: {key} is missing, must be {rules[key].text}")
    for key, value in table.items():
        if not rules[key].fits(value):
            raise SceneError(f"{where}: {key} is {value!r}, must be {rules[key].text}")


def check_names(where, given, known, what):
    """Raises SceneError for an unknown name; what: "table" or "key"."""
    for key in given:
        if key not in known:
            raise SceneError(f"{where}: {what} {key} is unknown; allowed are {', '.join(known)}")
