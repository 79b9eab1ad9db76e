"""Runs every kernel in small shapes: under Oclgrind, which reports races and bad accesses.

    python tools/grind.py [--as cpu|gpu] [--plant race|overrun]

Every kernel of kernels/ must have been launched, as built for CPUs or for GPUs; one that was not is
named, and the exit status is 1. Oclgrind writes what it finds on standard error and leaves the exit
status alone: tools/grind.sh reads both. --plant adds a kernel with a fault that must be reported.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from clresample import (  # noqa: E402
    PSF,
    Blend,
    Device,
    ExtendedSource,
    FunctionPSF,
    Grid,
    MultiscalePrior,
    Observation,
    PaperResampler,
    PaperSettings,
    PointSource,
    Resampler,
    Settings,
    SingleScalePrior,
    deblend_many,
    get_device,
    model_frame,
)
from clresample.deblending.fit import Fit, start_fits  # noqa: E402
from clresample.deblending.solver.boxes import Boxes  # noqa: E402
from clresample.deblending.solver.buffers import SceneBuffers  # noqa: E402
from clresample.deblending.solver.gradient import LossGradient  # noqa: E402
from clresample.deblending.solver.multiscale import inverse  # noqa: E402
from clresample.deblending.solver.multiscale.engine import MultiscaleEngine  # noqa: E402
from clresample.device import tuning  # noqa: E402
from clresample.device.program import Launcher  # noqa: E402
from clresample.paper.solver.constraints import (  # noqa: E402
    L0,
    L1,
    MaxNorm,
    Monotone,
    Positivity,
    ProxChain,
    SumNorm,
    Symmetry,
)

FAULTS = {
    "race": "__kernel void race(__global float *x) { x[0] += get_global_id(0); }",
    "overrun": "__kernel void overrun(__global float *x) { x[get_global_id(0) + 8] = 1; }",
}
# Terms of the paper's contraction for a work-item: small models have few, and are cut all the same.
CHUNK_TERMS = 32
# Coefficients of a block of inverse curvature: small sources have several blocks with this.
SMALL_BLOCK = 16
# Loops of a work-item in a launch: few enough that a projection takes several.


def all_kernels():
    """All kernels of kernels/: "file name" each."""
    found = {path.name: path.read_text() for path in sorted((ROOT / "kernels").glob("*.cl"))}
    head = re.compile(r"__kernel\b[^;{]*?\bvoid\s+(\w+)")
    return {f"{file} {name}" for file, text in found.items() for name in head.findall(text)}


def watch(device, kind):
    """Builds kernels as for `kind`; returns the set that collects names of launched kernels."""
    device.kind, device.simulated = kind.upper(), False
    launched, launch, made = set(), Launcher.__call__, Device.launcher

    def of_file(self, file, name, **options):
        launcher = made(self, file, name, **options)
        launcher.source = f"{file} {name}"
        return launcher

    def noted(self, *arguments, **given):
        launched.add(self.source)
        launch(self, *arguments, **given)

    Device.launcher, Launcher.__call__ = of_file, noted
    of = tuning.Tuning.of
    # Oclgrind knows no instruction that reads ahead, which changes no result.
    sizes = {"chunk_terms": CHUNK_TERMS, "prefetch_columns": False}
    tuning.Tuning.of = lambda *a: replace(of(*a), **sizes)
    return launched


def resample(device):
    """Operators of every geometry, forward and adjoint, with own tables for each of two scenes."""
    fine, turned = Grid.flat((11, 12), 0.1), Grid.flat((6, 5), 0.2, angle_deg=25)
    narrow, wide = PSF.gaussian(0.8, n_pixels=7), PSF.gaussian([1.1, 1.3], n_pixels=7)
    for grid in (Grid.flat((6, 5), 0.2), turned, Grid.flat((5, 6), 0.2, angle_deg=115)):
        for kind in (Resampler, PaperResampler):
            op = kind(fine, narrow, grid, wide, device=device)
            op.adjoint(op(np.ones(op.shape_in)))
    from helpers.geometries import distorted, operator, turn

    op = operator(device, distorted(turn(0), (11, 12), (4, 5)), narrow, wide)
    op.adjoint(op(np.ones(op.shape_in)))


def blends(n, profile=None, *, varying=False):
    """Two galaxies and a star, seen by two instruments, the second of which is turned.

    Each blend is brighter than the one before: their fits end after different numbers of steps.

    profile: of the galaxies; None has one fitted, which takes most of a fit's time
    varying: the first instrument's PSF widens along x, and all channels are exposures of one band
    """
    rng = np.random.default_rng(5)
    grids = Grid.flat((10, 10), 0.1), Grid.flat((5, 6), 0.2, angle_deg=15)
    psfs = PSF.gaussian(0.8, n_pixels=5), PSF.gaussian([1.0, 1.1], n_pixels=5)
    made = []
    for k in range(n):
        observations = []
        for i, (grid, psf) in enumerate(zip(grids, psfs)):
            y, x = np.indices(grid.shape) - (np.array(grid.shape)[:, None, None] - 1) / 2
            light = 9.0 ** (k - 1) * np.exp(-np.hypot(y, x) / 2)
            light = light + 0.01 * rng.standard_normal((psf.n_bands, *y.shape))
            weights = np.full(light.shape, 1e4)
            names = [f"{i}{band}" for band in range(psf.n_bands)]
            seen = FunctionPSF(_widening, 1) if varying and not i else psf
            given = {"weights": weights, "channels": names}
            if varying:
                given["bands"] = ["g"] * psf.n_bands
            observations.append(Observation(light, seen, grid, **given))
        places = (4.5, 4.5), (3.0, 6.5)
        galaxies = [ExtendedSource(position_px=place, profile=profile) for place in places]
        sources = (*galaxies, PointSource(position_px=(6.5, 3.0)))
        frame = model_frame(observations, grid=grids[0])
        made.append(Blend(tuple(observations), sources, frame))
    return made


def _widening(y, x):
    return PSF.gaussian(0.8 + 0.02 * x, n_pixels=5)


def render(device):
    """Gradients of a scene with spectra applied at each stage, whichever a fit would choose."""
    from helpers.solver import PRIOR, posed

    scene, state = posed(device, np.float32, fixed=(1,))
    for depth in (0, 1, 2, 3):
        buffers = SceneBuffers([scene, scene], [state, state], device, np.float32, PRIOR)
        LossGradient(buffers, depth=depth).queue()
    device.finish()


CHAIN = ProxChain(Positivity(), L1(1e-3), L0(1e-3), Symmetry(0.5), Monotone(), MaxNorm())
# All kinds of fits, some iterations each.
FITS = (
    Settings(prior=MultiscalePrior(), max_iter=2),
    Settings(prior=MultiscalePrior(), max_iter=25, loss_tol=20.0, fit_sky=True),
    PaperSettings(prior=SingleScalePrior(), max_iter=2, fit_sky=True),
    PaperSettings(prior=None, max_iter=2, constraints=CHAIN),
    PaperSettings(prior=None, max_iter=2, constraints=ProxChain(Positivity(), SumNorm())),
)


def _disc():
    y, x = np.indices((10, 10)) - 4.5
    return np.exp(-np.hypot(y, x) / 2)


def leave(device):
    """One of two scenes goes on alone, its sources in several blocks each."""
    settings, most = Settings(prior=MultiscalePrior()), inverse.MAX_BLOCK_SIZE
    inverse.MAX_BLOCK_SIZE = SMALL_BLOCK
    try:
        fits = [Fit(b, settings, device, np.float32, pad=1) for b in blends(2, _disc())]
        start_fits(fits)
        scenes, states = [f.scene for f in fits], [f.state for f in fits]
        engine = MultiscaleEngine(scenes, states, device, np.float32, settings.prior, 1.0)
        engine.round()
        engine.subset([1]).round()
    finally:
        inverse.MAX_BLOCK_SIZE = most


def vary(device):
    """A fit with a PSF that varies over the blend, to exposures of one band."""
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=1)
    (result,) = deblend_many(blends(1, _disc(), varying=True), settings=settings, device=device)
    if result.status == "failed":
        raise SystemExit(f"grind: a fit failed: {result.reason}")


def fit(device):
    """FITS of three scenes side by side."""
    disc = _disc()
    for settings in FITS:
        began = time.perf_counter()
        profile = None if settings is FITS[0] else disc
        for result in deblend_many(blends(3, profile), settings=settings, device=device):
            if result.status == "failed":
                raise SystemExit(f"grind: a fit failed: {result.reason}")
        print(f"grind: fit in {time.perf_counter() - began:.0f} s", flush=True)


def constrain(device):
    """Constraints on morphologies of a caller's own."""
    boxes = Boxes([0, 0], [[0, 0], [1, 2]], [[9, 8], [5, 7]]).put(device)
    morphs = device.put(np.random.default_rng(3).standard_normal(boxes.boxes.size), np.float32)
    CHAIN.prox(morphs, boxes)


# In the order in which they are run.
WORKS = (resample, render, constrain, leave, vary, fit)


def plant(device, fault):
    """Launches a kernel with a fault."""
    import pyopencl as cl

    kernel = cl.Kernel(cl.Program(device.context, FAULTS[fault]).build(), fault)
    kernel.set_args(device.zeros(8, np.float32).base_data)
    device.launch(kernel, (8,), (8,))
    device.finish()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--as", dest="kind", choices=("cpu", "gpu"), default="gpu")
    parser.add_argument("--plant", choices=FAULTS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    sys.path.insert(0, str(ROOT / "tests"))
    began, device = time.perf_counter(), get_device()
    if arguments.plant:
        plant(device, arguments.plant)
        return 0
    launched = watch(device, arguments.kind)
    for work in WORKS:
        work(device)
        device.finish()
        print(f"grind: {work.__name__} after {time.perf_counter() - began:.0f} s", flush=True)
    others = {  # kernels of the other kind of device
        "cpu": {"contract_group.cl contract_group"},
        "gpu": {
            f"{name}.cl {name}"
            for name in ("contract", "folded", "mirror_to_waves", "mirror_to_pixels")
        },
    }
    missing = all_kernels() - launched - others[arguments.kind]
    took = f"{time.perf_counter() - began:.0f} s on {device.name}"
    print(f"grind: {len(launched)} kernels as on a {arguments.kind.upper()}, {took}")
    if missing:
        print(f"grind: never launched: {', '.join(sorted(missing))}")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
