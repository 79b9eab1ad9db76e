"""Products of items that have tables and sizes of their own, against NumPy."""

import numpy as np
import pytest
from helpers.products import by_turns, check, dtype, put_right, random

from clresample.device.contraction import Contraction, ItemSizes, MatrixBatch, round_up_columns

__all__ = ["dtype"]  # a fixture


@by_turns
def test_items_with_tables_and_sizes_of_their_own(device, dtype):
    n_bands, which, m, n, k = 2, [2, 0, 1, 2], [5, 13, 1], [40, 7, 16], [9, 30, 21]
    tables, b = random(3, 13, 30), random(8, 30, 40)
    for table, rows, terms in zip(tables, m, k, strict=True):
        table[rows:] = table[:, terms:] = np.nan  # never read
    right = put_right(device, b, dtype)
    n_pad = right.shape[-1]
    result = device.put(np.full((8, 13, n_pad), 7.0), dtype)
    on_device = device.put(np.array(which), np.int32)
    arguments = (
        *(13, 40, 30, MatrixBatch(device.put(tables, dtype).base_data, 30, 13 * 30, own=True)),
        *(
            MatrixBatch(right.base_data, n_pad, 30 * n_pad),
            MatrixBatch(result.base_data, n_pad, 13 * n_pad),
        ),
    )
    bind = Contraction(device, dtype).bind
    bind(*arguments, n_bands=n_bands, own=ItemSizes(on_device, *map(np.array, (m, n, k))))(8)
    found = device.get(result)
    for item, right, t in zip(found, b, np.repeat(which, n_bands), strict=True):
        check(item[: m[t], : n[t]], tables[t, : m[t], : k[t]] @ right[: k[t], : n[t]], dtype)
        assert (item[m[t] :] == 7).all() and (item[:, round_up_columns(n[t]) :] == 7).all()
    with pytest.raises(ValueError, match=r"own sizes .*40.*30.*\(13, 40, 30\)"):
        bind(*arguments, own=ItemSizes(on_device, m=np.array([5, 14, 1])))
