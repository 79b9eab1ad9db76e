"""Predicts by arithmetic a GPU's time for joint fits, from counts made on this machine.

    python tools/gpu_model.py [--scenes 8] [--groups 32 256 1024] [--card NAME] [--json FILE]

Scenes of bench.throughput are fitted with kernels as they are built for GPUs. That counts launches,
copies that are waited for, operations of the matrix products, bytes of buffers, and the calling
thread's own seconds. Nothing here was measured on a GPU: a launch is predicted to take

    GAP_S + the longest of its floor, operations / (peak share), bytes / (bandwidth BANDWIDTH_SHARE)

and a copy that is waited for WAIT_S. A group of n scenes has the launches that were counted, with
n times the work of a scene. On a GPU `clresample devices --bench`, and a program with
CLRESAMPLE_PROFILE=1, give what each row here is to be compared with.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# [s] From the end of a launch to the start of the next in a queue; NVIDIA's documents say 1 to 1.5.
GAP_S = 1.5e-6
# [s] A launch of few groups: some ten reads of memory, each after the other, of 650 clocks.
FLOOR_S = 5e-6
# [s] The same of kernels whose work-items walk slabs, boxes, vectors or blocks: instructions and
# reads of their loops as compiled for sm_90, times the trips of the largest sources of 32 scenes.
FLOORS_S = {
    "contract_group": 10e-6,
    "multiply_boxes": 10e-6,
    "apply_block_inverse": 125e-6,
    "form_pairs": 20e-6,
    "inner_products": 50e-6,
    "take_step": 80e-6,
    "form_morphology": 25e-6,
    "morphology_adjoint": 75e-6,
    "gather_spectra": 17e-6,
}
# [s] A copy that the host waits for: the queue runs empty, and is filled anew.
WAIT_S = 15e-6
# Part of the bandwidth that kernels reach which run through their buffers.
BANDWIDTH_SHARE = 0.7


@dataclass(frozen=True)
class Card:
    """A GPU by its data sheet.

    peak [1/s]: float32 operations; bandwidth [bytes/s]: of its memory
    share: of the peak in matrix products: multiplications among the instructions of the inner loop,
        as compiled, times the part of its tiles that is inside the matrices
    """

    name: str
    target: str
    peak: float
    bandwidth: float
    share: float


# The first three shares are of machine code from Clang 19; that of Intel, unread, is assumed.
CARDS = (
    Card("H100 SXM", "sm_90", 67e12, 3.35e12, 0.79 * 0.61),
    Card("MI250X, one die", "gfx90a", 23.9e12, 1.6e12, 0.70 * 0.61),
    Card("RX 7900 XTX", "gfx1100", 61.4e12, 0.96e12, 0.77 * 0.61),
    Card("Max 1550, one stack", "pvc", 26e12, 1.6e12, 0.40 * 0.73),
)


@dataclass(frozen=True)
class Counts:
    """Counts of the fits of `n_scenes` side by side.

    kernels {name: (launches, operations, bytes)}; operations are 0 where they are not counted
    n_waits: copies that the host waits for; n_rounds: launches of the solver's step
    host_s: seconds of the calling thread
    """

    n_scenes: int
    n_rounds: int
    n_waits: int
    host_s: float
    kernels: dict[str, tuple[int, float, float]]


@dataclass(frozen=True)
class Prediction:
    """Seconds of a group's fits on a card: its device, its waits and the host; times by kernel."""

    device_s: float
    waits_s: float
    host_s: float
    kernels: dict[str, float]
    bounds: dict[str, str]

    @property
    def limit(self):
        """The part that takes most of the time."""
        parts = {"host": self.host_s, "device": self.device_s, "waits": self.waits_s}
        return max(parts, key=parts.__getitem__)

    @property
    def total_s(self):
        """The parts one after the other, as one process without overlap has them."""
        return self.device_s + self.waits_s + self.host_s


def predict(counts, card, n_scenes):
    """The Prediction for a group of `n_scenes`, with the counts of another number of scenes."""
    scale, times, bounds = n_scenes / counts.n_scenes, {}, {}
    for name, (launches, operations, n_bytes) in counts.kernels.items():
        parts = {
            "latency": launches * FLOORS_S.get(name, FLOOR_S),
            "arithmetic": scale * operations / (card.peak * card.share),
            "bandwidth": scale * n_bytes / (card.bandwidth * BANDWIDTH_SHARE),
        }
        bounds[name] = max(parts, key=parts.__getitem__)
        times[name] = launches * GAP_S + parts[bounds[name]]
    return Prediction(
        device_s=sum(times.values()),
        waits_s=counts.n_waits * WAIT_S,
        host_s=scale * counts.host_s,
        kernels=times,
        bounds=bounds,
    )


def count(n_scenes, catalogue=None):
    """The Counts of so many joint scenes, fitted once before so that all kernels are built.

    catalogue: folder of COSMOS galaxies; None has them looked for
    """
    from bench import throughput
    from bench.harness import scenes as simulated
    from clresample import deblend_many, get_device
    from clresample.device import device as devices, kernel_profiler

    opened, copy, waited = devices.Device.__init__, devices._copy, Counter()

    def as_gpu(device, cl_device):
        opened(device, cl_device)
        device.kind, device.simulated = "GPU", False

    def counted(device, target, source, *, wait=True, **options):
        host = not all(hasattr(side, "int_ptr") for side in (target, source))
        waited["copies"] += host and wait
        return copy(device, target, source, wait=wait, **options)

    devices.Device.__init__, devices._copy = as_gpu, counted
    device = get_device()
    blends = throughput.shared_blends(simulated.Scenes(catalogue), range(n_scenes))
    deblend_many(blends, device=device)
    kernel_profiler.drain()
    waited.clear()
    began = time.thread_time()
    deblend_many(blends, device=device)
    host_s = time.thread_time() - began
    ((_, rows),) = kernel_profiler.drain()
    kernels = {name: (row.n_calls, row.flops, float(row.n_bytes)) for name, row in rows.items()}
    n_rounds = kernels.get("take_step", (0,))[0]
    return Counts(n_scenes, n_rounds, waited["copies"], host_s, kernels)


def tables(counts, cards, groups):
    """The predictions as Markdown."""
    head = (
        "| card | scenes in a group | device ms a round | device | waits | host | scenes/s "
        "| with no host | limit |"
    )
    launches = sum(row[0] for row in counts.kernels.values())
    host_ms = 1e3 * counts.host_s / counts.n_scenes
    yield (
        f"Counted of {counts.n_scenes} scenes: {counts.n_rounds} rounds, {launches} launches, "
        f"{counts.n_waits} waits, {host_ms:.0f} ms of the calling thread a scene."
    )
    yield f"\n{head}\n|---|---|---|---|---|---|---|---|---|"
    for card in cards:
        for n in groups:
            one = predict(counts, card, n)
            per_scene = [1e3 * part / n for part in (one.device_s, one.waits_s, one.host_s)]
            round_ms = 1e3 * one.device_s / max(counts.n_rounds, 1)
            cells = [card.name, str(n), f"{round_ms:.2f}", *(f"{ms:.2f}" for ms in per_scene)]
            rates = f"{n / one.total_s:.1f} | {n / (one.device_s + one.waits_s):.0f}"
            yield f"| {' | '.join(cells)} | {rates} | {one.limit} |"
    first = predict(counts, cards[0], groups[0])
    where = f"{cards[0].name}, {groups[0]} scenes"
    yield f"\nDevice, waits and host in ms a scene. By kernel, {where}:\n"
    yield "| kernel | launches | ms | bound by |\n|---|---|---|---|"
    for name in sorted(first.kernels, key=first.kernels.__getitem__, reverse=True):
        launches = counts.kernels[name][0]
        ms = 1e3 * first.kernels[name]
        yield f"| {name} | {launches} | {ms:.2f} | {first.bounds[name]} |"


def main(arguments=None):
    """Prints the tables; the exit status."""
    parser = argparse.ArgumentParser("gpu_model", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=8, help="that are counted")
    parser.add_argument("--groups", type=int, nargs="+", default=[32, 256, 1024])
    parser.add_argument("--catalogue", help="folder of the galaxies that are simulated")
    parser.add_argument("--card", choices=[card.name for card in CARDS], help="that alone")
    parser.add_argument("--json", type=Path, help="counts: read if there, else written")
    given = parser.parse_args(arguments)
    if given.json and given.json.is_file():
        counts = Counts(**json.loads(given.json.read_text()))
    else:
        sys.path.insert(0, str(ROOT))
        with tempfile.TemporaryDirectory() as folder:
            os.environ |= {"CLRESAMPLE_CACHE": folder, "CLRESAMPLE_PROFILE": "1"}
            counts = count(given.scenes, given.catalogue)
        if given.json:
            given.json.write_text(json.dumps(asdict(counts), indent=1))
    cards = [card for card in CARDS if given.card in (None, card.name)]
    print("\n".join(tables(counts, cards, given.groups)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
