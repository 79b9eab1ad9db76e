"""Cost of a source: many joint scenes at once, and single blends of many sources.

    python -m bench.throughput [--quick] [--processes N] [--json FILE]

A row is one batch of simulated Euclid + Rubin scenes, images to catalogues, or one large blend:

shared     scenes as in bench.deblend, all with the same pixels and PSFs
own        the same scenes, each with a WCS, a rotation of Rubin's pixels and PSFs of its own
blend      one field of many sources, 7 bands, Rubin turned by 12 degrees; in a process of its own

core_s_per_source   processor time of all threads, over all sources
wall_s              of the whole: set-up, fit, errors, result, catalogue; also start of processes
galsim_ms           processor time of one GalSim quintic render of one band, EUCLID -> RUBIN at
                    N = 118, as a clock: median of renders before and after
renders_per_source  core_s_per_source in such renders
host_ms_a_scene     thread time of the calling thread, which a faster device would leave; with
                    processes that of the waiting one, as peak_gb
host_ms             of that by stage, likewise a scene; and the time of a round of learning
stage               seconds of wall time by stage, as results have them, and of catalogues; of
                    results that threads make side by side, those of each
peak_gb             largest memory of the process so far, all included; before the row: base_gb
status              share of converged fits; of a blend how it ended, or why it did not
"""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from clresample import catalogue

from .harness import records, scenes
from .harness.clock import on_all_cores
from .harness.crowded import crowded_blend
from .harness.host import host_stages
from .harness.options import ROOT, Parser, run

N_SCENES, N_QUICK = 32, 8
# Sources of a blend, and its model's pixels a side.
BLENDS = {20: 256, 60: 512, 300: 1024}
QUICK_BLENDS = (20,)
# [s] A blend that takes longer, its simulation included, is given up. --quick must end in a minute.
LIMIT_S, QUICK_LIMIT_S = 600.0, 35.0
MEMORY_GB = 8.0  # A process that wants more is refused it, before the machine suffers.
N_TICKS = 10  # GalSim renders before and after each row
WARM_SEED = 1000  # Of scenes that only have the kernels built before anything is timed.
WARM_BLEND = 3, 96  # Sources and pixels of a small blend for the same purpose.
COLUMNS = records.columns(
    "what:6 n_scenes:8d n_sources:9d n_model:7d core_s_per_source:17.4f wall_s:7.2f "
    "host_ms_a_scene:15.1f galsim_ms:9.3f renders_per_source:18.1f iterations:10.0f chi2:6.3f "
    "peak_gb:7.2f status:15"
)


def timed(what, blends, clock, processes=1):
    """Row of blends fitted side by side, up to their catalogues."""
    base_gb = _peak_gb()
    clock.ticks(N_TICKS)
    wall_s, core_s = time.perf_counter(), _core_s()
    with host_stages() as host:
        results = scenes.fit(blends, processes=processes)
        for result in results:
            if result.status == "failed":
                raise RuntimeError(result.reason)
        began = time.perf_counter()
        with host.stage("catalogue"):
            n_sources = sum(len(catalogue(result)) for result in results)
        ended = time.perf_counter()
    wall_s, core_s = ended - wall_s, _core_s() - core_s
    clock.ticks(N_TICKS)
    galsim_ms = clock.take_ms()
    stage = Counter()
    for result in results:
        stage.update(result.seconds)
    converged = sum(result.converged for result in results)
    return {
        "what": what,
        "n_scenes": len(blends),
        "n_sources": n_sources,
        "n_model": results[0].frame.shape[0],
        "core_s_per_source": core_s / n_sources,
        "wall_s": wall_s,
        "host_ms_a_scene": 1e3 * host.seconds.total() / len(blends),
        "galsim_ms": galsim_ms,
        "renders_per_source": core_s / n_sources / galsim_ms * 1e3,
        "iterations": float(np.median([scenes.iterations(r) for r in results])),
        "chi2": float(np.mean([scenes.chi2_of_all(r) for r in results])),
        "peak_gb": _peak_gb(),
        "base_gb": base_gb,
        "stage": {**stage, "catalogue": ended - began},
        "host_ms": {
            **{name: 1e3 * s / len(blends) for name, s in host.seconds.most_common()},
            "learning round": 1e3 * host.mean_s("learn", "blocks"),
        },
        "status": results[0].status if len(results) == 1 else f"{converged} converged",
    }


def _core_s():
    """Processor time of this process and of those that it started and that have ended [s]."""
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _peak_gb():
    """Largest memory that this process has held so far [GB]."""
    status = Path("/proc/self/status")  # getrusage says of a new process what its parent held
    if status.is_file():
        return int(re.search(r"VmHWM:\s*(\d+) kB", status.read_text())[1]) * 1024 / 1e9
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, else KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def shared_blends(sky, seeds):
    return [scenes.blend(sky.take(i), "joint") for i in seeds]


def own_blends(sky, seeds):
    """The scenes at places of their own on the sphere, Rubin turned at random, PSFs all new."""
    found = []
    for i in seeds:
        rng = np.random.default_rng(i)
        geometry = {
            "angle_deg": rng.uniform(-45, 45),
            "center_deg": (rng.uniform(0, 360), rng.uniform(-60, 60)),
        }
        found.append(scenes.blend(scenes.as_new(sky.take(i, **geometry), rng), "joint"))
    return found


def blend_row(options):
    """The row of one large blend, in this process."""
    n_sources = options.blend
    limit = int(options.memory * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    scenes.fit([crowded_blend(WARM_SEED, *WARM_BLEND)])
    blend = crowded_blend(options.seed, n_sources, BLENDS[n_sources], options.sky)
    return timed("blend", [blend], scenes.GalSimClock(timer=time.process_time))


def blend_apart(n_sources, options, limit_s):
    """The same in a process of its own, which may fail, or last too long, without harm."""
    row = dict.fromkeys((name for name, *_ in COLUMNS), float("nan"))
    row |= {"what": "blend", "n_scenes": 1, "n_sources": n_sources, "n_model": BLENDS[n_sources]}
    row |= {"base_gb": float("nan"), "stage": {}, "host_ms": {}}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "row.json"
        command = [sys.executable, "-m", "bench.throughput", "--blend", n_sources, "--json", file]
        command += ["--seed", options.seed, "--memory", options.memory]
        command += ["--sky", options.sky]
        try:
            done = subprocess.run(
                [str(word) for word in command],
                cwd=ROOT,
                capture_output=True,
                text=True,
                check=False,
                timeout=limit_s,
            )
        except subprocess.TimeoutExpired:
            return row | {"status": f"over {limit_s:g} s"}
        if done.returncode == 0:
            return json.loads(file.read_text(encoding="utf-8"))["rows"][0]
    last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    return row | {"status": f"failed: {last}"}


def rows_of(options):
    """Rows of all that was asked for, one after the other."""
    sky, clock = scenes.Scenes(options.catalogue), scenes.GalSimClock(timer=time.process_time)
    seeds = range(options.seed, options.seed + options.scenes)
    for what, make in {"shared": shared_blends, "own": own_blends}.items():
        scenes.fit(make(sky, (WARM_SEED, WARM_SEED + 1)))
        yield timed(what, make(sky, seeds), clock, options.processes)
    for n_sources in options.blends:
        yield blend_apart(n_sources, options, options.limit)


def main(options):
    threads = on_all_cores()
    if options.scenes is None:
        options.scenes = N_QUICK if options.quick else N_SCENES
    if options.blends is None:
        options.blends = QUICK_BLENDS if options.quick else tuple(BLENDS)
    if options.limit is None:
        options.limit = QUICK_LIMIT_S if options.quick else LIMIT_S
    record = records.record(threads) | {
        "scenes": f"{options.scenes} from seed {options.seed}; "
        + ("a blend alone" if options.blend else scenes.Scenes(options.catalogue).name),
        "settings": "all by default",
        "limits": f"{options.limit:g} s and {options.memory:g} GB for a blend",
    }
    rows = [blend_row(options)] if options.blend else rows_of(options)
    records.show(COLUMNS, rows, record, options.json, below=records.print_stages)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", f"{N_QUICK} scenes, and the smallest blend")
    parser.add_number("scenes", f"how many scenes ({N_SCENES})")
    parser.add_number("processes", "that share the scenes and the device", 1)
    about = f"sources of single large blends ({' '.join(map(str, BLENDS))})"
    parser.add("blends", about, nargs="*", type=int, choices=BLENDS, metavar="N")
    about = "only this blend, in this process"
    parser.add("blend", about, type=int, choices=BLENDS, metavar="N")
    about = f"seconds after which a blend is given up ({LIMIT_S:g})"
    parser.add_number("limit", about, kind=float, metavar="S")
    about = "that the process of a blend may have"
    parser.add_number("memory", about, MEMORY_GB, float, "GB")
    parser.add_sky(("plain", "real"), "galaxies of the single large blends")
    parser.add_seed()
    parser.add_catalogue()
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
