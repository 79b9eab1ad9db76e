"""Sizes that were measured and kept: read, checked, and without influence but on the time."""

import warnings
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.products import TILES
from helpers.tuning import tune

from clresample import PSF, DeviceError, Grid, Resampler
from clresample.cli.command import main
from clresample.cli.device_tools import measure, tune as tuner
from clresample.cli.device_tools.bench import largest_batch
from clresample.cli.device_tools.tune import CPU_TILES, GPU_TILES, with_sizes
from clresample.cli.device_tools.workload import FitWorkload
from clresample.device.contraction import round_up_columns
from clresample.device.device_cache import DeviceCache, DeviceWarning
from clresample.device.tuning import PART, Tuning, _cpu_tile, is_tile

TILE = {"VW": 8, "NV": 1, "MR": 4, "WGX": 1, "WGY": 1}
BOTH = ("CPU", "GPU")


@pytest.fixture
def kept(device, tmp_path, monkeypatch):
    """Nothing is kept of the device, in a folder of the test's own."""
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path))
    monkeypatch.setattr(device, "remembered", DeviceCache(device.cl))
    return device.remembered


def render(device):
    op = Resampler(
        Grid.flat((40, 42), 0.1),
        PSF.gaussian(0.8),
        Grid.flat((20, 22), 0.2, angle_deg=20),
        PSF.gaussian([1.5, 1.6]),
        device=device,
    )
    image = np.random.default_rng(2).standard_normal(op.shape_in)
    y = op(image)
    return np.concatenate([y.ravel(), op.adjoint(y).ravel()])


def test_what_was_kept_is_used(device, kept):
    before = Tuning.of(device)
    kept.write(PART, {device.kind: {"float32": {"tile": TILE, "n_scenes": 5}}})
    device.remembered = DeviceCache(device.cl)  # as the next process has it
    tuning = Tuning.of(device)
    assert (tuning.tile, tuning.n_scenes) == (TILE, 5)
    assert tuning.group_bytes == before.group_bytes
    assert Tuning.of(device, np.float64).tile == Tuning.untuned(device, np.float64).tile


def test_results_are_equal_to_rounding_with_other_tiles(device, kept):
    truth = render(device)
    for tile in (CPU_TILES[-1], GPU_TILES[-1]):
        with with_sizes(
            device, "float32", {"tile": tile, "row_choices": [], "group_bytes": 1 << 16}
        ):
            found = render(device)
        assert np.linalg.norm(found - truth) < 1e-6 * np.linalg.norm(truth)
    np.testing.assert_array_equal(render(device), truth)


@pytest.mark.parametrize(
    "content",
    [
        7,
        dict.fromkeys(BOTH, 7),
        dict.fromkeys(BOTH, {"float32": {"tile": TILE | {"MR": 3}}}),
        dict.fromkeys(BOTH, {"float32": {"tile": {"VW": 8}}}),
        dict.fromkeys(BOTH, {"float32": {"n_scenes": "many"}}),
        dict.fromkeys(BOTH, {"float32": {"speed": 9}}),
    ],
    ids=str,
)
def test_sizes_that_are_none_are_ignored_in_one_line(device, kept, content):
    kept.write(PART, content)
    device.remembered = DeviceCache(device.cl)
    with pytest.warns(DeviceWarning, match="is ignored: its sizes are not those") as caught:
        assert Tuning.of(device) == Tuning.untuned(device)
        assert Tuning.of(device) == Tuning.untuned(device)
    assert len(caught) == 1


def test_candidates_build_what_they_say():
    assert all(map(is_tile, [*CPU_TILES, *GPU_TILES]))
    assert all(is_tile(tile | {"VW": tile["VW"] // 2}) for tile in [*CPU_TILES, *GPU_TILES])
    for wrong in ({"MR": 5}, {"VW": 3}, {"KB": 12}, {"WGX": 64, "WGY": 8}, {"NV": 0}, {"NV": True}):
        assert not is_tile(GPU_TILES[0] | wrong)
    assert not is_tile({"VW": 8})


@pytest.mark.parametrize(
    ("name", "n", "vectors"),
    [
        ("AVX2", 114, (2, 8)),  # 7 vectors of 16 and 2 columns
        ("AVX2", 120, (2, 8)),
        ("AVX2", 121, (1, 16)),  # more than half of the last one is full
        ("AVX2", 112, (1, 16)),
        ("AVX2", 130, (1, 16)),  # one of nine
        ("wide CPU", 74, (2, 16)),
        ("wide CPU", 90, (2, 16)),
        ("wide CPU", 114, (2, 16)),
        ("CPU", 114, (1, 8)),
    ],
)
def test_columns_choose_the_vectors_of_a_tile(device, monkeypatch, name, n, vectors):
    tune(monkeypatch, tile=TILES[name])
    tile = Tuning.of(device).tile_for_columns(n, round_up_columns(n))
    assert (tile["NV"], tile["VW"]) == vectors
    rows = {5: 4}.get(tile["NV"], TILES[name]["MR"])
    assert tile == TILES[name] | {"NV": vectors[0], "VW": vectors[1], "MR": rows}


@pytest.mark.parametrize(
    ("width", "version", "rows", "vectors"),
    [
        (16, "OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-skylake-avx512", 8, 2),
        (16, "OpenCL 3.0 PoCL HSTR: cpu-x86_64-pc-linux-gnu-znver5", 8, 2),
        (16, "OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-znver3", 6, 1),
        (8, "OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-skylake", 6, 1),
        (16, "OpenCL 3.1 (Build 0)", 8, 2),  # Intel's runtime
    ],
)
def test_cpus_with_registers_of_avx512_use_them(width, version, rows, vectors):
    """PoCL reports vectors of 16 on AMD's processors, whatever its compiler makes for them."""
    cl = Mock(native_vector_width_float=width, version=version)
    device = Mock(cl=cl)
    tile = _cpu_tile(device, np.dtype(np.float32))
    assert (tile["MR"], tile["NV"]) == (rows, vectors)


@pytest.mark.parametrize("rows", [1, 47, 48, 49, 60, 74, 118, 132, 1000])
def test_groups_cover_matrices_with_little_waste(device, monkeypatch, rows):
    monkeypatch.setattr(device, "kind", "GPU")
    tuning = Tuning.untuned(device)
    tile = tuning.tile_for(rows)
    group = tile["MR"] * tile["WGY"]
    covered = -(-rows // group) * group
    assert covered == min(-(-rows // (n * 8)) * n * 8 for n in tuning.row_choices)
    assert covered <= max(48, 1.35 * rows)


def test_the_quickest_is_kept_and_said(device, kept, monkeypatch):
    """Tiles of four rows take half the time of all others."""

    class Work:
        def __init__(self, *_):
            self.rows = Tuning.of(device).tile["MR"]

    monkeypatch.setattr(measure, "ProductTimer", Work)
    monkeypatch.setattr(tuner, "_timed", lambda work: 1.0 if work.rows == 4 else 2.0)
    for tiles in ("CPU_TILES", "GPU_TILES"):
        monkeypatch.setattr(tuner, tiles, [TILE | {"MR": 2}, TILE, TILE | {"MR": 6}])
    lines = []
    found = tuner.tuned_sizes(device, quick=True, note=lines.append)
    assert found["float32"]["tile"] == TILE
    assert lines[0].startswith("tile, float32: {") and lines[0].endswith("50 % quicker")


def test_one_that_is_not_quicker_is_not_kept(device, kept, monkeypatch):
    monkeypatch.setattr(measure, "ProductTimer", lambda *_: None)
    monkeypatch.setattr(tuner, "_timed", lambda work: 1.0)
    lines = []
    found = tuner.tuned_sizes(device, quick=True, note=lines.append)
    assert not any(found.values())
    assert lines and all(line.endswith(": as before") for line in lines)


@pytest.mark.parametrize("runs", ["candidates", "none"])
def test_sizes_that_do_not_run_are_no_choice(device, kept, monkeypatch, runs):
    """The size until now is replaced where it does not run; where none runs, that is the error."""

    class Work:
        def __init__(self, device, dtype):
            if runs == "none" or Tuning.of(device, dtype).tile["MR"] != 4:
                raise DeviceError("too many registers")

    monkeypatch.setattr(measure, "ProductTimer", Work)
    monkeypatch.setattr(tuner, "_timed", lambda work: 1.0)
    for tiles in ("CPU_TILES", "GPU_TILES"):
        monkeypatch.setattr(tuner, tiles, [TILE | {"MR": 2}, TILE])
    lines = []
    if runs == "none":
        with pytest.raises(DeviceError, match="tile, float32: no size runs: too many registers"):
            tuner.tuned_sizes(device, quick=True, note=lines.append)
        return
    found = tuner.tuned_sizes(device, quick=True, note=lines.append)
    assert found["float32"]["tile"] == TILE
    assert lines[0].endswith("}, the size until now does not run")


def test_iterations_start_anew_each_time(device, kept):
    work = FitWorkload(device, 3)
    work()
    work()
    assert all(fit.losses == [] for fit in work.fits)


def test_rates_are_those_of_the_device(device, kept):
    products = measure.ProductTimer(device, shapes=(((20, 20, 20), 2),))
    assert products.flops == 2 * 20**3 * 2
    assert 1e5 < products.rate(0.01) < 1e15
    assert 1e-8 < measure.launch_seconds(device, 0.01) < 0.1
    assert measure.peak_flops(device) is None or device.kind == "GPU"


@pytest.mark.parametrize(
    "first, fixed, each, n_most, tried",
    [
        (0.0, 0.0, 0.7, 32, [1, 3]),  # two cores
        (0.0, 0.0, 0.1, 32, [1, 3, 24]),
        (0.0, 0.5, 1e-4, 1024, [1, 3, 23, 184, 1024]),  # a GPU, which waits for launches
        (0.0, 0.0, 1e-4, 2, [1, 2]),
        (0.0, 0.0, 1e-4, 1, [1]),
        (3.0, 0.0, 0.1, 32, [1]),  # kernels were built
        (2.0, 0.0, 0.5, 32, [1]),
        (0.0, 0.0, 9.0, 32, [1]),
    ],
)
def test_as_many_are_fitted_as_the_time_allows(first, fixed, each, n_most, tried):
    now, seen = 0.0, []

    def seconds_of(n):
        nonlocal now
        took = fixed + each * n + first * (not seen)
        now += took
        seen.append(n)
        return took

    assert largest_batch(seconds_of, n_most, 5.0, lambda: now)[0] == tried[-1]
    assert seen == tried
    assert now < 5.0 or tried == [1]


class Gpu:
    """The attributes of an H100 that `peak_flops` reads."""

    kind, simulated, compute_units = "GPU", False, 132

    class cl:
        vendor, max_clock_frequency = "NVIDIA Corporation", 1980
        compute_capability_major_nv, compute_capability_minor_nv = 9, 0


def test_the_peak_of_a_gpu_is_the_one_that_its_maker_gives():
    assert measure.peak_flops(Gpu) == pytest.approx(66.9e12, rel=1e-3)


def test_a_folder_that_cannot_be_written_is_said(device, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CLRESAMPLE_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(device, "remembered", DeviceCache(device.cl))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeviceWarning)
        assert main(["tune", "--clear", "--device", device.name]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
