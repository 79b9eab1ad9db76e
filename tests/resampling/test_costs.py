"""Predicted memory of operators and tiles against the measured; sizes, groups, warnings."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, affine, distorted, operator, psfs, turn

from clresample.device.tuning import Tuning
from clresample.paper.operator.resampler import PaperResampler
from clresample.resampling import plan as plan_module
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.layout import SIDES, TileCosts, window_of
from clresample.resampling.transfer import wrap_radius
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning

MARGIN = np.array([14, 14])
BANDS = [0.9, 1.0, 0.8]


def tile(geometry, m):
    """A mapping of m x m observed pixels, and that of a window about them."""
    matrix = turn(0 if geometry == "aligned" else 30, 1.7)
    if geometry != "distorted":
        mapping = affine(matrix, (80, 80), (m, m))
        return mapping, window_of(mapping, MARGIN)
    mapping = distorted(matrix, (80, 80), (m, m))
    low = np.floor(mapping.positions.min(axis=(0, 1))).astype(int) - MARGIN
    shape = np.ceil(mapping.positions.max(axis=(0, 1))).astype(int) + MARGIN - low + 1
    side = int(shape.max())
    return mapping, mapping.window(low, (side, side), (0, 0), mapping.shape_out)


def flops_of(plan):
    """Multiplications and additions, in pairs, of one band one way."""
    (ky, ny), (kx, nx), (my, mx) = plan.in_y.shape, plan.in_x.shape, plan.mapping.shape_out
    flops = ny * nx * kx + ny * ky * kx
    if plan.mapping.geometry == "aligned":
        return flops + my * ky * kx + my * mx * kx
    if plan.mapping.geometry == "affine":
        columns = plan.out_x.shape[1]
        return flops + ky * kx * columns + my * ky * columns + my * mx * len(plan.lines.weight[0])
    (rows, columns), taps = (len(plan.out_y), plan.out_x.shape[1]), plan.points.n_taps
    return flops + rows * ky * kx + rows * columns * kx + my * mx * taps * (taps + 1)


@pytest.mark.parametrize("n_bands", [1, 3])
@pytest.mark.parametrize("geometry", ["aligned", "affine", "distorted"])
def test_tiles_take_what_they_are_said_to(device, as_asked, geometry, n_bands):
    """From its operator's own sides: the bytes that the device counts, and the products of its
    tables. From the sides that are expected of a tile: as much, or up to a sixth more."""
    tuning = replace(Tuning.of(device, np.float32), tile_flops=0.0, pixel_flops=0.0)
    given = PSF.gaussian(BANDS[:n_bands]), PSF.gaussian([b + 0.2 for b in BANDS[:n_bands]])
    sizes = TileCosts(tile(geometry, 32)[0], MARGIN, *given, Precision.of(np.float32), tuning)
    for m in (13, 60):
        window = tile(geometry, m)[1]
        op = None  # that of the other size is gone
        gc.collect()
        before = device.in_use
        plan = make_resampling_plan(window, *given, precision=Precision.of(np.float32))
        op = Resampler.from_plans([plan], device=device)
        op.adjoint(op(np.ones(op.shape_in, np.float32)))
        used = device.in_use - before
        n, k, j = max(window.shape_in), len(plan.in_y), plan.out_x.shape[1]
        time, memory = sizes.account(geometry, m, n, k, j)
        # a plane has as many rows as columns, or some more or fewer
        rel = 1e-9 if geometry != "distorted" else 0.05
        assert time == pytest.approx(2 * n_bands * flops_of(plan), rel=rel)
        if as_asked is None:  # guards of buffers count as memory
            assert memory == pytest.approx(used, rel=max(rel, 2e-3))
            assert 0.9 < op.n_bytes / used < 1.35
        n_most, k_most, j_most = sizes.sides(geometry, m)
        assert n <= n_most <= n + 1
        assert k <= k_most <= 1.05 * k + 4
        assert geometry == "aligned" or j <= j_most <= 1.05 * j + 4
        assert sizes.cost(geometry, m) == sizes.account(geometry, m, n_most, k_most, j_most)
        assert 1 <= sizes.cost(geometry, m)[0] / time < 1.17
        sizes.tuning = replace(tuning, tile_flops=1e9, pixel_flops=1e3)
        more = sizes.account(geometry, m, n, k, j)[0] - time
        assert more == 1e9 + 1e3 * n_bands * (n * n + m * m)
        sizes.tuning = tuning
    doubled = replace(tuning, tile_flops=0.0)
    exact = TileCosts(tile(geometry, 32)[0], MARGIN, *given, Precision.of(np.float64), doubled)
    assert exact.itemsize == 2 * sizes.itemsize


def test_the_quickest_tile_within_the_memory_is_chosen():
    """Of all sides, whatever a tile costs; the tiles of a frame are as equal as can be."""
    assert SIDES[0] == 8 and SIDES[-1] == 16384
    assert (SIDES[1:] / SIDES[:-1]).max() <= 1.25
    sizes = TileCosts.__new__(TileCosts)

    def total(tile, shape, time):
        return np.prod([-(-n // m) for n, m in zip(shape, tile, strict=True)]) * time(max(tile))

    times = (lambda m: 1.0, lambda m: m**2.0, lambda m: 3e4 + m**3.0, lambda m: 1 / m**4)
    for shape in ((100, 37), (37, 100), (1000, 900), (5, 3)):
        tiles = [tuple(-(-n // -(-n // side)) for n in shape) for side in SIDES]
        assert all(max(tile) <= side for tile, side in zip(tiles, SIDES, strict=True))
        for time in times:
            for memory in (8, 30, 61, 1 << 20):
                sizes.cost = lambda geometry, m, time=time: (time(m), m)
                tile = sizes.choose("affine", shape, memory)
                allowed = [t for t in tiles if max(t) <= memory]
                assert tile in allowed
                assert total(tile, shape, time) == min(total(t, shape, time) for t in allowed)
    sizes.cost = lambda geometry, m: (1.0, 1000 + m)
    with pytest.raises(ValueError, match="memory is 900 bytes, but tiles of 8 pixels .* 1008"):
        sizes.choose("affine", (160, 16), 900)


def test_the_bound_on_tables_counts_what_a_plan_holds(monkeypatch):
    """To the byte where all frequencies stay: three times D and, but for lines, the waves.

    Up to 1.3 times as much for distorted pixels, since some of them may lie off the model.
    """
    precision, sample = Precision.of(np.float32), PSF([[1.0]])
    for name, more in (("aligned", 1.0), ("distorted", 1.3)):
        mapping = GEOMETRIES[name]()
        for shape in ((31, 26), (43, 120)):
            mapping = replace(mapping, shape_in=shape)
            plan = plan_module.make_resampling_plan(mapping, sample, sample, precision=precision)
            held = sum(t.nbytes for t in (plan.in_y, plan.in_x, plan.out_y, plan.out_x))
            held += 3 * (plan.d_plus.nbytes + plan.d_minus.nbytes)
            held += 0 if plan.points is None else plan.points.n_bytes
            monkeypatch.setattr(plan_module, "MAX_BYTES", int(more * held))
            plan_module.make_resampling_plan(mapping, sample, sample, precision=precision)
            monkeypatch.setattr(plan_module, "MAX_BYTES", held - 1)
            with pytest.raises(ValueError, match=r"needs tables of \S+ GiB"):
                plan_module.make_resampling_plan(mapping, sample, sample, precision=precision)
            monkeypatch.undo()


def test_the_bound_on_tables_counts_bands_and_lines(monkeypatch):
    """And up to 2.7 times as much: the transforms of both PSFs, which are freed again."""
    plan = plan_module.make_resampling_plan(
        GEOMETRIES["30 degrees"](), *psfs(), precision=Precision.of(np.float32)
    )
    held = sum(table.nbytes for table in (plan.d_plus, plan.d_minus, plan.in_y, plan.in_x))
    monkeypatch.setattr(plan_module, "MAX_BYTES", 1)
    with pytest.raises(ValueError, match=r"needs tables of \S+ GiB") as error:
        plan_module.make_resampling_plan(
            GEOMETRIES["30 degrees"](), *psfs(), precision=Precision.of(np.float32)
        )
    said = float(str(error.value).split("tables of ")[1].split()[0]) * 2**30
    assert 1.15 < said / held < 2.7


def test_a_plan_takes_eight_gib_at_most():
    """Of a WCS that makes the observed pixels a thousandth of the model's."""
    said = r"from \(20000, 20000\) to \(9, 9\) pixels, one 0.001 times .* GiB, more than 8: is the"
    with pytest.raises(ValueError, match=said):
        psf = PSF.gaussian(1.0)
        Resampler(Grid.flat((20000, 20000), 0.1), psf, Grid.flat((9, 9), 1e-4), psf)


@pytest.mark.parametrize("geometry", ["aligned", "30 degrees", "distorted"])
def test_images_go_in_groups_of_which_the_intermediates_are_reused(device, geometry):
    op = operator(device, GEOMETRIES[geometry](), *psfs())
    x = np.random.default_rng(0).normal(size=(5, *op.shape_in)).astype(np.float32)
    together = op(x)
    op._group = 2
    np.testing.assert_array_equal(op(x), together)
    assert op._executor.n_reserved == 2 * op.plans[0].n_bands
    pair = Resampler.from_plans([op.plans[0]] * 2, device=device)
    pair._group = 1  # its items have tables of their own, and go together
    np.testing.assert_array_equal(pair(x[:2]), together[:2])


def test_one_image_at_a_time_where_the_cache_holds_none(device, monkeypatch):
    tuning = Tuning.of(device, np.float32)
    monkeypatch.setattr(Tuning, "of", lambda *_: replace(tuning, group_bytes=1))
    op = operator(device, GEOMETRIES["aligned"](), *psfs())
    assert op._group == 1


def test_warnings_point_at_the_users_line(device):
    """A PSF sharper than the model's: the operator divides by what is next to nothing."""
    grid = Grid.flat((30, 30), 0.1)
    with pytest.warns(PSFWarning, match="spacing"):
        sharp = PSF.gaussian(0.7)  # its samples are coarse, too
    with pytest.warns(PSFWarning) as caught:
        Resampler(grid, PSF.gaussian(2.0), grid, sharp, device=device)
    assert {one.filename for one in caught} == {__file__}


def test_the_papers_grid_is_odd_and_no_larger_than_nothing_wraps(device):
    mapping, (psf_in, psf_out) = GEOMETRIES["30 degrees"](), psfs()
    op = PaperResampler.from_mapping(mapping, psf_in, psf_out, device=device)
    radius = wrap_radius(psf_out, mapping.matrix)
    for k, n, r in zip(op.certificate.n_fft, mapping.shape_in, radius, strict=True):
        assert k % 2 == 1 and max(n, r) + r <= k <= max(n, r) + r + 2
