"""Sizes by vendor: each vendor's tiles give the same bits, and its kernels the same gradients."""

import numpy as np
import pytest
from helpers.products import check, every_type, need, put_right, random
from helpers.solver import PRIOR, posed
from helpers.tuning import tune

from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.gradient import LossGradient
from clresample.device.contraction import ONE_SUM, Contraction, MatrixBatch
from clresample.device.device import Device
from clresample.device.gpu_sizes import gpu_sizes, gpu_vendor
from clresample.device.tuning import is_tile

VENDORS = ("NVIDIA", "AMD", "Intel")


@pytest.mark.parametrize(
    ("name", "vendor"),
    [
        ("NVIDIA Corporation", "NVIDIA"),
        ("Advanced Micro Devices, Inc.", "AMD"),
        ("AMD", "AMD"),  # Mesa
        ("Intel(R) Corporation", "Intel"),
        ("ARM", "NVIDIA"),
        ("AuthenticAMD", "NVIDIA"),  # PoCL's CPUs that pose as GPUs
    ],
)
def test_vendors_go_by_how_drivers_name_them(name, vendor):
    assert gpu_vendor(name) == vendor


@every_type
@pytest.mark.parametrize("vendor", VENDORS)
def test_tiles_build_and_local_memory_is_what_opencl_promises(vendor, dtype):
    sizes = gpu_sizes(vendor, dtype)
    for rows in {*sizes["row_choices"], sizes["tile"]["MR"]}:
        tile = sizes["tile"] | {"MR": rows}
        assert is_tile(tile)
        height, width = tile["MR"] * tile["WGY"], tile["NV"] * tile["VW"] * tile["WGX"]
        slabs = 2 * tile["KB"] * (height + 4 + width) * np.dtype(dtype).itemsize
        assert slabs <= 32 << 10
    assert sizes["lanes"] in (4, 8, 16)


@every_type
def test_two_sums_take_tiles_with_registers_for_them(device, monkeypatch, dtype):
    monkeypatch.setattr(device, "kind", "GPU")
    product = Contraction(device, np.dtype(dtype))
    most = gpu_sizes("NVIDIA", dtype)["two_sum_rows"]
    for n_rows in (None, 40, 80, 500):
        for n_terms in (ONE_SUM, ONE_SUM + 1):
            _, macros = product.build(n_rows, n_terms, 64)
            assert macros["TWO_SUMS"] == (n_terms > ONE_SUM)
            assert not macros["TWO_SUMS"] or macros["MR"] <= most
    assert product.build(80, 64, 64)[1]["MR"] == (10 if dtype == np.float32 else 6)


def product_with(sizes, device, monkeypatch, a, b, dtype):
    (m, k), n = a.shape, b.shape[1]
    right = put_right(device, b, dtype)
    result = device.zeros((m, right.shape[-1]), dtype)
    with monkeypatch.context() as patch:
        tune(patch, **sizes)
        Contraction(device, dtype).bind(
            m, n, k, MatrixBatch(device.put(a, dtype).base_data, k),
            MatrixBatch(right.base_data, right.shape[-1]),
            MatrixBatch(result.base_data, right.shape[-1]),
        )(1)  # fmt: skip
    return device.get(result)[:, :n]


@pytest.mark.parametrize(
    ("k", "dtype"), [(37, np.float32), (ONE_SUM + 30, np.float32), (ONE_SUM + 30, np.float64)]
)
def test_products_have_the_same_bits_with_tiles_of_all_vendors(device, monkeypatch, k, dtype):
    need(device, dtype)
    a, b = random(50, k), random(k, 70)
    first, *others = (
        product_with(gpu_sizes(vendor, dtype), device, monkeypatch, a, b, dtype)
        for vendor in VENDORS
    )
    check(first, a @ b, dtype)
    for other in others:
        np.testing.assert_array_equal(other, first)


def gradient_with(vendor, device, monkeypatch):
    """Gradients of two scenes by morphologies and spectra, of kernels as built for a vendor."""
    with monkeypatch.context() as patch:
        # a device of its own: operators that it keeps are no other's
        own = Device(device.cl)
        patch.setattr(own, "kind", "GPU")
        patch.setattr(own, "simulated", False)
        tune(patch, **gpu_sizes(vendor))
        scene, state = posed(own, np.float32, fixed=(1,))
        buffers = SceneBuffers([scene, scene], [state, state], own, np.float32, PRIOR)
        LossGradient(buffers).queue()
        return [own.get(array) for array in (buffers.d_morph, buffers.d_spectra)]


def test_gradients_have_the_same_bits_with_smaller_tiles_of_boxes(device, monkeypatch):
    first, other = (gradient_with(vendor, device, monkeypatch) for vendor in ("NVIDIA", "Intel"))
    for one, same in zip(first, other, strict=True):
        assert np.abs(one).max() > 0
        np.testing.assert_array_equal(same, one)
