"""JSON Schema of scene and field files: `clresample schema`."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Print the JSON Schema of scene or field files. Editors that know TOML complete and
check the keys of a file whose first line names its schema, such as
  #:schema ./scene.schema.json"""


def add_schema(commands):
    """Adds `clresample schema`."""
    parser = commands.add_parser(
        "schema",
        help="JSON Schema of scene and field files, for editors",
        description=DESCRIPTION,
        epilog="example  clresample schema scene > scene.schema.json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("kind", choices=("scene", "field"), help="of file")
    parser.set_defaults(run=run)


def run(arguments):
    """Prints the schema."""
    import json

    from ..fields.field_toml.schema import json_schema

    print(json.dumps(json_schema(arguments.kind), indent=2))
