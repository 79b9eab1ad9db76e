"""Products with tables of waves in half the operations, against NumPy; where they are used."""

import numpy as np
import pytest
from helpers.products import OWN, check, put_right, random, type_of

from clresample import PSF, Grid, Resampler
from clresample.device.contraction import Contraction, ItemSizes, MatrixBatch, row_stride
from clresample.device.mirror_contraction import (
    MirrorContraction,
    fourier_contraction,
    is_supported,
)
from clresample.device.tuning import Tuning
from clresample.sky.fourier import is_mirror_symmetric

# Tiles of CPUs, the only devices with this kernel, each in one type.
CASES = [*OWN, ("CPU", np.float64), ("wide CPU", np.float32), ("pairs", np.float32)]
# Pixels and frequencies: few, odd, more than a stretch of pairs of either, and more than a tile.
SIZES = [(1, 1), (2, 1), (7, 5), (40, 33), (135, 70)]
N_BATCH, N_OTHER = 3, 53
every_size = pytest.mark.parametrize(("n", "h"), SIZES, ids=lambda size: str(size))


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1].__name__}")
def dtype(request, device, monkeypatch):
    """A floating type, with a tile for it."""
    dtype = type_of(request.param, device, monkeypatch)
    if request.param in OWN and not is_supported(Tuning.of(device, dtype)):
        pytest.skip("for CPUs")
    return dtype


def table(n, h):
    """Waves (2 h, n) at n pixels about their middle."""
    angle = 2 * np.pi * np.outer(np.arange(h) / (1.3 * n + 7), np.arange(n) - (n - 1) / 2)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(2 * h, n)


def left(device, a, dtype):
    """A left factor (m, k), or one for each item (B, m, k)."""
    return MatrixBatch(device.put(a, dtype).base_data, a.shape[-1], a[0].size if a.ndim > 2 else 0)


def right(device, b, dtype):
    wide = put_right(device, b, dtype)
    return MatrixBatch(wide.base_data, wide.shape[-1], wide[0].size if b.ndim > 2 else 0)


def result(device, m, n, dtype):
    return device.put(np.full((N_BATCH, m + 2, row_stride(n)), 7.0), dtype)


def check_padded(device, found, truth, dtype):
    """The product, zeros beyond its columns, and nothing beyond its rows."""
    found, (m, n) = device.get(found), truth.shape[-2:]
    check(found[:, :m, :n], truth, dtype)
    assert not found[:, :m, n : (n + 15) // 16 * 16].any()
    assert (found[:, m:] == 7).all()


@every_size
def test_to_waves_from_the_left(device, dtype, n, h):
    w, x = table(n, h), random(N_BATCH, n, N_OTHER)
    c = result(device, 2 * h, N_OTHER, dtype)
    into = MatrixBatch(c.base_data, c.shape[-1], c[0].size)
    factors = left(device, w, dtype), right(device, x, dtype), into
    MirrorContraction(device, dtype, "left").bind(2 * h, N_OTHER, n, *factors)(N_BATCH)
    check_padded(device, c, w @ x, dtype)


@every_size
def test_to_waves_from_the_right(device, dtype, n, h):
    w, x = table(n, h), random(N_BATCH, N_OTHER, n)
    c = result(device, N_OTHER, 2 * h, dtype)
    into = MatrixBatch(c.base_data, c.shape[-1], c[0].size)
    MirrorContraction(device, dtype, "right").bind(
        N_OTHER, 2 * h, n, left(device, x, dtype), right(device, w.T, dtype), into
    )(N_BATCH)
    check_padded(device, c, x @ w.T, dtype)


@every_size
def test_back_from_the_left(device, dtype, n, h):
    w, z = table(n, h), random(N_BATCH, 2 * h, N_OTHER)
    c = result(device, n, N_OTHER, dtype)
    into = MatrixBatch(c.base_data, c.shape[-1], c[0].size)
    MirrorContraction(device, dtype, "left", back=True).bind(
        n, N_OTHER, 2 * h, left(device, w.T.copy(), dtype), right(device, z, dtype), into
    )(N_BATCH)
    check_padded(device, c, w.T @ z, dtype)


@every_size
@pytest.mark.parametrize("transposed", [False, True])
def test_back_from_the_right_into_a_callers_images(device, dtype, n, h, transposed):
    w, z = table(n, h), random(N_BATCH, N_OTHER, 2 * h)
    images = np.full((N_BATCH + 1, n, N_OTHER) if transposed else (N_BATCH + 1, N_OTHER, n), 7.0)
    c = device.put(images, dtype)
    ld, step = (1, N_OTHER) if transposed else (n, 1)
    # from the second image on
    into = MatrixBatch(c.base_data, ld, N_OTHER * n, step=step, offset=N_OTHER * n)
    MirrorContraction(device, dtype, "right", back=True, ragged=True).bind(
        N_OTHER, n, 2 * h, left(device, z, dtype), right(device, w, dtype), into
    )(N_BATCH)
    found, truth = device.get(c), z @ w
    check(found[1:], truth.swapaxes(1, 2) if transposed else truth, dtype)
    assert (found[0] == 7).all()


def test_of_a_callers_images_transposed(device, dtype):
    w, x = table(30, 9), random(N_BATCH, 30, N_OTHER)
    c = result(device, N_OTHER, 18, dtype)
    given = MatrixBatch(device.put(x, dtype).base_data, 1, 30 * N_OTHER, step=N_OTHER)
    MirrorContraction(device, dtype, "right", strided=True).bind(
        *(N_OTHER, 18, 30),
        *(given, right(device, w.T, dtype), MatrixBatch(c.base_data, c.shape[-1], c[0].size)),
    )(N_BATCH)
    check_padded(device, c, x.swapaxes(1, 2) @ w.T, dtype)


@pytest.mark.parametrize("epilogue", ["MIX", "TWIST"])
@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize("n", [31, 135])
def test_epilogues_are_those_of_the_contraction(device, dtype, epilogue, adjoint, n):
    h, n_other = 13, 30
    w, x = table(n, h), random(N_BATCH, n, n_other)
    planes = 4 if epilogue == "MIX" else 2
    e = device.put(random(h, planes, row_stride(n_other) * 2 // planes), dtype)
    found = []
    for make in (Contraction, lambda *a, **o: MirrorContraction(*a, "left", **o)):
        c = result(device, 2 * h, n_other, dtype)
        make(device, dtype, epilogue=epilogue, adjoint=adjoint).bind(
            *(2 * h, n_other, n, left(device, w, dtype), right(device, x, dtype)),
            MatrixBatch(c.base_data, c.shape[-1], c[0].size),
            (e.base_data, 0, 0),
        )(N_BATCH)
        found.append(device.get(c))
    check(found[1], found[0], dtype)  # zeros beyond the columns, and nothing beyond the rows


def own_tables(device, n, h):
    """Waves (3, 2 max h, n) of so many frequencies each, zeros beyond; their numbers of rows (3,);
    and on the device which of them each item has, ORDER."""
    w = np.zeros((3, 2 * max(h), n))
    for item, n_own in zip(w, h, strict=True):
        item[: 2 * n_own] = table(n, n_own)
    return w, 2 * np.array(h), device.put(np.array(ORDER), np.int32)


ORDER = [2, 0, 1]  # the table of each item


@pytest.mark.parametrize("h", [(5, 9, 7), (70, 33, 81)])
def test_items_have_waves_of_their_own_on_the_left(device, dtype, h):
    """As frequencies of scenes with other PSFs: fewer than the layout has room for."""
    n, k = 24, 2 * max(h)
    w, own, which = own_tables(device, n, h)
    x, z = random(N_BATCH, n, N_OTHER), random(N_BATCH, k, N_OTHER)
    c, back = result(device, k, N_OTHER, dtype), result(device, n, N_OTHER, dtype)
    tables = left(device, w, dtype)._replace(own=True)
    transposed = left(device, w.swapaxes(1, 2).copy(), dtype)._replace(own=True)
    into, out = (MatrixBatch(a.base_data, a.shape[-1], a[0].size) for a in (c, back))
    MirrorContraction(device, dtype, "left").bind(
        k, N_OTHER, n, tables, right(device, x, dtype), into, own=ItemSizes(which, m=own)
    )(N_BATCH)
    MirrorContraction(device, dtype, "left", back=True).bind(
        n, N_OTHER, k, transposed, right(device, z, dtype), out, own=ItemSizes(which, k=own)
    )(N_BATCH)
    found, found_back = device.get(c), device.get(back)
    for b, t in enumerate(ORDER):
        k = own[t]
        check(found[b, :k, :N_OTHER], w[t, :k] @ x[b], dtype)
        assert (found[b, k:] == 7).all()
        check(found_back[b, :n, :N_OTHER], w[t, :k].T @ z[b, :k], dtype)


@pytest.mark.parametrize("h", [(5, 9, 7), (70, 33, 81)])
def test_items_have_waves_of_their_own_on_the_right(device, dtype, h):
    n, k = 25, 2 * max(h)
    w, own, which = own_tables(device, n, h)
    x, z = random(N_BATCH, N_OTHER, n), random(N_BATCH, N_OTHER, k)
    c, back = result(device, N_OTHER, k, dtype), device.zeros((N_BATCH, N_OTHER, n), dtype)
    transposed = right(device, w.swapaxes(1, 2), dtype)._replace(own=True)
    tables = right(device, w, dtype)._replace(own=True)
    into = MatrixBatch(c.base_data, c.shape[-1], c[0].size)
    out = MatrixBatch(back.base_data, n, N_OTHER * n, step=1)
    MirrorContraction(device, dtype, "right").bind(
        N_OTHER, k, n, left(device, x, dtype), transposed, into, own=ItemSizes(which, n=own)
    )(N_BATCH)
    MirrorContraction(device, dtype, "right", back=True, ragged=True).bind(
        N_OTHER, n, k, left(device, z, dtype), tables, out, own=ItemSizes(which, k=own)
    )(N_BATCH)
    found, found_back = device.get(c), device.get(back)
    for b, t in enumerate(ORDER):
        k = own[t]
        check(found[b, :N_OTHER, :k], x[b] @ w[t, :k].T, dtype)
        assert (found[b, :, (k + 15) // 16 * 16 :] == 7).all()
        check(found_back[b], z[b, :, :k] @ w[t, :k], dtype)


def test_tables_that_are_not_mirrored_take_the_whole_product(device):
    w = table(20, 6)
    assert is_mirror_symmetric(w)
    off = w.copy()
    off[:, -1] = 0  # a pixel that the model does not cover
    assert not is_mirror_symmetric(off)
    assert not is_mirror_symmetric(w[1:])  # sines first
    angle = 1e-6 * np.pi * np.arange(6)[:, None] / 33  # of pixels a millionth off their places
    cos, sin = w[0::2] - angle * w[1::2], w[1::2] + angle * w[0::2]
    assert not is_mirror_symmetric(np.stack([cos, sin], axis=1).reshape(w.shape))
    assert type(fourier_contraction(device, np.float32, "left", mirrored=False)) is Contraction


def launched(monkeypatch, op):
    """The kernels that a forward and an adjoint queue."""
    names, launch = set(), type(op.device).launch

    def noted(device, kernel, *sizes):
        names.add(kernel.function_name)
        return launch(device, kernel, *sizes)

    monkeypatch.setattr(type(op.device), "launch", noted)
    op.adjoint(op(np.ones(op.shape_in)))
    monkeypatch.undo()
    return names


@pytest.mark.parametrize(
    ("given", "observed"),
    [
        ({}, True),
        ({"angle_deg": 20}, True),
        ({"angle_deg": 90, "flip": True}, True),
        ({"center_arcsec": (2.5, 0)}, False),  # partly beyond the model, on one side
    ],
)
def test_which_operators_multiply_by_halves(device, monkeypatch, given, observed):
    model, wide = Grid.flat((64, 66), 0.1), Grid.flat((20, 22), 0.2, **given)
    (plan,) = Resampler(model, PSF.gaussian(0.8), wide, PSF.gaussian(1.5)).plans
    assert plan.mirrored["in_y"]
    assert plan.mirrored["in_x"]
    # lines have no halves along them: their columns go as far as taps reach
    ends = ("out_y",) if plan.lines else ("out_y", "out_x")
    assert all(plan.mirrored[name] for name in ends) == observed
    names = launched(monkeypatch, Resampler.from_plans([plan], device=device)) - {"gather"}
    served = is_supported(Tuning.of(device))
    assert served == (device.kind == "CPU" and not device.simulated)
    if not served:
        assert not any(name.startswith("mirror") for name in names)
    else:
        whole = set() if observed and not plan.lines else {"contract"}
        assert names == {"mirror_to_waves", "mirror_to_pixels"} | whole
