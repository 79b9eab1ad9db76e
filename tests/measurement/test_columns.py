"""Columns of tables that are not tables yet."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from clresample.measurement.columns import Columns, definition


def columns(n, first, names, meta):
    found = Columns(meta=meta)
    found.put("id", np.arange(first, first + n, dtype=np.int32))
    for name in names:
        found.put(name, first + 0.5 * np.arange(n), u.uJy)
    found.put("status", np.full(n, "x" * first))
    return found


def test_rows_follow_each_other_and_what_is_missing_is_nan():
    one, other = columns(2, 1, ("a",), {"frame": "icrs"}), columns(3, 4, ("a", "b"), {"k": 1})
    other.put("n", np.arange(3, dtype=np.int16))
    other.put("bits", np.full(3, 6, dtype=np.uint8))
    other.put("note", np.full(3, "why"))
    both = Columns.concatenate([one, other])
    assert len(both) == 5 and list(both.values) == ["id", "a", "status", "b", "n", "bits", "note"]
    assert both.units == {"a": u.uJy, "b": u.uJy} and both.meta == {"frame": "icrs", "k": 1}
    assert both["id"].tolist() == [1, 2, 4, 5, 6] and both["id"].dtype == np.int32
    np.testing.assert_array_equal(both["b"], [np.nan, np.nan, 4.0, 4.5, 5.0])
    assert both["n"].tolist() == [0, 0, 0, 1, 2] and both["n"].dtype == np.int16
    assert both["bits"].tolist() == [0, 0, 6, 6, 6] and both["bits"].dtype == np.uint8
    assert both["status"].tolist() == ["x", "x", "xxxx", "xxxx", "xxxx"]
    assert both["note"].tolist() == ["", "", "why", "why", "why"]
    assert len(one) == 2 and "b" not in one and "a" in one  # as they were
    assert len(Columns.concatenate([])) == 0


def test_rows_are_chosen_and_become_a_table():
    whole = columns(4, 2, ("a",), {"frame": "icrs"})
    some = whole.select_rows(np.array([True, False, False, True]))
    assert some["id"].tolist() == [2, 5] and len(whole) == 4
    table = some.table()
    expected = QTable(
        {"id": np.array([2, 5], np.int32), "a": [2.0, 3.5] * u.uJy, "status": ["xx", "xx"]},
        meta={"frame": "icrs"},
    )
    assert table.colnames == expected.colnames and table.meta == expected.meta
    for name in table.colnames:
        assert (table[name] == expected[name]).all() and table[name].dtype == expected[name].dtype
    assert table["a"].unit == u.uJy


@pytest.mark.parametrize(
    "name, description, unit",
    [
        ("y", "row of the position in the model's pixels, from 0", u.pix),
        ("mag_err_r", "error of the magnitude in r", u.mag),
        (
            "colour_g_r",
            "colour g_r: AB magnitude in its first band minus that in its second",
            u.mag,
        ),
        ("flux_r_err", "total flux in r_err", None),
        ("rms_size_err", "error of rms_size", u.arcsec),
        ("ra_centroid_err", "error of ra_centroid", u.deg),
        ("other", "", None),
    ],
)
def test_columns_are_defined_by_names_beginnings_and_ends(name, description, unit):
    assert definition(name)[:2] == (description, unit)
    found = Columns.without_rows([name])
    assert len(found) == 0 and found.units == ({} if unit is None else {name: unit})
    assert (found.table()[name].info.description or "") == description
