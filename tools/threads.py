"""Are operators and fits the same in several threads as alone? 800 renders in 4, 24 fits in 3.

    make threads RUNTIME=pocl        or: python tools/threads.py [--unlocked]

Prints how many results differ in any bit from those alone, and what locks take of a render in one
thread. Exit status 1 if any result differs. --unlocked takes the operators' locks away for the
renders, to show that the check can fail.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from clresample import (
    PSF,
    ExtendedSource,
    Grid,
    Observation,
    Resampler,
    Settings,
    deblend,
    get_device,
)
from clresample.cli.device_tools.measure import best_seconds
from clresample.device.program import Launcher

N_RENDERS, RENDER_THREADS, N_FITS, FIT_THREADS = 800, 4, 24, 3
SHAPE, N_DIFFERENT = (100, 90), 8  # [model px] of an image; images or blends that differ


def operators(device):
    """One of each kind of pixels: in line with the model's, and turned by 30 degrees."""
    for angle in (0, 30):
        seen = Grid.flat((50, 46), 0.2, angle_deg=angle)
        yield Resampler(
            Grid.flat(SHAPE, 0.1), PSF.gaussian(0.9), seen, PSF.gaussian(1.3), device=device
        )


def wrong_renders(op, n, n_threads):
    """Number of n calls, forward and adjoint in turn, that differ from the same call alone."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(N_DIFFERENT, *op.shape_in)).astype(np.float32)
    y = rng.normal(size=(N_DIFFERENT, *op.shape_out)).astype(np.float32)
    ways = [(op, x), (op.adjoint, y)]
    alone = [[run(image) for image in images] for run, images in ways]

    def work(thread):
        wrong = 0
        for k in range(n // n_threads):
            (run, images), i = ways[k % 2], (thread + k // 2) % N_DIFFERENT
            wrong += not np.array_equal(run(images[i]), alone[k % 2][i])
        return wrong

    return in_threads(work, n_threads)


def wrong_fits(device, n, n_threads):
    """Number of n fits of blends of equal geometry, which share operators, that differ."""
    blends = [blend(seed, device) for seed in range(N_DIFFERENT)]
    settings = Settings(max_iter=15)

    def fit(one):
        result = deblend(*one, settings=settings, device=device)
        return [a for c in result.components for a in (c.morphology, c.spectrum)] + [result.losses]

    alone = [fit(one) for one in blends]

    def work(thread):
        wrong = 0
        for k in range(thread, n, n_threads):
            found, truth = fit(blends[k % N_DIFFERENT]), alone[k % N_DIFFERENT]
            wrong += not all(np.array_equal(a, b) for a, b in zip(found, truth))
        return wrong

    return in_threads(work, n_threads)


def blend(seed, device):
    """Two galaxies in two images, of the noise that `seed` gives: (observations, sources)."""
    rng = np.random.default_rng(seed)
    model = Grid.flat((40, 40), 0.1)
    y, x = np.indices(model.shape)
    places = [(17.0, 16.0), (23.0, 25.0)]
    light = sum(np.exp(-np.hypot(y - a, x - b) / 2.5) for a, b in places)
    observations = []
    turned = Grid.flat((20, 20), 0.2, angle_deg=20)
    for grid, sigma, band in ((model, 1.0, "g"), (turned, 1.3, "r")):
        psf = PSF.gaussian(sigma)
        op = Resampler(model, PSF.gaussian(0.8), grid, psf, device=device)
        data = op(10 * light.astype(np.float32)) + 0.1 * rng.standard_normal(op.shape_out)
        observations.append(Observation(data, psf, grid, weights=100.0, channels=[band]))
    return observations, [ExtendedSource(position_px=p) for p in places]


def in_threads(work, n_threads):
    with ThreadPoolExecutor(n_threads) as pool:
        return sum(pool.map(work, range(n_threads)))


def share_of_locks(op):
    """Part of a render's time in one thread that its locks take, and how many they are.

    Each launch of a kernel takes one, and the call of the operator one; nobody else holds them.
    """
    x, launches, call = np.ones(op.shape_in, np.float32), [0], Launcher.__call__

    def counted(self, *arguments, **given):
        launches[0] += 1
        return call(self, *arguments, **given)

    Launcher.__call__ = counted
    op(x)
    Launcher.__call__ = call
    n_locks = 1 + launches[0]
    lock = threading.RLock()

    def locks():
        for _ in range(1000 * n_locks):
            with lock:
                pass

    return best_seconds(locks, 0.2) / 1000 / best_seconds(lambda: op(x), 0.5), n_locks


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--unlocked", action="store_true", help="renders without locks")
    options = parser.parse_args()
    device, n_wrong = get_device(), 0
    print(device)
    for op in operators(device):
        if options.unlocked:
            op._lock = contextlib.nullcontext()
        wrong = wrong_renders(op, N_RENDERS, RENDER_THREADS)
        n_wrong += wrong
        print(f"{wrong} of {N_RENDERS} renders ({op.geometry}) in {RENDER_THREADS} threads wrong")
        share, n = share_of_locks(op)
        print(f"locks are {share:.2%} of a render in one thread: {n} of them")
    wrong = wrong_fits(device, N_FITS, FIT_THREADS)
    print(f"{wrong} of {N_FITS} fits in {FIT_THREADS} threads wrong")
    return 1 if n_wrong + wrong else 0


if __name__ == "__main__":
    sys.exit(main())
