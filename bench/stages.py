"""Stages at which spectra are applied to the sources: counted operations and time.

    python -m bench.stages [--quick] [--json FILE]

A row is one observation of a batch of joint scenes, one thread: its part of an iteration, model to
gradients, with spectra applied to frames (depth 0), between the operator's two transforms of the
model (1) and after both (2); see clresample/deblending/solver/rendering/stages.py; and of large
scenes in windows (3), where these are chosen. Scenes have sources in random boxes; those of one
size share their operators.

mf       10^6 weighed operations of a scene at each depth, what all of them do left out
ms       processor time of a scene at each depth, calls by turns
chosen   the depth that the solver takes; gain: time at depth 0 over that
"""

from __future__ import annotations

import functools
import time

import numpy as np

from clresample import get_device
from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.gradient import LossGradient
from clresample.deblending.solver.rendering.stage_selection import stage_flops
from clresample.deblending.solver.scene import Scene, State
from clresample.paper.solver.prior import SingleScalePrior
from clresample.resampling.resampler import Resampler
from clresample.simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY

from .harness import records
from .harness.clock import interleaved_ms, on_one_thread
from .harness.crowded import crowded_blend
from .harness.options import Parser, run

# Sources, model pixels a side, scenes of the batch, turn of Rubin's pixels [degrees]
QUICK = ((2, 118, 8, 0.0), (9, 118, 8, 0.0))
ALL = tuple((n, 118, 8, 0.0) for n in (1, 3, 5, 9, 20)) + (
    (5, 118, 8, 12.0),
    (20, 256, 1, 12.0),
    (60, 512, 1, 12.0),
)
BOX_PX = 18, 50  # Sides of the boxes that galaxies of bench.deblend have
COLUMNS = records.columns(
    "survey:12 geometry:8 n_sources:9d n_model:7d n_scenes:8d mf:22 ms:32 chosen:6d gain:5.2f"
)


def operators(n_model, angle_deg):
    """Those of Euclid and Rubin for the frame of a blend of `n_model` pixels a side."""
    frame = crowded_blend(0, 1, n_model).frame
    n_rubin = RUBIN_UGRIZY.n_same_sky(n_model, EUCLID_VIS)
    pairs = (
        (EUCLID_VIS.grid(n_model), EUCLID_VIS),
        (RUBIN_UGRIZY.grid(n_rubin, angle_deg=angle_deg), RUBIN_UGRIZY),
    )
    return [Resampler(frame.grid, frame.psf, grid, survey.psf()) for grid, survey in pairs]


def scene(rng, ops, n_sources):
    """A Scene and State of galaxies with exponential profiles in random boxes."""
    shape = ops[0].shape_in[1:]
    sizes = rng.integers(*BOX_PX, (n_sources, 2))
    profiles = []
    for size in sizes:
        y, x = (np.arange(n) - n / 2 for n in size)
        profiles.append(np.exp(-np.hypot(y[:, None], x) / (0.1 * size.max())))
    n_channels = sum(op.shape_out[0] for op in ops)
    found = Scene(
        shape=shape,
        unpadded_shape=shape,
        ops=ops,
        data=[rng.normal(size=op.shape_out) for op in ops],
        weights=[np.ones(op.shape_out) for op in ops],
        origin=rng.integers(0, np.array(shape) - sizes + 1),
        center=sizes // 2,
        profile=profiles,
        fixed=np.zeros(n_sources, bool),
    )
    spectra = rng.uniform(5, 50, (n_sources, n_channels))
    return found, State(profiles, spectra, np.zeros(n_channels))


def iteration(device, observed):
    """An observation's part of one, until it is done."""
    observed.queue()
    device.finish()


def rows_of(case, rng, seconds):
    """A row for each observation."""
    n_sources, n_model, n_scenes, angle_deg = case
    ops, device = operators(n_model, angle_deg), get_device()
    scenes, states = zip(*(scene(rng, ops, n_sources) for _ in range(n_scenes)), strict=True)
    buffers = SceneBuffers(scenes, states, device, np.float32, SingleScalePrior())
    ways = {depth: LossGradient(buffers, depth).observations for depth in (0, 1, 2)}
    chosen = LossGradient(buffers).observations
    for i, survey in enumerate((EUCLID_VIS, RUBIN_UGRIZY)):
        observed = {depth: observations[i] for depth, observations in ways.items()}
        observed.setdefault(chosen[i].rendering.depth, chosen[i])
        calls = {
            depth: functools.partial(iteration, device, one) for depth, one in observed.items()
        }
        ms = interleaved_ms(calls, seconds=seconds, timer=time.process_time)
        counts = stage_flops(buffers, chosen[i].op, chosen[i].op.executor())
        depth = chosen[i].rendering.depth
        yield {
            "survey": survey.name,
            "geometry": chosen[i].op.geometry,
            "n_sources": n_sources,
            "n_model": n_model,
            "n_scenes": n_scenes,
            "mf": [round(float(count) / n_scenes / 1e6, 1) for count in counts],
            "ms": [round(t / n_scenes, 3) for t in ms.values()],
            "chosen": depth,
            "gain": ms[0] / ms[depth],
        }


def main(options):
    threads = on_one_thread()
    rng, cases = np.random.default_rng(options.seed), QUICK if options.quick else ALL
    rows = (row for case in cases for row in rows_of(case, rng, options.seconds))
    records.show(COLUMNS, rows, records.record(threads), options.json)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "two batches of small scenes")
    parser.add_seed(0, "of the random boxes")
    parser.add_seconds(1.0, "row")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
