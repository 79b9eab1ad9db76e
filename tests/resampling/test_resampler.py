"""The operator on every path against the float64 oracles, and its dot test."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from helpers.geometries import (
    GEOMETRIES,
    ONE_OF_EACH,
    PSF_PAIRS,
    TOLERANCE,
    TYPES,
    affine,
    distance,
    distorted,
    expected,
    gaussian_at,
    operator,
    psfs,
    sky_grid,
    turn,
)

from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.reference import dense_matrix
from clresample.resampling.resampler import Resampler
from clresample.resampling.transfer import DIVISION_FLOOR
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning
from clresample.testing import check_adjoint, dense

every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)


def noise(shape, seed=3):
    return np.random.default_rng(seed).normal(size=shape)


def check_forward(op, psf_in, psf_out, batch=()):
    """White noise up to the edge, against the spectral sum."""
    images = noise((*batch, *op.shape_in)).astype(op.dtype)
    truth = expected(op, images, psf_in, psf_out)
    error = distance(op(images), truth)
    assert error <= TOLERANCE[op.dtype.type], f"relative error {error:.1e}"


@every_type
@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_forward_is_the_sum_over_frequencies_and_adjoint_its_transpose(device, geometry, dtype):
    mapping = GEOMETRIES[geometry]()
    op = operator(device, mapping, *psfs(), dtype)
    assert op.geometry == mapping.geometry
    check_forward(op, *psfs(), batch=(2,))
    check_adjoint(op, np.random.default_rng(4), batch=(2,))


@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_forward_and_adjoint_are_the_dense_matrix(device, geometry):
    # oversampled, D ends at 1e-19 within the band: its kernel ends as soon, and K may be any
    psf_in, psf_out = PSF.gaussian(0.8), PSF.gaussian([1.5, 2.0], spacing=0.5, n_pixels=61)
    matrix = {"30 degrees": turn(30), "60 degrees": turn(60), "crossed": turn(90)}.get(
        geometry, turn(0, flip=True)
    )
    build = distorted if geometry == "distorted" else affine
    mapping = build(matrix, (8, 7), (5, 6))
    op = operator(device, mapping, psf_in, psf_out, np.float64)
    n_fft = [3 * k for k in op.certificate.n_fft]
    positions = mapping.at(*np.indices(mapping.shape_out))
    truth = dense_matrix((8, 7), positions, mapping.matrix, psf_in, psf_out, n_fft)
    truth *= (mapping.covered * (1 if mapping.area is None else mapping.area)).reshape(-1, 1)
    # bands do not mix: blocks on the diagonal
    blocks = np.zeros((2, 30, 2, 56))
    blocks[0, :, 0], blocks[1, :, 1] = truth
    assert distance(dense(op), blocks.reshape(60, 112)) < 1e-12
    assert distance(dense(op.T).T, blocks.reshape(60, 112)) < 1e-12


@every_type
@pytest.mark.parametrize("geometry", ONE_OF_EACH)
@pytest.mark.parametrize("pair", PSF_PAIRS)
def test_any_psf(device, pair, geometry, dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        psf_in, psf_out = PSF_PAIRS[pair]()
    op = operator(device, GEOMETRIES[geometry](), psf_in, psf_out, dtype)
    check_forward(op, psf_in, psf_out)
    check_adjoint(op, np.random.default_rng(5))


@every_type
@pytest.mark.parametrize("shape_out", [(1, 1), (1, 9), (8, 1), (16, 17)], ids=str)
@pytest.mark.parametrize("shape_in", [(1, 1), (1, 20), (33, 16)], ids=str)
def test_any_size(device, shape_in, shape_out, dtype):
    for build, matrix in (
        (affine, turn(0, 0.9)),  # so that a single pixel is always met
        (affine, turn(30, 0.9)),
        (affine, turn(70, 0.9)),
        (distorted, turn(10, 0.9)),
    ):
        op = operator(device, build(matrix, shape_in, shape_out), *psfs(), dtype)
        check_forward(op, *psfs())
        check_adjoint(op, np.random.default_rng(6))


@every_type
def test_identity_returns_its_input_bit_for_bit(device, dtype):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip("no float64")
    psf = PSF.gaussian([0.9, 1.4, 2.0])
    for grid, same in (
        (Grid.flat((20, 31), 0.1, angle_deg=20),) * 2,
        (sky_grid((20, 31), 0.2, 33), sky_grid((20, 31), 0.2, 33, form="PC")),
    ):
        op = Resampler(grid, psf, same, psf, dtype=dtype, device=device)
        images = noise((4, *op.shape_in)).astype(dtype)
        np.testing.assert_array_equal(op(images), images)
        np.testing.assert_array_equal(op.adjoint(images), images)
        op.shift = (0.25, 0)
        assert distance(op(images), images) > 0.1
        op.shift = 0
        np.testing.assert_array_equal(op(images), images)


@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_a_batch_is_its_items_one_by_one(device, geometry, monkeypatch):
    op = operator(device, GEOMETRIES[geometry](), *psfs())
    x, y = noise((7, *op.shape_in)), noise((7, *op.shape_out))
    forward, adjoint = [op(item) for item in x], [op.adjoint(item) for item in y]
    np.testing.assert_array_equal(op(x), forward)
    np.testing.assert_array_equal(op.adjoint(y), adjoint)
    # groups of three, the last one short; in another order, lest buffers still hold the answer
    monkeypatch.setattr(op, "_group", 3)
    np.testing.assert_array_equal(op(x[::-1]), forward[::-1])
    np.testing.assert_array_equal(op.adjoint(y[::-1]), adjoint[::-1])


def varied_plans(geometry, dtype=np.float32):
    """Plans of one geometry that differ in scale, place, PSFs and, unless aligned, angle."""
    plans = []
    for angle, scale, sigma in ((10, 2.0, 1.5), (25, 0.7, 2.2), (-20, 3.0, 1.2), (35, 1.0, 1.8)):
        build = distorted if geometry == "distorted" else affine
        mapping = build(turn(0 if geometry == "aligned" else angle, scale))
        psf_in, psf_out = PSF.gaussian([0.7, 0.8]), PSF.gaussian(sigma, n_pixels=int(9 * sigma))
        plans.append(make_resampling_plan(mapping, psf_in, psf_out, precision=Precision.of(dtype)))
    return plans


@pytest.mark.parametrize("geometry", ["aligned", "affine", "distorted"])
def test_items_with_their_own_geometry(device, geometry):
    plans = varied_plans(geometry)
    shifts = np.array([(0, 0), (0.3, -0.2), (1, 1), (-0.7, 0)])
    op = Resampler.from_plans(plans, device=device, shift=shifts)
    x, y = noise((4, *op.shape_in)), noise((4, *op.shape_out))
    singles = [
        Resampler.from_plans([p], device=device, shift=s)
        for p, s in zip(plans, shifts, strict=True)
    ]
    for i, single in enumerate(singles):
        # longer tables are padded with zeros, which add nothing but may regroup a sum
        assert distance(op(x)[i], single(x[i])) < 3e-7
        assert distance(op.adjoint(y)[i], single.adjoint(y[i])) < 3e-7
    together = Resampler.of_items(singles)
    assert (together(x) == op(x)).all()
    assert len({single.layout for single in singles}) == 1
    assert Resampler.of_items([op, op]) is op
    check_adjoint(op, np.random.default_rng(7), batch=(4,))
    assert op.covered.shape == (4, *op.shape_out[1:])
    with pytest.raises(ValueError, match="batch has 3 items, the operator 4 plans"):
        op(x[:3])
    # nothing is read beyond the items: what follows them in memory does not matter
    held = np.full((6, *op.shape_out), np.nan, np.float32)
    held[1:5] = y
    assert np.isfinite(op.adjoint(device.put(held)[1:5]).get()).all()


@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_a_shift_is_a_moved_grid(device, geometry):
    mapping, shift = GEOMETRIES[geometry](), (1.3, -0.4)
    moved = replace(mapping, offset=mapping.offset + shift)
    if mapping.positions is not None:
        moved = replace(moved, positions=mapping.positions + shift)
    # galaxies: the same point of another K differs by what the band's edge rings
    x, y = np.indices(mapping.shape_in, dtype=float) - np.array([[[15.0]], [[12.0]]])
    images = np.exp(-0.5 * (x**2 + y**2) / 2.5**2) * np.ones((2, 1, 1))
    op = operator(device, mapping, *psfs())
    truth = operator(device, moved, *psfs())
    both = op.covered & truth.covered
    assert distance(op(images) * both, truth(images) * both) > 0.01
    op.shift = shift
    assert distance(op(images) * both, truth(images) * both) < 2e-6
    check_adjoint(op, np.random.default_rng(8))
    op.shift = np.negative(shift)
    assert distance(op(images) * both, truth(images) * both) > 0.01
    for wrong in ((1, 2, 3), (np.nan, 0)):
        with pytest.raises(ValueError, match="shift is"):
            op.shift = wrong
    np.testing.assert_array_equal(op.shift, np.negative(shift))
    with pytest.raises(ValueError, match="read-only"):
        op.shift[0] = 3.0


def test_a_psf_that_is_too_wide_is_floored(device):
    # transforms of the model's PSF under 1e-20 where the observation still has 1e-2 of its light
    wide, narrow = PSF.gaussian(4.0), PSF.gaussian(0.8)
    for matrix in (turn(0, 1.0), turn(30, 1.0)):
        op = operator(device, affine(matrix), wide, narrow)
        assert op.certificate.floored_power[0] > 0.2
        assert 1e3 < op.certificate.max_gain[0] <= 1 / DIVISION_FLOOR
        assert np.isfinite(op(noise(op.shape_in))).all()
        check_forward(op, wide, narrow)
    fine = operator(device, affine(turn(0)), *psfs()).certificate
    np.testing.assert_allclose(fine.max_gain, 1)
    np.testing.assert_array_equal(fine.floored_power, 0)


def test_amplified_noise_and_a_floored_division_are_warned_of(device):
    grid, wide, narrow = Grid.flat((20, 21), 0.1), PSF.gaussian(4.0), PSF.gaussian(0.8)
    with pytest.warns(PSFWarning) as warned:
        Resampler(grid, wide, grid, narrow, device=device)
    assert any("amplifies some frequencies" in str(w.message) for w in warned)
    assert any("the division is floored" in str(w.message) for w in warned)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Resampler(grid, narrow, grid, wide, device=device)


def test_errors_name_the_argument_and_give_both_values(device):
    grid, psf = Grid.flat((9, 8), 0.1), PSF.gaussian(1.0)
    far = Grid.flat((4, 5), 0.1, center_arcsec=(0, 2.0))
    with pytest.raises(ValueError, match=r"\(4, 5\).*\(9, 8\)"):
        Resampler(grid, psf, far, psf, device=device)
    with pytest.raises(ValueError, match="psf_in has 2 bands.*3"):
        Resampler(grid, PSF.gaussian([1, 2]), grid, PSF.gaussian([1, 2, 3]), device=device)
    with pytest.raises(ValueError, match="int32.*float32 or float64"):
        Resampler(grid, psf, grid, psf, dtype=np.int32, device=device)
    with pytest.raises(ValueError, match="plans is empty"):
        Resampler.from_plans([], device=device)
    plans = varied_plans("affine")
    for other, match in (
        (varied_plans("aligned")[0], "geometry aligned"),
        (
            make_resampling_plan(affine(turn(30), (9, 9)), *psfs(), precision=Precision.of("f4")),
            "shape_in",
        ),
        (
            make_resampling_plan(affine(turn(80)), *psfs(), precision=Precision.of("f4")),
            "columns.*rows",
        ),
    ):
        with pytest.raises(ValueError, match=rf"plans\[4\].*{match}"):
            Resampler.from_plans([*plans, other], device=device)


BROKEN = {
    "unnormalised flux": lambda plan: replace(
        plan, d_plus=1.001 * plan.d_plus, d_minus=1.001 * plan.d_minus
    ),
    "conjugate spectrum": lambda plan: replace(plan, d_plus=plan.d_plus.conj()),
    "halves swapped": lambda plan: replace(plan, d_plus=plan.d_minus, d_minus=plan.d_plus),
    "a row too low": lambda plan: replace(plan, in_y=np.roll(plan.in_y, 1, axis=1)),
    "bands swapped": lambda plan: replace(plan, d_plus=plan.d_plus[::-1]),
}


@pytest.mark.parametrize("geometry", ONE_OF_EACH)
@pytest.mark.parametrize("fault", BROKEN)
def test_the_oracle_sees_a_broken_operator(device, fault, geometry):
    # off its centre and not alike in two bands: a PSF with no symmetry to hide behind
    pair = PSF.gaussian([0.8, 0.9]), gaussian_at((17.6, 8.0), (30, 21), 1.6, center=(17.0, 8.9))
    plan = make_resampling_plan(GEOMETRIES[geometry](), *pair, precision=Precision.of(np.float32))
    check_forward(Resampler.from_plans([plan], device=device), *pair)
    op = Resampler.from_plans([BROKEN[fault](plan)], device=device)
    with pytest.raises(AssertionError, match="relative error"):
        check_forward(op, *pair)
