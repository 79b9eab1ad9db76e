"""The JSON Schema of scene and field files says what the readers of these files test."""

import json
import re

import pytest

from clresample.cli import main
from clresample.fields.field_toml.keys import FIELD_TABLES, SCENE_TABLES, SURVEY, parse_scene
from clresample.fields.field_toml.schema import json_schema
from clresample.files.scene_keys import SceneError

TYPES = {"string": str, "number": (int, float), "integer": int, "boolean": bool, "array": list}
VALUES = [True, 0, 1, 2, 3, -1, 0.5, 1.5, 1e4, "a.fits", "", " ", "core", "auto", "union", "none"]
VALUES += ["estimate", "white", "subtract", "image", "cube", [], {}]
VALUES += [[v] for v in ("a", 0, 1.5, -2, True, [])] + [[1, 2], [0.5, "b"], [1, 2, 3], ["a", ""]]


def fits(schema, value):
    """True if a value fits a schema, for the keywords that ours have."""
    if "anyOf" in schema:
        return any(fits(one, value) for one in schema["anyOf"])
    if "enum" in schema:
        return value in schema["enum"]
    of_type = isinstance(value, TYPES[schema["type"]])
    if not of_type or isinstance(value, bool) != (schema["type"] == "boolean"):
        return False
    if schema["type"] == "array":
        length = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 99)
        return length and all(fits(schema["items"], item) for item in value)
    if schema["type"] == "string":
        return bool(re.search(schema["pattern"], value))
    low, above, below = (schema.get(k) for k in ("minimum", "exclusiveMinimum", "exclusiveMaximum"))
    return (
        (low is None or value >= low)
        and (above is None or value > above)
        and (below is None or value < below)
    )


RULES = {
    f"{table}.{key}": rule
    for tables in (SCENE_TABLES, FIELD_TABLES, {"survey": SURVEY})
    for table, rules in tables.items()
    for key, rule in rules.items()
}


@pytest.mark.parametrize("name", RULES)
def test_a_schema_takes_what_its_rule_takes(name):
    rule = RULES[name]
    taken = [fits(rule.schema, value) for value in VALUES]
    expected = [False if value == {} else bool(rule.fits(value)) for value in VALUES]
    wrong = [v for v, t, e in zip(VALUES, taken, expected, strict=True) if t != e and v is not True]
    assert not wrong


@pytest.mark.parametrize("kind, image", [("scene", "observation"), ("field", "mosaic")])
def test_the_command_prints_it(capsys, kind, image):
    assert not main(["schema", kind])
    schema = json.loads(capsys.readouterr().out)
    assert schema == json.loads(json.dumps(json_schema(kind)))
    assert schema["required"] == [image] and not schema["additionalProperties"]
    plain, survey = schema["properties"][image]["items"]["anyOf"]
    assert plain["required"] == ["name", "image", "psf"] and "format" in survey["required"]


def test_an_error_says_what_the_schema_describes(tmp_path):
    (tmp_path / "scene.toml").write_text('[[observation]]\nname = "HST"\nimage = 3\npsf = "p"\n')
    image = json_schema("scene")["properties"]["observation"]["items"]["anyOf"][0]["properties"]
    with pytest.raises(SceneError, match=f"image is 3, must be {image['image']['description']}"):
        parse_scene(tmp_path / "scene.toml")


def test_another_kind_is_refused():
    with pytest.raises(ValueError, match="kind is 'sky', must be 'scene' or 'field'"):
        json_schema("sky")
