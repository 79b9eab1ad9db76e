"""Columns of a table while it is made: plain arrays, which become one astropy table at the end."""

from __future__ import annotations

import numpy as np
from astropy.table import QTable

EMPTY = {"i": 0, "u": 0, "b": False, "U": ""}  # of kinds of columns: what rows without a value hold


class Columns:
    """Arrays (n,) by name, in the order in which they came, some with units.

    An astropy table takes 0.2 ms for each column that it gets, loses or joins: a catalogue of one
    blend has 60 of them, a field has thousands of blends.

    values {name: array}, units {name: unit}; meta: metadata of the whole table
    """

    def __init__(self, values=None, units=None, meta=None):
        self.values, self.units, self.meta = values or {}, units or {}, meta or {}

    def __len__(self):
        return len(next(iter(self.values.values()), ()))

    def __contains__(self, name):
        return name in self.values

    def __getitem__(self, name) -> np.ndarray:
        return self.values[name]

    def put(self, name, values, unit=None):
        """Sets a column; a new one becomes the last."""
        self.values[name] = np.asarray(values)
        if unit is not None:
            self.units[name] = unit

    def select_rows(self, which) -> Columns:
        """The rows of an index: a slice, numbers or bool."""
        rows = {name: values[which] for name, values in self.values.items()}
        return Columns(rows, dict(self.units), dict(self.meta))

    @classmethod
    def concatenate(cls, several) -> Columns:
        """Concatenates the rows of several, with names in the order of first appearance.

        Rows without a column get NaN, 0 for whole numbers, "" for texts.
        """
        found = cls()
        for one in several:
            found.units = one.units | found.units
            found.meta = one.meta | found.meta
            for name, values in one.values.items():
                found.values.setdefault(name, values)
        for name, like in found.values.items():
            empty = EMPTY.get(like.dtype.kind, np.nan)
            found.values[name] = np.concatenate(
                [
                    one[name] if name in one else np.full(len(one), empty, like.dtype)
                    for one in several
                ]
            )
        return found

    def table(self) -> QTable:
        """The same as an astropy table."""
        return QTable(
            [
                values if name not in self.units else values * self.units[name]
                for name, values in self.values.items()
            ],
            names=list(self.values),
            meta=self.meta,
        )
