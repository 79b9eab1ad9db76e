"""The keys of a scene file, what each takes, and the error for each mistake in one."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

# Integers above this are no floats, nor is infinity.
LARGEST = sys.float_info.max


class SceneError(ValueError):
    """A scene file that cannot be used: one line with the file, the table and the key."""


@dataclass(frozen=True)
class Rule:
    """What a key takes: `text` describes it to the user, `fits(value)` says whether it is one."""

    text: str
    fits: object


def _number(value):
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= LARGEST  # of integers, which may be too large for a float, and not NaN


def _many(fits):
    return lambda value: isinstance(value, list) and len(value) > 0 and all(map(fits, value))


def _text(value):
    return isinstance(value, str) and bool(value.strip())


def _whole(value):
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _either(*kinds):
    return lambda value: any(fits(value) for fits in kinds)


def _above(value):
    return _number(value) and value > 0


TEXT = Rule("a text", _text)
FILE = Rule("the name of a file", _text)
HDU = Rule('a number from 0, "NAME" or "NAME,VERSION"', _either(_whole, _text))
BANDS = Rule(
    "numbers from 0 or names of the file's bands, one or a list",
    _either(_whole, _text, _many(_either(_whole, _text))),
)
NUMBERS = Rule("a number, or a list with one for each channel", _either(_number, _many(_number)))
PLANES = Rule(
    "the name of a file, a number, or a list with one for each channel",
    _either(_text, _above, _many(_above)),
)
SWITCH = Rule("true or false", lambda value: isinstance(value, bool))
POSITIVE = Rule("a number above 0", _above)

TABLES = {
    "observation": {
        "name": TEXT,
        "image": FILE,
        "hdu": HDU,
        "bands": BANDS,
        "channels": Rule("a list of names", _many(_text)),
        "psf": FILE,
        "psf_hdu": HDU,
        "psf_bands": BANDS,
        "psf_center": Rule(
            '"middle", "core" or [y, x]',
            lambda value: (
                value in ("middle", "core") or (_many(_number)(value) and len(value) == 2)
            ),
        ),
        "psf_spacing": POSITIVE,
        "weight": PLANES,
        "weight_hdu": HDU,
        "variance": PLANES,
        "variance_hdu": HDU,
        "mask": FILE,
        "mask_hdu": HDU,
        "zero_point": NUMBERS,
        "noise": Rule(
            '"estimate", or the name of a file with the autocorrelation of the noise', _text
        ),
    },
    "sources": {
        "catalogue": FILE,
        "format": TEXT,
        **dict.fromkeys(("ra", "dec", "y", "x", "observation", "name", "type", "components"), TEXT),
    },
    "detection": {
        "threshold": POSITIVE,
        "passes": Rule("1, or 2 to look at the residuals too", lambda value: value in (1, 2)),
    },
    "frame": {
        "like": TEXT,
        "footprint": Rule(
            '"union" or "intersection"', lambda value: value in ("union", "intersection")
        ),
        "psf_sigma_px": POSITIVE,
    },
    "fit": {
        "max_iter": Rule("a whole number, 0 or more", _whole),
        "tol": Rule("a number from 0 to 1", lambda value: _number(value) and 0 <= value < 1),
        "enough": POSITIVE,
        "monotone": SWITCH,
        "structure_px": POSITIVE,
        "fit_shifts": SWITCH,
        "fit_sky": SWITCH,
        "flux_floor": Rule("a number from 0 to 1", lambda value: _number(value) and 0 <= value < 1),
        "psf_error": Rule("a number from 0 to 1", lambda value: _number(value) and 0 <= value < 1),
    },
}
NEEDED = {"observation": ("name", "image", "psf"), "sources": ("catalogue",)}


def parse(path):
    """The tables of a scene file, each key checked; [frame] and [fit] are always among them.

    returns {table: {key: value}}, and for "observation" a list of such dicts
    Raises SceneError.
    """
    if Path(path).exists() and not Path(path).is_file():  # reading it might never end
        raise SceneError(f"{path}: is no regular file")
    try:
        with open(path, "rb") as file:
            tables = tomllib.load(file)
    except RecursionError:
        raise SceneError(f"{path}: not a scene file (lists or tables nested too deeply)") from None
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # of TOML, of UTF-8, and of whole numbers of 5000 digits
        raise SceneError(f"{path}: not TOML ({error})") from error
    _allowed(path, tables, TABLES, "table")
    observations = tables.get("observation")
    if not _many(lambda value: isinstance(value, dict))(observations):
        raise SceneError(f"{path}: observation is missing: one [[observation]] per instrument")
    for i, table in enumerate(observations):
        _check_table(f"{path}: observation {i + 1}", "observation", table)
    for name, table in tables.items():
        if name != "observation":
            _check_table(f"{path}: {name}", name, table)
    with_zero_point = ["zero_point" in table for table in observations]
    if len(set(with_zero_point)) > 1:
        one, other = (observations[with_zero_point.index(has)]["name"] for has in (True, False))
        raise SceneError(
            f"{path}: observation {one!r} has zero_point, {other!r} has none: give all or none"
        )
    if "sources" in tables and "detection" in tables:
        raise SceneError(f"{path}: sources and detection are both given: a scene takes one")
    return {"frame": {}, "fit": {}} | tables


def _check_table(where, name, table):
    """Raise SceneError unless a table holds what TABLES says of those of its name."""
    rules = TABLES[name]
    if not isinstance(table, dict):
        raise SceneError(f"{where} is {table!r}, must be a table, [{name}]")
    _allowed(where, table, rules, "key")
    for key in NEEDED.get(name, ()):
        if key not in table:
            raise SceneError(f"{where}: {key} is missing, it takes {rules[key].text}")
    for key, value in table.items():
        if not rules[key].fits(value):
            raise SceneError(f"{where}: {key} is {value!r}, it takes {rules[key].text}")


def _allowed(where, given, known, what):
    for key in given:
        if key not in known:
            raise SceneError(f"{where}: {what} {key} is unknown; allowed are {', '.join(known)}")
