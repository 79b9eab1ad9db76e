"""Rules that operators are made by, each by itself: bands, sizes, windows, tapers, coverage."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.geometries import (
    GEOMETRIES,
    ONE_OF_EACH,
    affine,
    distance,
    operator,
    psfs,
    sky_grid,
    turn,
)
from helpers.tuning import tune

from clresample.device.tuning import Tuning
from clresample.resampling import resampler as resampler_module
from clresample.resampling.cache import OperatorCache
from clresample.resampling.gridding import transpose_taps
from clresample.resampling.paper.resampler import PaperResampler
from clresample.resampling.paper.slabs import cut
from clresample.resampling.paper.tables import trigonometric, wave
from clresample.resampling.plan import Precision, _half_count, _odd, is_identity, make_plan
from clresample.resampling.reference import otf_ratio
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.layout import Sizes, _taper, make_groups, window_of
from clresample.resampling.tiled.resampler import TiledResampler
from clresample.resampling.transfer import light_reach, wrap_radius
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

pytestmark = pytest.mark.filterwarnings("ignore::clresample.sky.psf_checks.PSFWarning")
WINDOWS = [Precision.of(dtype).window for dtype in (np.float32, np.float64)]
WINDOW_ERRORS = 6e-7, 4e-14


def small_psf(shape=(3, 5)):
    """A PSF that is its whole image."""
    return PSF(np.ones(shape) / np.prod(shape))


# --- what a plan holds ---


def test_an_operator_is_the_identity_only_where_everything_is_the_same():
    same = affine(np.eye(2), (9, 8), (9, 8), shift=(0, 0))
    psf = PSF.gaussian(1.0, n_pixels=9)
    other = PSF.gaussian(1.1, n_pixels=9)
    assert is_identity(same, psf, PSF.gaussian(1.0, n_pixels=9))
    for mapping, psf_out in (
        (replace(same, geometry="affine"), psf),
        (replace(same, shape_out=(8, 8)), psf),
        (replace(same, matrix=np.diag([1.0, -1.0])), psf),
        (replace(same, offset=np.array([0.0, 1.0])), psf),
        (same, other),
        (same, PSF(psf.images, spacing=0.5)),
        (same, PSF(psf.images, center=(4.0, 4.5))),
        (same, PSF.gaussian(1.0, n_pixels=11)),
    ):
        assert not is_identity(mapping, psf, psf_out)
    precision = Precision.of(np.float32)
    assert make_plan(same, psf, psf, precision=precision).identity
    both = PSF(np.repeat(psf.images, 2, axis=0))
    assert not make_plan(same, psf, both, precision=precision, n_terms=2).identity


def test_padded_lengths_are_odd():
    assert [_odd(x) for x in (0.2, 1, 1.5, 2, 3, 3.01, 20.0)] == [1, 1, 3, 3, 3, 5, 21]


def test_frequencies_are_those_that_the_observed_samples_can_hold():
    """On each axis up to the farthest corner of the parallelogram |A^T nu| <= 1 / (2 spacing), or
    to the model's own end."""
    for matrix, spacing, n_fft in (
        (turn(0, 3.0), 1.0, 61),
        (turn(30, 3.0), 1.0, 61),
        (np.array([[4.0, 1.3], [0.2, 5.0]]), 0.5, 83),
        (turn(0, 0.5), 1.0, 61),
        (turn(0, 4.0), 1.0, 81),  # 10 frequencies of 1 / 81, and 0: one lies just inside
    ):
        ends = [np.linalg.solve(matrix.T, end) / (2 * spacing) for end in product((-1, 1), (-1, 1))]
        for axis in (0, 1):
            reach = max(end[axis] for end in ends)
            inside = [k for k in range((n_fft + 1) // 2) if k / n_fft <= reach * (1 + 1e-9)]
            assert _half_count(matrix, spacing, axis, n_fft) == len(inside)


def test_no_frequency_is_summed_that_holds_nothing():
    """The last row and column of D hold something, the certificate says how many there are."""
    for name in ONE_OF_EACH:
        plan = make_plan(GEOMETRIES[name](), *psfs(), precision=Precision.of(np.float32))
        d = np.abs(plan.d_plus) + np.abs(plan.d_minus)
        assert d[:, -1].any() and d[:, :, -1].any()
        n_frequencies = plan.certificate.n_frequencies
        assert d.shape[1:] == tuple(n_frequencies[axis] for axis in plan.axes)
        assert [len(nu) for nu in plan.nu] == list(d.shape[1:])
        # and what was left out is under the tolerance: float64's plan has it
        more = make_plan(GEOMETRIES[name](), *psfs(), precision=Precision.of(np.float64))
        if plan.geometry == "affine":  # where D also holds the window's transform
            continue
        few, many = (np.stack([p.d_plus, p.d_minus]) for p in (plan, more))
        for both in (few, many):  # half the weight of frequencies that are 0
            both[:, :, 0] *= 2
            both[:, :, :, 0] *= 2
        peak = np.abs(many).max(axis=(0, 2, 3))[:, None, None]
        near, kept = many[:, :, : d.shape[1], : d.shape[2]], few != 0
        assert (np.abs(few) > 2.999e-8 * peak)[kept].all()
        # outer samples of the PSFs are left out
        assert (np.abs(few - near) < 1e-9 * peak)[kept].all()
        near[kept] = 0
        assert (np.abs(many) < 3.001e-8 * peak).all()


def test_lengths_leave_room_for_all_that_the_light_reaches():
    """K is the smallest odd number over the model's extent and the wrap radius; of a window with
    what its pixels may be off, half an observed one."""
    skew = np.array([[1.7, -0.9], [0.4, 2.6]])
    plan = make_plan(affine(skew, (60, 67)), *psfs(), precision=Precision.of(np.float32))
    for k, n, r in zip(plan.certificate.n_fft, (60, 67), wrap_radius(psfs()[1], skew), strict=True):
        assert k % 2 == 1 and 0 <= k - n - r < 2
    assert plan.certificate.wrap_radius_px == wrap_radius(psfs()[1], skew)
    window = plan.window((8, 13), 6.0, Precision.of(np.float32))
    corners = np.array(list(product((-0.5, 0.5), (-0.5, 0.5))))
    off = (corners @ skew.T).max(axis=0)
    for axis in (0, 1):
        need = (8, 13)[axis] + window.mapping.reach_px + off[axis]
        need += window.certificate.wrap_radius_px[axis]
        assert 0 <= window.certificate.n_fft[axis] - need < 2


def test_an_interruption_leaves_nothing_half_done(device, monkeypatch):
    """Of one image of one band, the fewest there can be."""
    op = operator(device, GEOMETRIES["30 degrees"](), PSF.gaussian(0.8), PSF.gaussian(1.5))
    x, executor = np.ones(op.shape_in, np.float32), op._executor
    with monkeypatch.context() as patch:

        def interrupted():
            raise KeyboardInterrupt

        patch.setattr(executor, "bind", interrupted)
        with pytest.raises(KeyboardInterrupt):
            op(x)
    again = operator(device, GEOMETRIES["30 degrees"](), PSF.gaussian(0.8), PSF.gaussian(1.5))
    np.testing.assert_array_equal(op(x), again(x))
    apart = op.executor()
    assert apart.n_reserved == 0 and not apart.scratch
    apart.reserve(1)
    assert apart.scratch and apart.scratch["half"] is not executor.scratch["half"]


def test_sums_over_pixels_go_inward_and_those_over_frequencies_down(device, monkeypatch):
    """As kernels/contract.h orders terms: from the smallest on."""
    from clresample.device.contraction import Contraction

    bind, seen = Contraction.bind, []

    def noted(self, m, n, k, *others, inward=True, **given):
        seen.append((k, inward))
        return bind(self, m, n, k, *others, inward=inward, **given)

    monkeypatch.setattr(Contraction, "bind", noted)
    for name in ("aligned", "crossed", "30 degrees", "distorted"):
        op = operator(device, GEOMETRIES[name](), *psfs())
        op(np.ones(op.shape_in, np.float32))
        e = op._executor
        frequencies, pixels = {e.k_y, e.k_x}, {e.n_y, e.n_x, e.n_rows, op.shape_out[2]}
        assert not frequencies & pixels
        assert {k for k, _ in seen} <= frequencies | pixels | {getattr(e, "n_columns", 0)}
        assert all(inward == (k not in frequencies) for k, inward in seen)
        seen.clear()


@pytest.mark.parametrize("kind", [Resampler, TiledResampler])
def test_defaults_of_operators(device, kind):
    """No shift, and a ten-thousandth of a pixel: bent pixels are distorted ones."""
    psf = PSF.gaussian(1.0, n_pixels=15)
    bent = sky_grid((40, 38), 0.2, sip=2e-4)
    op = kind(sky_grid((80, 76), 0.1), psf, bent, psf, device=device)
    assert op.geometry == "distorted" and not op.shift.any()
    loose = kind(sky_grid((80, 76), 0.1), psf, bent, psf, device=device, tolerance_px=5.0)
    assert loose.geometry != "distorted"
    mapping = affine(turn(30), (20, 20), (8, 8))
    op = Resampler.from_mapping(mapping, psf, psf, device=device)
    assert not op.shift.any()
    assert not Resampler.from_plans(op.plans, device=device).shift.any()


def test_an_operator_holds_each_table_twice(device):
    """In float32 as much as the plan has in float64; then what its calls need, to the byte."""
    for name in ("aligned", "30 degrees", "distorted"):
        op = operator(device, GEOMETRIES[name](), *psfs())
        assert op.n_bytes == op.plans[0].n_bytes
        n_bytes, in_use = op.n_bytes, device.in_use
        op.adjoint(op(np.ones((3, *op.shape_in), np.float32)))
        assert op.n_bytes - n_bytes == device.in_use - in_use
    if device.has_fp64:
        exact = Resampler.from_plans(op.plans, dtype=np.float64, device=device)
        assert exact.n_bytes == 2 * op.plans[0].n_bytes


@pytest.mark.parametrize("n_terms", [1, 3])
def test_as_many_images_go_together_as_the_cache_holds(device, monkeypatch, n_terms):
    plan = make_plan(
        GEOMETRIES["30 degrees"](),
        PSF.gaussian(0.8, n_pixels=15),
        PSF.gaussian(np.linspace(1.4, 2.0, 2 * n_terms)),
        precision=Precision.of(np.float32),
        n_terms=n_terms,
    )
    for images in (2, 5):
        op = Resampler.from_plans([plan], device=device)
        op._executor.reserve(2)  # an image of two bands
        one = sum(array.nbytes for array in op._executor.scratch.values())
        for less, group in ((0, images), (1, images - 1)):
            tune(monkeypatch, group_bytes=images * one - less)
            assert Resampler.from_plans([plan], device=device)._group == group
            monkeypatch.undo()
    monkeypatch.setattr(resampler_module, "MOST_GROUPS", 4 * 2 * n_terms + 1)
    assert Resampler.from_plans([plan], device=device)._group <= 4
    assert Tuning.of(device, np.float32).group_bytes > 5 * one


def test_every_item_is_rendered_with_its_own_tables(device):
    plans = [
        make_plan(affine(turn(angle, scale)), *psfs(), precision=Precision.of(np.float32))
        for angle, scale in ((10, 2.0), (25, 0.8), (-20, 3.0))
    ]
    op = Resampler.from_plans(plans, device=device)
    x = np.random.default_rng(3).normal(size=(3, *op.shape_in[1:])).astype(np.float32)
    np.testing.assert_array_equal(op.render(x), op(np.repeat(x[:, None], 2, axis=1)))
    np.testing.assert_array_equal(
        op.render(x)[1], Resampler.from_plans(plans, device=device).render(x)[1]
    )
    with pytest.raises(ValueError, match="batch has 2 items, the operator 3 plans"):
        op.render(x[:2])


def test_the_oracle_takes_odd_lengths_alone():
    psf = PSF.gaussian(1.0, n_pixels=9)
    for n_fft in ((8, 9), (9, 8), (8, 8)):
        with pytest.raises(ValueError, match=r"n_fft is \(\d, \d\), both must be odd"):
            otf_ratio(np.eye(2), psf, psf, n_fft)
    nu_y, nu_x, d = otf_ratio(np.eye(2), psf, psf, (9, 7))
    np.testing.assert_allclose(nu_y, np.arange(-4, 5) / 9)
    np.testing.assert_allclose(nu_x, np.arange(-3, 4) / 7)
    np.testing.assert_allclose(d, 1)


def test_caches_hold_hundreds_of_plans_unless_told_otherwise():
    """Plans of 0.1 to 4 MB, operators of twice that."""
    cache = OperatorCache()
    assert 128 * 4e6 <= cache.plan_bytes <= 1e9
    assert 256 * 1e6 <= cache.device_bytes <= 4e8


def test_a_caches_operators_are_shared_and_of_one_term(device):
    cache, home = OperatorCache(), Frame(Grid.flat((20, 21), 0.1), PSF.gaussian(0.8, n_pixels=15))
    given = home, Grid.flat((9, 10), 0.2), PSF.gaussian([1.0, 1.2], n_pixels=15)
    op = cache.resampler(*given, dtype=np.float32, device=device)
    assert cache.resampler(*given, dtype=np.float32, device=device) is op
    assert op.n_terms == 1 and op.shape_in == (2, 20, 21)


# --- how far light reaches ---


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_reach_of_a_gaussians_light(tolerance):
    psf = PSF.gaussian(1.5, n_pixels=41, pixel=False)
    reach = 1.5 * np.sqrt(2 * np.log(1 / tolerance))
    for matrix, factor in ((np.diag([2.0, 0.5]), 2), (np.array([[0.0, 1.0], [3.0, 0.0]]), 3)):
        assert light_reach(psf, matrix, tolerance) == pytest.approx(factor * reach, abs=1.1)
    # of the brighter and the wider of two bands the wider counts
    both = PSF.gaussian([1.5, 1.0], n_pixels=41, pixel=False)
    assert light_reach(both, np.eye(2), tolerance) == light_reach(psf, np.eye(2), tolerance)


def test_reach_ends_with_a_small_image():
    """Half a sample beyond the last ones along an axis, or where its corner lies, if nearer."""
    psf = small_psf()
    corner = np.hypot(1, 2)
    assert light_reach(psf, np.eye(2), 1e-5) == pytest.approx(corner)
    assert light_reach(psf, np.diag([1.0, 3.0]), 1e-5) == pytest.approx(3 * corner)
    assert light_reach(psf, np.diag([3.0, 1.0]), 1e-5) == pytest.approx(4.5)
    assert wrap_radius(psf, np.diag([3.0, 1.0])) == pytest.approx((4.5, 2.5))
    half = PSF(psf.images, spacing=0.5)
    assert light_reach(half, np.eye(2), 1e-5) == pytest.approx(corner / 2)
    assert wrap_radius(half, np.eye(2)) == pytest.approx((0.75, 1.25))


def test_the_wrap_radius_is_half_as_far_again_as_the_light():
    psf = PSF.gaussian(2.0, n_pixels=81, spacing=0.5, pixel=False)
    for radius in wrap_radius(psf, np.eye(2)):
        assert radius == pytest.approx(1.5 * light_reach(psf, np.eye(2), 1e-5) + 0.5)


# --- lines ---


@pytest.mark.parametrize("window", WINDOWS, ids=["float32", "float64"])
def test_taps_are_the_window_and_its_transform_is_the_integral(window):
    half = window.n_taps / 2
    fraction = np.array([1e-9, 0.1, 0.5, 0.77, 1 - 1e-9])
    wanted = window(fraction[:, None] + half - 1 - np.arange(window.n_taps))
    np.testing.assert_allclose(window.taps(fraction), wanted, atol=3e-14)
    assert window(0.0) == 1
    np.testing.assert_array_equal(window(np.array([-half, half, half + 0.1])), 0)
    u = (np.arange(4000) + 0.5) / 4000 * window.n_taps - half
    for f in np.array([0.0, 0.1, 1 / (2 * window.oversampling)]):
        integral = (window(u) * np.cos(2 * np.pi * f * u)).mean() * window.n_taps
        assert window.transform(f) == pytest.approx(integral, rel=1e-5)


@pytest.mark.parametrize("window", WINDOWS, ids=["float32", "float64"])
def test_waves_are_interpolated_as_well_as_is_said(window):
    """At the band's end, and better inside; beyond it the error is many times larger."""
    b = np.pi * window.n_taps * np.sqrt(1 - 1 / window.oversampling)
    said, rounding = 2 * b * np.exp(-b), 4e-14
    assert 0.5 < said / WINDOW_ERRORS[WINDOWS.index(window)] < 1
    n_taps, place = window.n_taps, np.random.default_rng(0).uniform(20, 30, 200)
    first = np.floor(place - n_taps / 2).astype(int) + 1
    column = first[:, None] + np.arange(n_taps)
    weight = window(place[:, None] - column)
    errors = []
    for share in (0.5, 1.0, 1.5):
        f = np.float64(share / (2 * window.oversampling))
        found = (weight * np.exp(2j * np.pi * f * column)).sum(axis=1) / window.transform(f)
        errors.append(np.abs(found - np.exp(2j * np.pi * f * place)).max())
    assert errors[0] < 0.1 * said + rounding
    assert 0.5 * said < errors[1] < 1.5 * said + rounding
    assert errors[2] > 30 * said


def test_columns_are_as_far_apart_as_the_band_allows():
    """Along a line the waves have frequencies nu_x + r nu_y, of which the corners hold nothing."""
    for name in ("30 degrees", "60 degrees", "shear along y"):
        mapping, precision = GEOMETRIES[name](), Precision.of(np.float32)
        plan = make_plan(mapping, *psfs(), precision=precision)
        r = np.divide(*mapping.matrix[:, 1 if plan.lines.by_row else 0])
        along = [r * plan.nu[0][:, None] + sign * plan.nu[1] for sign in (1, -1)]
        lit = [np.abs(d).any(axis=0) for d in (plan.d_plus, plan.d_minus)]
        most = max(np.abs(f[on]).max() for f, on in zip(along, lit, strict=True))
        assert most < 0.6 * np.abs(along).max()
        turned = plan.out_x[2] + 1j * plan.out_x[3]  # the first frequency over 0
        step = np.angle(turned[1:] / turned[:-1]) / (2 * np.pi * plan.nu[1][1])
        np.testing.assert_allclose(step, 1 / (2 * most * precision.window.oversampling), rtol=1e-9)


def test_lines_read_the_other_way_are_the_transpose():
    """Of any coverage: lines without a pixel, a pixel alone, columns that none feeds."""
    rng, n_columns, n_taps = np.random.default_rng(1), 23, 4
    for n_lines, n_steps, share in ((5, 7, 0.6), (3, 1, 1.0), (1, 9, 1.0), (4, 6, 0.1)):
        start = np.sort(rng.integers(0, n_columns - n_taps + 1, (n_lines, n_steps)), axis=1)
        covered = rng.uniform(size=start.shape) <= share
        covered[0, 0] = True
        weight = rng.normal(size=(*start.shape, n_taps)) * covered[..., None]
        first, back = transpose_taps(start, weight, covered, n_columns)
        n_back = back.shape[1]
        assert first.min() >= 0 and first.max() + n_back <= n_steps
        for line in range(n_lines):
            forward, backward = np.zeros((n_steps, n_columns)), np.zeros((n_columns, n_steps))
            for q, t in np.ndindex(n_steps, n_taps):
                forward[q, start[line, q] + t] += weight[line, q, t]
            for j, t in np.ndindex(n_columns, n_back):
                backward[j, first[line, j] + t] += back[line, t, j]
            np.testing.assert_array_equal(backward.T, forward)
        # as few taps as the busiest column needs
        used = [np.flatnonzero(column) for line in back.swapaxes(1, 2) for column in line]
        assert max((ends[-1] for ends in used if len(ends)), default=0) == n_back - 1


# --- tiles ---


def test_a_taper_is_one_inside_and_falls_smoothly_to_zero():
    y, x = _taper((40, 61), (8.0, 20.0))
    assert (y.shape, x.shape) == ((40,), (61,))
    for taper, width in ((y, 8), (x, 20)):
        np.testing.assert_array_equal(taper, taper[::-1])
        np.testing.assert_array_equal(taper[width:-width], 1)
        edge = taper[:width]
        assert (np.diff(edge) > 0).all() and 0 < edge[0] < 1e-2
        np.testing.assert_allclose(edge + edge[::-1], 1)  # about the middle of its width
        # smooth to order 3: it begins as the fourth power, 35 of it
        u = (np.arange(2) + 0.5) / width
        np.testing.assert_allclose(edge[:2], 35 * u**4, rtol=0.5)


def test_a_window_leaves_its_margin_and_half_a_pixel():
    for name, margin in (("30 degrees", (5, 9)), ("mirrored", (3, 3)), ("oblong pixels", (7, 4))):
        mapping = GEOMETRIES[name]()
        window = window_of(mapping, np.array(margin))
        places = window.at(*np.indices(window.shape_out)).reshape(-1, 2)
        low, high = places.min(axis=0), places.max(axis=0)
        assert (low >= np.array(margin) + 0.5 - 1e-9).all()
        np.testing.assert_allclose(low, np.array(window.shape_in) - 1 - high)  # in the middle
        assert (low <= np.array(margin) + 1.0).all()


def groups_of(device, grid_in, psf_in, grid_out, psf_out, *, memory, tolerance_px=1e-4):
    return make_groups(
        grid_in,
        psf_in,
        grid_out,
        psf_out,
        precision=Precision.of(np.float32),
        tolerance_px=tolerance_px,
        tuning=replace(Tuning.of(device, np.float32), tile_flops=0.0, pixel_flops=0.0),
        memory=memory,
    )


def check_groups(groups, grid_in, grid_out, psf_out, tolerance_px):
    """Windows that reach half the wrap radius, or more, beyond their tiles before they fall off
    over as much, or 24 px; pixels within the tolerance of where they are; each given once."""
    given = np.zeros(grid_out.shape, int)
    for group in groups:
        mapping = group.mapping
        radius = np.array(wrap_radius(psf_out, mapping.matrix))
        margin = radius / 2 + np.maximum(radius / 2, 24)
        margins = [np.ceil(margin * off) for off in (0.998, 1, 1.002)]  # bent scales differ
        places = mapping.at(*np.indices(mapping.shape_out))
        inside, shift = places.reshape(-1, 2), 0.5
        if mapping.geometry == "distorted":  # of that one tile, as far as there is a model
            tile = grid_out.cutout(*group.tiles[0].origin, mapping.shape_out)
            inside, shift = places[tile.map_to(grid_in, 0.0).covered], 0.0
        for axis, taper in enumerate(group.taper):
            x = np.arange(len(taper))
            low, high = inside[:, axis].min(), inside[:, axis].max()
            for beyond in (low, len(taper) - 1 - high):
                rest = [beyond - n[axis] - shift for n in margins]
                assert any(-1e-6 <= x < (0.5 if shift else 1) + 1e-6 for x in rest)
            away = np.maximum(low - x, x - high)
            assert (taper[away <= radius[axis] / 2] > 1 - 1e-6).all()
            middle = away[np.abs(taper - 0.5).argmin()] - shift
            wanted = (radius[axis] / 2 + margin[axis]) / 2
            assert abs(middle - wanted) < 1.6
        for tile in group.tiles:
            (y, x), shape = tile.origin, tile.mask.shape
            given[y : y + shape[0], x : x + shape[1]] += tile.mask
            true = grid_out.cutout(y, x, shape).map_to(grid_in, 0.0)
            true = true.at(*np.indices(shape))
            off = np.hypot(*(places + tile.place - true)[tile.mask].T)
            assert off.max() <= tolerance_px + 1e-9
    np.testing.assert_array_equal(given, grid_out.map_to(grid_in).covered)


def test_tiles_of_flat_frames(device):
    grid_in = Grid.flat((200, 190), 0.1)
    for sigma, angle in ((1.2, 20), (6.0, 0), (1.2, 90)):  # 6: radius wider than twice the taper
        grid_out = Grid.flat((90, 95), 0.2, angle_deg=angle)
        psf_in, psf_out = PSF.gaussian(1.5, n_pixels=25), PSF.gaussian(sigma, n_pixels=65)
        groups = groups_of(device, grid_in, psf_in, grid_out, psf_out, memory=3 << 20)
        assert len(groups) == 1 and (angle != 20 or len(groups[0].tiles) > 1)
        check_groups(groups, grid_in, grid_out, psf_out, 1e-6)


@pytest.mark.parametrize("sip, angle", [(2e-7, 0), (5e-8, 30), (5e-5, 10)])
def test_tiles_of_bent_frames(device, sip, angle):
    """Some tiles aligned and some affine; all of them affine; all of them distorted."""
    grid_in, grid_out = sky_grid((150, 140), 0.1), sky_grid((120, 130), 0.12, angle, sip=sip)
    psf_in, psf_out = PSF.gaussian(1.5, n_pixels=25), PSF.gaussian(1.4, n_pixels=25)
    groups = groups_of(device, grid_in, psf_in, grid_out, psf_out, memory=1 << 20)
    kinds = {group.mapping.geometry for group in groups}
    n_tiles = sum(len(group.tiles) for group in groups)
    if sip == 5e-5:
        assert kinds == {"distorted"} and len(groups) == n_tiles
    else:
        assert kinds == ({"affine"} if angle else {"aligned", "affine"})
        assert 1 < len(groups) < n_tiles
    check_groups(groups, grid_in, grid_out, psf_out, 1e-4)


def test_sides_are_the_longer_ones():
    """Of windows, lengths and lines of pixels that are not square, at most by a few per cent."""
    given, precision = (PSF.gaussian(0.9), PSF.gaussian([1.1, 1.3])), Precision.of(np.float32)
    for matrix in ([[0.5, 0.1], [0.3, 3.0]], [[2.4, 0.3], [0.2, 0.7]], [[1.0, 2.5], [-1.2, 0.4]]):
        for margin in ((14, 30), (30, 14)):
            trial = affine(matrix, (90, 90), (32, 32))
            sizes = Sizes(trial, np.array(margin), *given, precision, SimpleNamespace())
            for m in (12, 60, 100):
                window = window_of(affine(matrix, (90, 90), (m, m)), np.array(margin))
                plan = make_plan(window, *given, precision=precision)
                n, k, j = sizes.sides(m)
                assert n >= max(window.shape_in)
                assert k >= max(len(plan.in_y), len(plan.in_x))
                assert j >= plan.out_x.shape[1]


# --- the paper's scheme ---


def test_slabs_take_every_unit_once_and_are_alike():
    for n_units, unit_rows, n_slabs, chunk in ((17, 6, 4, 10), (5, 3, 9, 100), (8, 2, 1, 3)):
        slabs = cut(n_units, unit_rows, n_slabs, chunk)
        assert len(slabs) == min(n_slabs, n_units)
        assert [s.first for s in slabs] == list(np.cumsum([0, *(s.n_units for s in slabs)])[:-1])
        assert sum(s.n_units for s in slabs) == n_units
        assert max(s.n_units for s in slabs) - min(s.n_units for s in slabs) <= 1
        for s in slabs:
            rows = s.n_units * unit_rows
            assert s.chunk <= chunk and s.n_chunks == -(-rows // chunk)
            assert rows <= s.n_rows == s.n_chunks * s.chunk < rows + s.n_chunks


def test_waves_of_the_papers_scheme():
    k, x = 9, np.array([0.3, -2.7, 1000.25])
    planes = wave(k, x, 8)
    angle = 2 * np.pi * np.arange(5)[:, None] * x / k
    np.testing.assert_allclose(planes[:, 0, :3], np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(planes[:, 1, :3], np.sin(angle), atol=1e-12)
    assert not planes[:, :, 3:].any()
    angle = 2 * np.pi * np.arange(6)[:, None] * np.arange(5) / k
    table = trigonometric(6, k)
    assert table.shape == (6, 10)
    assert distance(table[:, 0::2], np.cos(angle)) < 1e-15 * 10
    np.testing.assert_allclose(table[:, 1::2], np.sin(angle), atol=1e-14)


def test_slabs_fit_the_cache_and_the_largest_buffer(device, monkeypatch):
    """But for a unit by which they may differ; they are no more than that takes. As many images go
    together as fit with them."""
    mapping, pair = GEOMETRIES["30 degrees"](), psfs()
    found = PaperResampler.from_mapping(mapping, *pair, device=device)._factors
    model, kernel = (found.n_terms * n * 4 for n in (found.n_cols, found.l_pad))  # [bytes]
    for cache, largest in ((model // 5, 1 << 30), (1 << 30, kernel // 3), (3 * model, 1 << 30)):
        with monkeypatch.context() as patch:
            patch.setattr(found, "tuning", replace(found.tuning, slab_bytes=cache))
            patch.setattr(device, "max_alloc", largest)
            found.prepare()
        most = max(slab.n_units for slab in found.slabs) - 1
        assert most * found.unit_rows * found.n_cols * 4 <= cache
        assert most * found.unit_rows * found.l_pad * 4 <= largest / 2
        fewer = len(found.slabs) - 1
        assert model > fewer * cache or kernel > fewer * (largest // 2)
        one = max(slab.n_rows for slab in found.slabs) * found.n_cols * 4
        assert found.group == max(1, cache // one)
