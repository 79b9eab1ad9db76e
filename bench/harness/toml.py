"""Lines of TOML files; JSON's texts, numbers, lists and switches are TOML's too."""

from __future__ import annotations

import json


def lines_of(table):
    """One line for each key of a table."""
    return [f"{key} = {json.dumps(value)}" for key, value in table.items()]
