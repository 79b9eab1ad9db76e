"""Rules that operators are made by, each by itself: bands, lengths, sums, memory, defaults."""

import gc
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from helpers.geometries import (
    GEOMETRIES,
    ONE_OF_EACH,
    affine,
    operator,
    psfs,
    sky_grid,
    turn,
)
from helpers.tuning import tune

from clresample.device.tuning import Tuning
from clresample.resampling import resampler as resampler_module
from clresample.resampling.cache import OperatorCache
from clresample.resampling.plan import (
    Precision,
    _half_count,
    _odd,
    is_identity,
    make_resampling_plan,
)
from clresample.resampling.reference import otf_ratio
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.resampler import TiledResampler
from clresample.resampling.transfer import wrap_radius
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

pytestmark = pytest.mark.filterwarnings("ignore::clresample.sky.psf_checks.PSFWarning")


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
    assert make_resampling_plan(same, psf, psf, precision=precision).identity
    both = PSF(np.repeat(psf.images, 2, axis=0))
    assert not make_resampling_plan(same, psf, both, precision=precision, n_terms=2).identity


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
        plan = make_resampling_plan(GEOMETRIES[name](), *psfs(), precision=Precision.of(np.float32))
        d = np.abs(plan.d_plus) + np.abs(plan.d_minus)
        assert d[:, -1].any() and d[:, :, -1].any()
        n_frequencies = plan.certificate.n_frequencies
        assert d.shape[1:] == tuple(n_frequencies[axis] for axis in plan.axes)
        assert [len(nu) for nu in plan.nu] == list(d.shape[1:])
        # and what was left out is under the tolerance: float64's plan has it
        more = make_resampling_plan(GEOMETRIES[name](), *psfs(), precision=Precision.of(np.float64))
        if plan.geometry != "aligned":  # where D also holds the window's transform
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
    plan = make_resampling_plan(affine(skew, (60, 67)), *psfs(), precision=Precision.of(np.float32))
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


def test_an_operator_holds_each_table_twice(device, as_asked):
    """In float32 as much as the plan has in float64; then what its calls need, to the byte."""
    for name in ("aligned", "30 degrees", "distorted"):
        op = operator(device, GEOMETRIES[name](), *psfs())
        assert op.n_bytes == op.plans[0].n_bytes
        op.adjoint(op(np.ones(op.shape_in, np.float32)))  # tables of both ways are there
        gc.collect()  # what other tests left must not be freed in between
        n_bytes, in_use = op.n_bytes, device.in_use
        op.adjoint(op(np.ones((3, *op.shape_in), np.float32)))
        if as_asked is None:  # guards of buffers count as memory
            assert op.n_bytes - n_bytes == device.in_use - in_use
    if device.has_fp64:
        exact = Resampler.from_plans(op.plans, dtype=np.float64, device=device)
        assert exact.n_bytes == 2 * op.plans[0].n_bytes


@pytest.mark.parametrize("n_terms", [1, 3])
def test_as_many_images_go_together_as_the_cache_holds(device, monkeypatch, n_terms):
    plan = make_resampling_plan(
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
    monkeypatch.setattr(resampler_module, "MAX_GROUPS", 4 * 2 * n_terms + 1)
    assert Resampler.from_plans([plan], device=device)._group <= 4
    assert Tuning.of(device, np.float32).group_bytes > 5 * one


def test_every_item_is_rendered_with_its_own_tables(device):
    plans = [
        make_resampling_plan(
            affine(turn(angle, scale)), *psfs(), precision=Precision.of(np.float32)
        )
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
