"""`clresample tune`: the sizes with which this device is quickest, measured and kept."""

from __future__ import annotations

from contextlib import contextmanager

from ..options import add_device_option, print_progress

DESCRIPTION = """\
Measure with which sizes the device is quickest: tiles of the matrix products, images
of one launch, scenes fitted side by side. What gains at least 3 % is kept in the user's
cache folder (or CLRESAMPLE_CACHE) for this device, driver and version, and used from
then on. Results change by rounding alone. It takes a minute or two; the machine should
have nothing else to do."""

# Smallest fraction of the time that a size must save to be stored: less is noise of the clock.
MIN_GAIN = 0.03
# [s] Duration of one measurement; the sizes to compare are measured in turn.
SECONDS, ROUNDS = 0.15, 3
# Number of measurements of the winner against the present size.
DUEL_ROUNDS = 7

# Macros of contract.cl, in float32; VW is halved in float64.
CPU_TILES = [
    {"VW": vector, "NV": vectors, "MR": rows, "WGX": 1, "WGY": 1}
    for vector, vectors, rows in (
        (16, 1, 6), (16, 1, 8), (16, 1, 12), (16, 2, 6), (16, 2, 8),
        (8, 1, 6), (8, 1, 8), (8, 2, 4), (8, 2, 6),
    )
]  # fmt: skip
# Tiles with KB are macros of contract_group.cl, the last one of contract.cl.
GPU_TILES = [
    {"VW": 4, "NV": vectors, "MR": rows, "WGX": wide, "WGY": high, "KB": slab}
    for vectors, rows, wide, high, slab in (
        (2, 8, 8, 8, 8), (2, 8, 8, 8, 16), (1, 8, 16, 8, 16), (2, 8, 16, 8, 16), (2, 8, 8, 16, 16),
        (2, 8, 16, 16, 16), (1, 8, 8, 8, 16), (2, 4, 8, 16, 16), (2, 8, 8, 8, 32),
    )
] + [{"VW": 4, "NV": 1, "MR": 8, "WGX": 8, "WGY": 8}]  # fmt: skip
GROUP_BYTES = {"CPU": (1 << 20, 4 << 20, 16 << 20), "GPU": (64 << 20, 256 << 20, 1 << 30)}
N_SCENES = {"CPU": (8, 16, 32), "GPU": (64, 256, 1024)}


def add_tune(commands):
    """Adds `clresample tune`."""
    parser = commands.add_parser(
        "tune", help="measure and keep the sizes that suit the device", description=DESCRIPTION
    )
    add_device_option(parser)
    parser.add_argument(
        "--clear", action="store_true", help="remove what was kept, measure nothing"
    )
    parser.add_argument("--quick", action="store_true", help="tiles alone, half a minute")
    parser.set_defaults(run=run)


def run(arguments):
    """Measures, stores and reports the gain. Raises OSError if the file cannot be written."""
    from ...device.device import get_device
    from ...device.tuning import PART

    device = get_device(arguments.device)
    if arguments.clear:
        device.remembered.write(PART, {})
        print(f"{device.name}: nothing is kept")
        return
    kept = tuned_sizes(
        device, quick=arguments.quick, note=lambda line: print_progress(arguments, line)
    )
    device.remembered.write(PART, (device.remembered.read(PART) or {}) | {device.kind: kept})
    print(f"kept in {device.remembered.path}")


def tuned_sizes(device, *, quick, note):
    """The best sizes {dtype: {size: value}}; `note` is called with a line for each of them."""
    from tqdm import tqdm

    steps = _steps(device, quick)
    found: dict[str, dict] = {}
    with tqdm(total=sum(len(s[2]) for s in steps), unit="size", leave=False, disable=None) as bar:
        for dtype, name, candidates, work in steps:
            known = found.setdefault(dtype, {})
            best, gain = _best(device, dtype, known, name, candidates, work, bar)
            if best is None:
                note(f"{name}, {dtype}: as before")
                continue
            known |= best
            gained = (
                "the size until now does not run" if gain is None else f"{100 * gain:.0f} % quicker"
            )
            note(f"{name}, {dtype}: {best[name]}, {gained}")
    return found


def _steps(device, quick):
    """Measurements in turn: (dtype, size, [values], function that makes the work)."""
    import numpy as np

    from .measure import ProductTimer
    from .workload import FitWorkload, RenderWorkload

    path = "GPU" if not device_is_cpu(device) else "CPU"
    steps = []
    for dtype in ("float32", "float64") if device.has_fp64 else ("float32",):
        tiles = CPU_TILES if path == "CPU" else GPU_TILES
        if dtype == "float64":
            tiles = [tile | {"VW": tile["VW"] // 2} for tile in tiles]
        tiles = [
            tile for tile in tiles if tile["WGX"] * tile["WGY"] <= device.cl.max_work_group_size
        ]
        steps.append(
            (dtype, "tile", tiles, lambda dtype=dtype: ProductTimer(device, np.dtype(dtype)))
        )
    if not quick:
        steps.append(("float32", "group_bytes", GROUP_BYTES[path], lambda: RenderWorkload(device)))
        fits = FitWorkload(device, max(N_SCENES[path]))
        steps.append(("float32", "n_scenes", N_SCENES[path], lambda: fits))
    return steps


def _best(device, dtype, known, name, candidates, make, bar):
    """The fastest candidate, as {name: value}, and the fraction of the time that it saves.

    (None, 0) if none is sufficiently faster than Tuning's present size. The fraction is None if the
    present size does not run on the device. Raises DeviceError if no size runs.
    """
    from ...device.discovery import DeviceError
    from ...device.tuning import Tuning

    runs, seconds = {}, {}
    with with_sizes(device, dtype, known):
        now = getattr(Tuning.of(device, dtype), name)
    for i, value in enumerate([None, *candidates]):
        if value == now:
            bar.update()
            continue
        sizes = known | ({} if value is None else {name: value})
        if name == "tile" and value is not None:
            sizes["row_choices"] = row_choices(value)
        with with_sizes(device, dtype, sizes):
            try:
                runs[i] = sizes, make()
                _timed(runs[i][1])
            except DeviceError as error:  # too many registers or too much local memory
                runs.pop(i, None)
                failure = error
        bar.update(value is not None)
    if not runs:
        raise DeviceError(f"{device.name}: {name}, {dtype}: no size runs: {failure}") from failure
    for _ in range(ROUNDS):
        for i, (sizes, work) in runs.items():
            with with_sizes(device, dtype, sizes):
                seconds[i] = min(_timed(work), seconds.get(i, float("inf")))
    i = min(seconds, key=seconds.get)
    gain = None
    if 0 in runs:
        gain = _duel(device, dtype, runs[0], runs[i]) if i else 0.0
        if gain < MIN_GAIN:
            return None, 0.0
    names = {name, "row_choices"} if name == "tile" else {name}
    return {n: runs[i][0][n] for n in names}, gain


def _duel(device, dtype, now, better):
    """The fraction of the present sizes' time that the better ones save.

    now, better: (sizes, work), timed alternately. The result is the smaller of the savings in the
    shortest and in the median time. On a machine with other work, the shortest time alone would
    favour a size measured in a quiet moment.
    """
    import numpy as np

    times = np.empty((DUEL_ROUNDS, 2))
    for row in times:
        for i, (sizes, work) in enumerate((now, better)):
            with with_sizes(device, dtype, sizes):
                row[i] = _timed(work)
    return float(min(1 - f(times[:, 1]) / f(times[:, 0]) for f in (np.min, np.median)))


def row_choices(tile):
    """Numbers of rows that `Tuning.tile_for` may choose from; none for tiles without KB."""
    return [tile["MR"] - 2, tile["MR"], tile["MR"] + 2] if "KB" in tile else []


def _timed(work):
    from .measure import best_seconds

    return best_seconds(work, SECONDS, least=1)


@contextmanager
def with_sizes(device, dtype, sizes):
    """Context in which Tuning has exactly these sizes for the device and the type."""
    from ...device.tuning import PART

    before = device.remembered.read(PART)
    device.remembered.override(PART, {device.kind: {dtype: sizes}})
    try:
        yield
    finally:
        device.remembered.override(PART, before)


def device_is_cpu(device):
    """True where kernels are built as for CPUs."""
    from ...device.tuning import Tuning

    return Tuning.untuned(device).row_loops
