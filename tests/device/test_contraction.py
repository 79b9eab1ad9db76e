"""The contraction kernel against NumPy: shapes, strides, batches, epilogues, tiles, long sums."""

import numpy as np
import pytest
from helpers.products import (
    by_turns,
    check,
    dtype,
    every_tile,
    every_type,
    need,
    put_right,
    random,
    type_of,
)

from clresample.device import contraction as contract
from clresample.device.contraction import Contraction, ImageBatch, MatrixBatch, row_stride

__all__ = ["dtype"]  # a fixture


@every_tile
@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 16, 5), (8, 17, 1), (23, 40, 130)], ids=str)
def test_product(device, shape, dtype):
    m, n, k = shape
    a, b = random(3, m, k), random(3, k, n)
    right = put_right(device, b, dtype)
    n_pad = right.shape[-1]
    result = device.put(np.full((3, m + 2, n_pad), 7.0), dtype)
    Contraction(device, dtype).bind(
        m, n, k, MatrixBatch(device.put(a, dtype).base_data, k, m * k),
        MatrixBatch(right.base_data, n_pad, k * n_pad),
        MatrixBatch(result.base_data, n_pad, (m + 2) * n_pad),
    )(3)  # fmt: skip
    found = device.get(result)
    check(found[:, :m, :n], a @ b, dtype)
    assert not found[:, :m, n:].any()  # whole vectors, zero beyond n
    assert (found[:, m:] == 7).all()  # and nothing beyond m


@every_type
@pytest.mark.parametrize("n", [120, 128, 256])
def test_rows_do_not_crowd_the_cache(device, n, dtype):
    """Rows a vector further apart than their columns, which stay alone beyond them."""
    need(device, dtype)
    m, k, n_pad = 8, 9, row_stride(n)
    assert n_pad == contract.round_up_columns(n) + contract.COLUMN_PAD
    a, b = random(m, k), random(k, n)
    host = np.full((k, n_pad), np.nan)
    host[:, :n], host[:, n : contract.round_up_columns(n)] = b, 0
    right = device.put(host, dtype)
    result = device.put(np.full((m, n_pad), 7.0), dtype)
    Contraction(device, dtype).bind(
        m, n, k, MatrixBatch(device.put(a, dtype).base_data, k),
        MatrixBatch(right.base_data, n_pad),
        MatrixBatch(result.base_data, n_pad),
    )(1)  # fmt: skip
    found = device.get(result)
    check(found[:, :n], a @ b, dtype)
    assert not found[:, n : contract.round_up_columns(n)].any()
    assert (found[:, contract.round_up_columns(n) :] == 7).all()


@pytest.mark.parametrize("n", [1, 16, 112, 113, 128, 129, 200, 384])
def test_no_row_is_as_long_as_what_crowds_a_cache(n):
    assert contract.round_up_columns(n) in range(n, n + contract.COLUMN_PAD)
    assert row_stride(n) % contract.COLUMN_PAD == 0
    assert row_stride(n) % contract.CROWDED
    assert row_stride(n) - contract.round_up_columns(n) in (0, contract.COLUMN_PAD)
    np.testing.assert_array_equal(row_stride(np.array([n, 7])), [row_stride(n), 16])


@every_type
def test_one_right_factor_for_all_and_tables_shared_by_bands(device, dtype):
    need(device, dtype)
    m, n, k, n_bands = 5, 19, 11, 3
    a, b = random(6, m, k), random(1, k, n)
    left, right = device.put(a, dtype), put_right(device, b, dtype)
    n_pad = right.shape[-1]
    result = device.empty((6, m, n_pad), dtype)
    target = MatrixBatch(result.base_data, n_pad, m * n_pad)
    bind = Contraction(device, dtype).bind
    bind(
        m, n, k, MatrixBatch(left.base_data, k, m * k), MatrixBatch(right.base_data, n_pad), target
    )(6)
    check(device.get(result)[..., :n], a @ b, dtype)
    # scene 0 has tables a[0], b[0] for its three bands, scene 1 has a[1], b[1]
    b = random(2, k, n)
    right = put_right(device, b, dtype)
    bind(m, n, k, MatrixBatch(left.base_data, k, m * k, n_bands),
         MatrixBatch(right.base_data, n_pad, k * n_pad, n_bands), target)(6)  # fmt: skip
    check(device.get(result)[..., :n], np.repeat(a[:2] @ b, n_bands, axis=0), dtype)


@by_turns
def test_a_callers_arrays_read_and_written_transposed(device, dtype):
    m, n, k = 13, 21, 10
    images, b = random(4, k, m), random(1, k, n)
    source, right = device.put(images, dtype), put_right(device, b, dtype)
    result = device.put(np.full((5, n, m), 7.0), dtype)
    # from the second image on, into the second place on: offsets in elements
    Contraction(device, dtype, strided=True, ragged=True).bind(
        m, n, k, MatrixBatch(source.base_data, 1, k * m, step=m, offset=k * m),
        MatrixBatch(right.base_data, right.shape[-1]),
        MatrixBatch(result.base_data, 1, n * m, step=m, offset=n * m),
    )(3)  # fmt: skip
    found = device.get(result)
    check(found[1:4], (images[1:].swapaxes(1, 2) @ b).swapaxes(1, 2), dtype)
    assert (found[[0, 4]] == 7).all()


@every_type
def test_a_callers_rows_of_any_length(device, dtype):
    need(device, dtype)
    m, n, k = 9, 18, 4
    a, b = random(2, m, k), random(1, k, n)
    right = put_right(device, b, dtype)
    result = device.put(np.full((2, m, n + 3), 7.0), dtype)
    Contraction(device, dtype, ragged=True).bind(
        m, n, k, MatrixBatch(device.put(a, dtype).base_data, k, m * k),
        MatrixBatch(right.base_data, right.shape[-1]),
        MatrixBatch(result.base_data, n + 3, m * (n + 3), offset=1),
    )(2)  # fmt: skip
    found = device.get(result)
    check(found[..., 1:-2], a @ b, dtype)
    assert (found[..., [0, -2, -1]] == 7).all()


@every_type
@pytest.mark.parametrize("axes", [(0, 1), (1, 0)], ids=["rows", "columns"])
def test_one_product_for_many_callers(device, axes, dtype):
    """Bound to shapes, each call names its images: every third from the second on, and all."""
    need(device, dtype)
    shape, k = (9, 7), 4
    m, n = (shape[axis] for axis in axes)
    images, b, c = random(8, *shape), random(1, n, k), random(1, k, n)
    source, target = device.put(images, dtype), device.put(np.full((4, *shape), 7.0), dtype)
    half = device.empty((8, m, row_stride(k)), dtype)
    middle = MatrixBatch(half.base_data, row_stride(k), m * row_stride(k))
    b_device, c_device = (
        MatrixBatch(put_right(device, a, dtype).base_data, row_stride(a.shape[2])) for a in (b, c)
    )
    observed = ImageBatch.shaped(*shape).matrix(axes)
    out_of = Contraction(device, dtype, ragged=True).bind(m, n, k, middle, c_device, observed)
    for every, first in ((3, 1), (1, 0)):
        model = ImageBatch.shaped(*shape, every=every).matrix(axes)
        into = Contraction(device, dtype, strided=axes != (0, 1)).bind(
            m, k, n, model, b_device, middle
        )
        view = source[first:].reshape(8 - first, *shape)  # may start inside its buffer
        for batch in (ImageBatch.of(source, first, every), ImageBatch.of(view, 0, every)):
            into(2, a=batch)
            out_of(2, c=ImageBatch.of(target, 1))
            chosen = images[first::every][:2]
            truth = (chosen if axes == (0, 1) else chosen.swapaxes(1, 2)) @ b @ c
            found = device.get(target)
            check(found[1:3], truth if axes == (0, 1) else truth.swapaxes(1, 2), dtype)
            assert (found[[0, 3]] == 7).all()


def mixed(quads, d_plus, d_minus):
    """Cos and sin sums (..., 2Hy, 2Hx) to complex amplitudes, times D, and back."""
    cc, cs, sc, ss = (quads[..., i::2, j::2] for i in (0, 1) for j in (0, 1))
    plus, minus = d_plus * (cc - ss - 1j * (cs + sc)), d_minus * (cc + ss + 1j * (cs - sc))
    result = np.empty_like(quads)
    result[..., 0::2, 0::2] = (plus + minus).real
    result[..., 0::2, 1::2] = (minus - plus).imag
    result[..., 1::2, 0::2] = -(plus + minus).imag
    result[..., 1::2, 1::2] = (minus - plus).real
    return result


@by_turns
@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize("n_tables", [1, 2])
def test_mix_multiplies_by_the_spectra(device, n_tables, adjoint, dtype):
    h_y, h_x, k, n_bands, batch = 5, 11, 7, 3, 6
    a, b = random(1, 2 * h_y, k), random(batch, k, 2 * h_x)
    d = random(2, n_tables, n_bands, h_y, h_x) + 1j * random(2, n_tables, n_bands, h_y, h_x, seed=1)
    right = put_right(device, b, dtype)
    n_pad = right.shape[-1]
    planes = np.zeros((n_tables, n_bands, h_y, 4, n_pad // 2))
    planes[..., :h_x] = np.stack([d[0].real, d[0].imag, d[1].real, d[1].imag], axis=-2)
    tables = device.put(planes, dtype)
    result = device.empty((batch, 2 * h_y, n_pad), dtype)
    band = h_y * 2 * n_pad
    Contraction(device, dtype, epilogue="MIX", adjoint=adjoint).bind(
        2 * h_y, 2 * h_x, k, MatrixBatch(device.put(a, dtype).base_data, k),
        MatrixBatch(right.base_data, n_pad, k * n_pad),
        MatrixBatch(result.base_data, n_pad, 2 * h_y * n_pad),
        (tables.base_data, n_bands * band if n_tables > 1 else 0, band), n_bands,
    )(batch)  # fmt: skip
    d = np.broadcast_to(d, (2, 2, n_bands, h_y, h_x)).reshape(2, batch, h_y, h_x)
    truth = mixed(a @ b, *(d.conj() if adjoint else d))
    check(device.get(result)[..., : 2 * h_x], truth, dtype)
    # conjugate spectra are the transpose
    x, y = random(batch, 2 * h_y, 2 * h_x, seed=2), random(batch, 2 * h_y, 2 * h_x, seed=3)
    np.testing.assert_allclose((mixed(x, *d) * y).sum(), (x * mixed(y, *d.conj())).sum())


@every_type
@pytest.mark.parametrize("adjoint", [False, True])
def test_twist_rotates_cos_and_sin_rows(device, adjoint, dtype):
    need(device, dtype)
    h_y, n, k = 5, 21, 9
    a, b, angle = random(3, 2 * h_y, k), random(3, k, n), random(h_y, n)
    right = put_right(device, b, dtype)
    n_pad = right.shape[-1]
    planes = np.zeros((h_y, 2, n_pad))
    planes[..., :n] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    result = device.empty((3, 2 * h_y, n_pad), dtype)
    Contraction(device, dtype, epilogue="TWIST", adjoint=adjoint).bind(
        2 * h_y, n, k, MatrixBatch(device.put(a, dtype).base_data, k, 2 * h_y * k),
        MatrixBatch(right.base_data, n_pad, k * n_pad),
        MatrixBatch(result.base_data, n_pad, 2 * h_y * n_pad),
        (device.put(planes, dtype).base_data, 0, 0), 1,
    )(3)  # fmt: skip
    rows = a @ b
    turned = (rows[:, 0::2] - 1j * rows[:, 1::2]) * np.exp((-1j if adjoint else 1j) * angle)
    truth = np.stack([turned.real, -turned.imag], axis=2).reshape(rows.shape)
    check(device.get(result)[..., :n], truth, dtype)


def test_long_sums_keep_their_accuracy(device, monkeypatch):
    # positive terms: the running sum, and with it each rounding, grows with k
    k = 40_000
    a, b = (np.abs(random(*shape)).astype(np.float32) for shape in ((8, k), (k, 16)))
    left, right = device.put(a), device.put(b)
    result = device.empty((8, 16), np.float32)

    def error():
        Contraction(device, np.float32).bind(
            8, 16, k, MatrixBatch(left.base_data, k), MatrixBatch(right.base_data, 16),
            MatrixBatch(result.base_data, 16),
        )(1)  # fmt: skip
        truth = a.astype(float) @ b.astype(float)
        return np.linalg.norm(device.get(result) - truth) / np.linalg.norm(truth)

    # two sums of 200 terms each: sqrt(200 + 200) roundings of 3e-8, halved by their random signs
    assert error() < 6e-7
    monkeypatch.setattr(contract, "SUM_BLOCK", k)
    assert error() > 1e-6


@pytest.mark.parametrize("k", [1, 4, 37, 74, 128, 129, 400, 5000, 40_000])
def test_stretches_are_whole_turns_and_share_the_terms(k):
    found = contract.terms_per_block(k)
    assert found % contract.TERMS == 0
    assert found <= max(contract.SUM_BLOCK, np.sqrt(k) + contract.TERMS)
    assert k <= 2 * found or found >= contract.SUM_BLOCK / 2  # no more of them than it takes
    assert k < 8 or k > found  # one at least from each end


def test_a_tall_product_is_cut_where_a_launch_would_have_too_many_groups(device, monkeypatch):
    monkeypatch.setattr(contract, "MAX_GROUPS", 2)
    m, n, k, batch = 11, 17, 9, 13
    a, b = random(batch + 1, m, k), random(1, k, n)
    left, right = device.put(a, np.float32), put_right(device, b, np.float32)
    n_pad = right.shape[-1]
    result = device.put(np.full((batch, m, n_pad), 7.0), np.float32)
    product = Contraction(device, np.float32).bind(
        m, n, k, MatrixBatch(None, k, m * k), MatrixBatch(right.base_data, n_pad),
        MatrixBatch(result.base_data, n_pad, m * n_pad),
    )  # fmt: skip
    sizes = []
    launch = product.launch
    product.launch = lambda size, **given: (sizes.append(size), launch(size, **given))
    product(batch, a=ImageBatch(left.base_data, m * k, m * k, k))
    groups = [size[1] // product.group_rows for size in sizes]
    assert len(groups) > 1 and max(groups) <= 2
    check(device.get(result)[..., :n], a[1:] @ b, np.float32)


@pytest.mark.parametrize("name", ["CPU", "groups"])
def test_the_largest_terms_are_summed_last(device, monkeypatch, name):
    # light about the middle of a row of pixels, and amplitudes that fall off with frequency
    type_of((name, np.float32), device, monkeypatch)
    m, n, k = 64, 64, 96
    waves = np.abs(random(k, n)).astype(np.float32)
    right = device.put(waves)
    result = device.empty((m, n), np.float32)

    def error(terms, inward):
        a = (terms * (1 + 0.1 * random(m, k, seed=1))).astype(np.float32)
        left = device.put(a)
        Contraction(device, np.float32).bind(
            m, n, k, MatrixBatch(left.base_data, k), MatrixBatch(right.base_data, n),
            MatrixBatch(result.base_data, n), inward=inward,
        )(1)  # fmt: skip
        truth = a.astype(float) @ waves.astype(float)
        return np.linalg.norm(device.get(result) - truth) / np.linalg.norm(truth)

    at = np.arange(k)
    pixels, frequencies = np.exp(-(((at - 47.5) / 8) ** 2) / 2), np.exp(-at / 8)
    assert error(pixels, inward=True) < 0.9 * error(pixels, inward=False)
    assert error(frequencies, inward=False) < 0.7 * error(frequencies, inward=True)


def test_a_wrong_product_is_seen():
    truth = random(4, 4)
    with pytest.raises(AssertionError, match="error"):
        check(truth * (1 + 2e-6), truth, np.float32)
    with pytest.raises(AssertionError, match="error"):
        check(np.roll(truth, 1, axis=0), truth, np.float64)
