"""Random matrices, tiles and the check of products, for tests of the contraction kernels."""

import itertools

import numpy as np
import pytest

from clresample.device.contraction import row_stride

from .tuning import tune

TYPES = (np.float32, np.float64)
every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)


TILES = {
    "CPU": {"VW": 8, "NV": 1, "MR": 6, "WGX": 1, "WGY": 1},
    "AVX2": {"VW": 16, "NV": 1, "MR": 6, "WGX": 1, "WGY": 1},
    "wide CPU": {"VW": 16, "NV": 2, "MR": 8, "WGX": 1, "WGY": 1},
    "GPU": {"VW": 4, "NV": 1, "MR": 8, "WGX": 8, "WGY": 8},
    "pairs": {"VW": 2, "NV": 3, "MR": 8, "WGX": 8, "WGY": 8},
    "groups": {"VW": 4, "NV": 2, "MR": 8, "WGX": 8, "WGY": 8, "KB": 16},
    "tall groups": {"VW": 2, "NV": 1, "MR": 6, "WGX": 4, "WGY": 16, "KB": 16},
}


OWN = [("device's", dtype) for dtype in TYPES]


def _tiled(cases):
    """Parametrises a test with the fixture `dtype` by cases of a tile and a type."""
    ids = [f"{name}-{dtype.__name__}" for name, dtype in cases]
    return pytest.mark.parametrize("dtype", cases, ids=ids, indirect=True)


# The device's own tile in both types, and those of other devices, which any must run: in both, or
# by turns in one where a test needs several kernels of each, which take seconds to build.
every_tile = _tiled(OWN + [(name, dtype) for name in TILES for dtype in TYPES])
by_turns = _tiled(OWN + list(zip(TILES, itertools.cycle(TYPES))))


@pytest.fixture
def dtype(request, device, monkeypatch):
    """The type of a case, with its tile in use; see `every_tile`."""
    return type_of(request.param, device, monkeypatch)


def type_of(case, device, monkeypatch):
    """The type of a case, whose tile is in use from now on."""
    name, dtype = case
    need(device, dtype)
    if name != "device's":
        tune(monkeypatch, tile=TILES[name], row_choices=())
    return dtype


def random(*shape, seed=0):
    return np.random.default_rng([seed, *shape]).normal(size=shape)


def put_right(device, b, dtype):
    """(B, k, n) matrices on the device, columns padded with zeros."""
    host = np.zeros((*b.shape[:-1], row_stride(b.shape[-1])))
    host[..., : b.shape[-1]] = b
    return device.put(host, dtype)


def check(found, truth, dtype):
    """Two rounded factors and a rounded sum of random signs: 4 units of the type, relative L2."""
    error = np.linalg.norm(found - truth) / np.linalg.norm(truth)
    assert error <= 4 * np.finfo(dtype).eps, f"error {error:.1e}"


def need(device, dtype):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no float64")
