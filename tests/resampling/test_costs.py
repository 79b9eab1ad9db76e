"""What operators and tiles are said to take, against what they take; sizes, groups, warnings."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, affine, distorted, operator, psfs, turn

from clresample.device.tuning import Tuning
from clresample.resampling import plan as plan_module
from clresample.resampling.paper.resampler import PaperResampler
from clresample.resampling.plan import Precision
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.layout import Sizes, window_of
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
    return mapping, mapping.window(low, tuple(map(int, shape)), (0, 0), mapping.shape_out)


def flops_of(plan):
    """Multiplications and additions, in pairs, of one band one way."""
    (ky, ny), (kx, nx), (my, mx) = plan.in_y.shape, plan.in_x.shape, plan.mapping.shape_out
    flops = ny * nx * kx + ny * ky * kx
    if plan.mapping.geometry == "aligned":
        return flops + my * ky * kx + my * mx * kx
    if plan.mapping.geometry == "affine":
        columns = plan.out_x.shape[1]
        return flops + ky * kx * columns + my * ky * columns + my * mx * len(plan.lines.weight[0])
    return flops + my * mx * ky * (kx + 1)


@pytest.mark.parametrize("n_bands", [1, 3])
@pytest.mark.parametrize("geometry", ["aligned", "affine", "distorted"])
def test_tiles_take_what_they_are_said_to(device, geometry, n_bands):
    """Said to be a sixth more arithmetic than is counted at most, and up to half more memory."""
    tuning = replace(Tuning.of(device, np.float32), tile_flops=0.0, pixel_flops=0.0)
    given = PSF.gaussian(BANDS[:n_bands]), PSF.gaussian([b + 0.2 for b in BANDS[:n_bands]])
    sizes = Sizes(tile(geometry, 32)[0], MARGIN, *given, Precision.of(np.float32), tuning)
    for m in (30, 60):
        window = tile(geometry, m)[1]
        op = None  # that of the other size is gone
        gc.collect()
        before = device.in_use
        op = Resampler.from_mapping(window, *given, device=device)
        op.adjoint(op(np.ones(op.shape_in, np.float32)))
        used, plan = device.in_use - before, op.plans[0]
        time, memory = sizes.cost(geometry, m)
        assert 1 <= time / (2 * n_bands * flops_of(plan)) < 1.17
        assert 0.7 < used / memory <= 1
        assert 0.9 < op.n_bytes / used < 1.35
        n_pixels = np.prod(window.shape_in) + m * m
        sizes.tuning = replace(tuning, tile_flops=1e9, pixel_flops=1e3)
        more = sizes.cost(geometry, m)[0] - time - 1e9
        assert more == pytest.approx(1e3 * n_bands * n_pixels, rel=0.05)
        sizes.tuning = tuning


@pytest.mark.parametrize("geometry", ["aligned", "30 degrees", "distorted"])
def test_the_bound_on_tables_counts_what_a_plan_holds(monkeypatch, geometry):
    """And up to 2.7 times as much: the transforms of both PSFs, which are freed again."""
    mapping = GEOMETRIES[geometry]()
    mapping = replace(mapping, shape_in=(310, 260)) if geometry == "aligned" else mapping
    plan = plan_module.make_plan(mapping, *psfs(), precision=Precision.of(np.float32))
    tables = plan.d_plus, plan.d_minus, plan.in_y, plan.in_x
    out = (plan.out_y, plan.out_x) if mapping.geometry != "affine" else ()
    held = sum(table.nbytes for table in (*tables, *out))
    monkeypatch.setattr(plan_module, "MOST_BYTES", 1)
    with pytest.raises(ValueError, match=r"needs tables of \S+ GiB") as error:
        plan_module.make_plan(mapping, *psfs(), precision=Precision.of(np.float32))
    said = float(str(error.value).split("tables of ")[1].split()[0]) * 2**30
    assert 1.15 < said / held < 2.7


def test_a_plan_takes_eight_gib_at_most():
    """Of a WCS that makes the observed pixels a thousandth of the model's."""
    with pytest.raises(ValueError, match=r"GiB, more than 8: is the WCS right"):
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
    with pytest.warns(PSFWarning) as caught:
        Resampler(grid, PSF.gaussian(2.0), grid, PSF.gaussian(0.7), device=device)
    assert {one.filename for one in caught} == {__file__}


def test_the_papers_grid_is_odd_and_no_larger_than_nothing_wraps(device):
    mapping, (psf_in, psf_out) = GEOMETRIES["30 degrees"](), psfs()
    op = PaperResampler.from_mapping(mapping, psf_in, psf_out, device=device)
    radius = wrap_radius(psf_out, mapping.matrix)
    for k, n, r in zip(op.certificate.n_fft, mapping.shape_in, radius, strict=True):
        assert k % 2 == 1 and max(n, r) + r <= k <= max(n, r) + r + 2
