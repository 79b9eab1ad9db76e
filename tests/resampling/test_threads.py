"""One operator, and one device, used by several threads at once: what each gets is its own."""

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH, operator, psfs

N_THREADS, N_CALLS = 4, 60


def in_threads(run, n_threads=N_THREADS):
    """Results of `run(i)` in thread i, all threads at once."""
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(run, range(n_threads)))


@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_one_operator_in_several_threads(device, geometry):
    op = operator(device, GEOMETRIES[geometry](), *psfs())
    rng = np.random.default_rng(3)
    x = rng.normal(size=(N_THREADS, 4, *op.shape_in)).astype(np.float32)
    y = rng.normal(size=(N_THREADS, 4, *op.shape_out)).astype(np.float32)
    # batches of different lengths, so that the intermediates are made anew between the threads
    ways = [(op.forward, x), (op.adjoint, y), (op.render, x[:, :, 0])]
    alone = [[run(images[i, : 1 + i]) for run, images in ways] for i in range(N_THREADS)]

    def wrong(i):
        n = 0
        for k in range(N_CALLS):
            run, images = ways[k % 3]
            n += not np.array_equal(run(images[i, : 1 + i]), alone[i][k % 3])
        return n

    assert in_threads(wrong) == [0] * N_THREADS


def test_device_arrays_in_several_threads(device):
    op = operator(device, GEOMETRIES["60 degrees"](), *psfs())
    x = np.random.default_rng(3).normal(size=(N_THREADS, *op.shape_in)).astype(np.float32)
    alone = [op(image) for image in x]

    def wrong(i):
        source, out = device.put(x[i : i + 1].repeat(1 + i, axis=0)), None
        n = 0
        for _ in range(N_CALLS):
            out = op(source, out=out)
            n += not np.array_equal(device.get(out)[-1], alone[i])
        return n

    assert in_threads(wrong) == [0] * N_THREADS


@pytest.mark.counts_memory
def test_memory_is_counted_right_in_threads(device):
    gc.collect()  # of earlier tests, whose memory would be given back meanwhile
    before = device.in_use

    def fill(i):
        for _ in range(300):
            device.empty((1 + i,), np.float32)

    in_threads(fill)
    assert device.in_use == before
