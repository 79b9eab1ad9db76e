"""JSON Schema of scene and field files, from the rules of their keys: for editors."""

from __future__ import annotations

from .keys import FIELD_TABLES, REQUIRED, SCENE_TABLES, SURVEY

DRAFT = "https://json-schema.org/draft/2020-12/schema"
# Kinds of files: their tables, and the name of their images.
KINDS: dict[str, tuple[dict, str]] = {
    "scene": (SCENE_TABLES, "observation"),
    "field": (FIELD_TABLES, "mosaic"),
}


def json_schema(kind) -> dict:
    """Schema of a file: "scene" or "field".

    It holds the names, types and limits of all keys, each with the text of its error. Rules across
    keys, such as one of weight, variance and rms, are checked when the file is read.
    """
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}, must be {' or '.join(map(repr, KINDS))}")
    tables, image = KINDS[kind]
    properties = {
        name: _table(rules, REQUIRED.get(name, ()))
        for name, rules in tables.items()
        if name != image
    }
    plain, survey = _table(tables[image], REQUIRED[image]), _table(SURVEY, ("format", "path"))
    properties[image] = {"type": "array", "minItems": 1, "items": {"anyOf": [plain, survey]}}
    about = {"$schema": DRAFT, "title": f"{kind} file of clresample"}
    return about | _object(properties, (image,))


def _table(rules, needed):
    return _object(
        {key: {"description": rule.text} | rule.schema for key, rule in rules.items()}, needed
    )


def _object(properties, needed):
    names = {"properties": properties, "required": list(needed)}
    return {"type": "object", **names, "additionalProperties": False}
