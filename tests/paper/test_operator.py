"""The paper's scheme against the float64 oracles and ours, and faults that the checks see."""

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
    operator,
    psfs,
    tolerance,
    turn,
)
from helpers.tuning import tune

from clresample import DeviceError
from clresample.paper.operator import factors, sincs
from clresample.paper.operator.resampler import PaperResampler
from clresample.resampling import reference
from clresample.resampling.resampler import Resampler
from clresample.resampling.transfer import WRAP_TOLERANCE
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning
from clresample.testing import check_adjoint, dense

every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)
AFFINE = [name for name, make in GEOMETRIES.items() if make().geometry != "distorted"]
PATHS = [name for name in ONE_OF_EACH if name in AFFINE]


def sampled(sigma_px):
    """Oversampled: D ends at 1e-14 within the band, its kernel as soon, and no sinc cut matters.

    The stated centre lies off the core: the kernel has no symmetry and its spectrum both parts.
    """
    images = PSF.gaussian(sigma_px, spacing=0.5, n_pixels=61).images
    return PSF(images, spacing=0.5, center=(30.2, 29.85))


SAMPLED = {"psf_in": PSF.gaussian(0.8), "psf_out": sampled(1.6)}


def split(device, mapping, psf_in, psf_out, dtype=np.float32, **options):
    """The operator of a mapping made by hand; skips where the device has no float64."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no float64")
    return PaperResampler.from_mapping(
        mapping, psf_in, psf_out, dtype=dtype, device=device, **options
    )


def noise(shape, seed=3):
    return np.random.default_rng(seed).normal(size=shape)


def galaxies(shape):
    """Two smooth bands well inside the model, without power near any band's edge."""
    y, x = (np.arange(n) - 0.48 * (n - 1) for n in shape)
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) / 2.2**2)
    return np.stack([image, image**1.3])


def allowed(mapping, psf_in, psf_out, n_fft):
    """Limits on the effect of the sincs' truncation, for white noise and for galaxies.

    A sinc that ends at K/2 smooths the step e that |D| makes at its band's edge: by e/2 at most at
    the edge itself, by e / (2 pi K x) at a distance x (galaxies: 0.1); P2's sincs and the model's.
    """
    d = np.abs(reference.otf_ratio(mapping.matrix, psf_in, psf_out, n_fft)[2])
    on = np.pad(d, ((0, 0), (1, 1), (1, 1))) > 0
    inner = on[:, :-2, 1:-1] & on[:, 2:, 1:-1] & on[:, 1:-1, :-2] & on[:, 1:-1, 2:]
    step = (d * ~inner).max() / d.max()
    return step + WRAP_TOLERANCE, step / (np.pi * min(n_fft) * 0.1)


def check(op, mapping, psf_in, psf_out, images, extra):
    images = np.asarray(images).astype(op.dtype)
    truth = reference.resample(images, mapping, psf_in, psf_out, op.certificate.n_fft)
    error, limit = distance(op(images), truth), tolerance(op.device, op.dtype) + extra
    assert error <= limit, f"relative error {error:.1e}, allowed {limit:.1e}"


@every_type
@pytest.mark.parametrize("geometry", AFFINE)
def test_every_geometry(device, geometry, dtype):
    mapping, pair = GEOMETRIES[geometry](), psfs()
    op = split(device, mapping, *pair, dtype)
    assert op.geometry == mapping.geometry
    for_noise, for_galaxies = allowed(mapping, *pair, op.certificate.n_fft)
    check(op, mapping, *pair, noise((2, *op.shape_in)), for_noise)
    check(op, mapping, *pair, galaxies(op.shape_in[1:]), for_galaxies)
    check_adjoint(op, np.random.default_rng(4), batch=(2,))
    assert np.all(op(noise(op.shape_in))[:, ~op.covered] == 0)


@every_type
@pytest.mark.smoke
@pytest.mark.parametrize("geometry", PATHS)
def test_forward_and_adjoint_are_the_dense_matrix(device, geometry, dtype):
    mapping = affine(GEOMETRIES[geometry]().matrix, (8, 7), (5, 6))
    psf_in, psf_out = SAMPLED["psf_in"], sampled([1.6, 2.0])
    op = split(device, mapping, psf_in, psf_out, dtype)
    positions = mapping.at(*np.indices(mapping.shape_out))
    n_fft = [3 * k for k in op.certificate.n_fft]
    truth = reference.dense_matrix((8, 7), positions, mapping.matrix, psf_in, psf_out, n_fft)
    blocks = np.zeros((2, 30, 2, 56))  # bands do not mix
    blocks[0, :, 0], blocks[1, :, 1] = truth * mapping.covered.reshape(-1, 1)
    assert distance(dense(op), blocks.reshape(60, 112)) < tolerance(device, dtype)
    assert distance(dense(op.T).T, blocks.reshape(60, 112)) < tolerance(device, dtype)


@every_type
@pytest.mark.parametrize("geometry", ["mirrored", "crossed", "30 degrees"])
@pytest.mark.parametrize("pair", PSF_PAIRS)
def test_any_psf(device, pair, geometry, dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        pair = PSF_PAIRS[pair]()
    mapping = GEOMETRIES[geometry]()
    op = split(device, mapping, *pair, dtype)
    for_noise, for_galaxies = allowed(mapping, *pair, op.certificate.n_fft)
    check(op, mapping, *pair, noise(op.shape_in), for_noise)
    images = np.resize(galaxies(op.shape_in[1:]), op.shape_in)
    check(op, mapping, *pair, images, for_galaxies + WRAP_TOLERANCE)
    check_adjoint(op, np.random.default_rng(5))


@every_type
@pytest.mark.parametrize("shape_out", [(1, 1), (1, 9), (8, 1), (16, 17)], ids=str)
@pytest.mark.parametrize("shape_in", [(1, 1), (1, 20), (33, 16)], ids=str)
def test_any_size(device, shape_in, shape_out, dtype):
    for matrix in (turn(0, 0.9), turn(90, 0.9), turn(30, 0.9), turn(70, 0.9)):
        mapping = affine(matrix, shape_in, shape_out)
        op = split(device, mapping, **SAMPLED, dtype=dtype)
        for_noise, _ = allowed(mapping, *SAMPLED.values(), op.certificate.n_fft)
        check(op, mapping, *SAMPLED.values(), noise(op.shape_in), for_noise)
        # several images: one observed pixel alone may cancel to rounding
        check_adjoint(op, np.random.default_rng(6), batch=(8,))


@pytest.mark.parametrize("angle", [0, 30])
def test_ours_and_the_papers_agree_on_galaxies(device, angle):
    # Euclid to Rubin; what is left is float32 and a little of D's step of 6e-4
    grid_in, grid_out = Grid.flat((60, 53), 0.1), Grid.flat((31, 28), 0.2, angle_deg=angle)
    pair = PSF.gaussian(1.6), PSF.gaussian([1.485, 1.8], n_pixels=(41, 40))
    ours = Resampler(grid_in, pair[0], grid_out, pair[1], device=device)
    paper = PaperResampler(grid_in, pair[0], grid_out, pair[1], device=device)
    images = galaxies((60, 53))
    assert distance(paper(images), ours(images)) < 2e-6
    # an adjoint sees frequencies up to the band's edge
    assert distance(paper.adjoint(ours(images)), ours.adjoint(ours(images))) < 1e-5


@pytest.mark.parametrize("geometry", PATHS)
def test_a_batch_is_its_items_one_by_one(device, geometry):
    op = split(device, GEOMETRIES[geometry](), *psfs())
    x, y = noise((7, *op.shape_in)), noise((7, *op.shape_out))
    forward, adjoint = [op(item) for item in x], [op.adjoint(item) for item in y]
    for op._factors.group in (7, 3):  # in groups of three, the last one is short
        np.testing.assert_array_equal(op(x), forward)
        np.testing.assert_array_equal(op.adjoint(y), adjoint)
    x[2], y[2] = np.nan, np.nan
    for result in (op(x), op.adjoint(y)):
        assert np.isfinite(np.delete(result, 2, axis=0)).all()


@pytest.mark.parametrize("geometry", PATHS)
def test_slabs_and_chunks_change_nothing_but_rounding(device, geometry, monkeypatch):
    mapping, (x, y) = GEOMETRIES[geometry](), (noise((2, 31, 26)), noise((2, 13, 18)))
    whole = split(device, mapping, *psfs())
    tune(monkeypatch, chunk_terms=100, slab_bytes=1 << 15)
    cut = split(device, mapping, *psfs())
    assert len(cut._factors.slabs) > 3 and cut._factors.slabs[0].n_chunks > 3
    assert distance(cut(x), whole(x)) < 1e-6
    assert distance(cut.adjoint(y), whole.adjoint(y)) < 1e-6


@pytest.mark.parametrize("angle", [0, 90, 30])
def test_either_axis_may_shift_the_model_and_the_cheaper_does(device, angle, monkeypatch):
    for shape_out, axis in (((10, 32), 0), ((32, 10), 1)):
        mapping = affine(turn(angle), (40, 40), shape_out)
        cheap = split(device, mapping, **SAMPLED)
        assert cheap.model_axis == axis
        x = noise(cheap.shape_in)
        with monkeypatch.context() as patch:
            patch.setattr(factors, "SHIFT_COST", -(10**6))  # turns the order round
            dear = split(device, mapping, **SAMPLED)
        assert dear.model_axis == 1 - axis
        assert distance(dear(x), cheap(x)) < TOLERANCE[np.float32]


@pytest.mark.parametrize("geometry", PATHS)
def test_a_shift_is_a_moved_grid(device, geometry):
    mapping, shift = GEOMETRIES[geometry](), (1.3, -0.4)
    moved = replace(mapping, offset=mapping.offset + shift)
    op, truth = split(device, mapping, *psfs()), split(device, moved, *psfs())
    both, images = op.covered & truth.covered, noise(op.shape_in)
    assert distance(op(images) * both, truth(images) * both) > 0.01
    op.shift = shift
    assert distance(op(images) * both, truth(images) * both) < TOLERANCE[np.float32]
    check_adjoint(op, np.random.default_rng(8))
    for wrong in ((1, 2, 3), (np.nan, 0)):
        with pytest.raises(ValueError, match="shift is"):
            op.shift = wrong
    with pytest.raises(ValueError, match="read-only"):
        op.shift[0] = 3.0


@every_type
def test_sinc_tables_are_exact_at_any_distance(device, dtype):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip("no float64")
    positions = np.concatenate([noise(50) * 10, [0, -3, 0.5, -0.5, 7.5, 1e-9, 2 - 1e-9]])
    whole, table = np.rint(positions), device.zeros((len(positions), 41), dtype)
    part = (positions - whole)[:, None]
    for first in (-20, 10**6, -(10**5)):
        sincs.sinc_table(device, positions, first, 41, table, 41, 1)
        distances = whole[:, None] - first - np.arange(41)
        truth = (-1.0) ** distances * np.sinc(part) * part
        far = distances + part
        truth = np.where(distances == 0, np.sinc(part), truth / np.where(far == 0, 1, far))
        np.testing.assert_allclose(device.get(table), truth, rtol=4 * np.finfo(dtype).eps)


def test_the_psf_is_interpolated_term_by_term(device):
    psf, matrix = PSF.gaussian([0.6, 0.8], n_pixels=(9, 12), spacing=0.7), turn(20, 1.6, flip=True)
    found = sincs.interpolate_psf(device, matrix, psf, (5, 7), fine=2)
    for j, i in np.ndindex(10, 14):
        q = np.linalg.solve(matrix, ((j - 5) / 2, (i - 7) / 2)) / psf.spacing + psf.center[0]
        weight = np.outer(np.sinc(q[0] - np.arange(9)), np.sinc(q[1] - np.arange(12)))
        truth = (psf.images * weight).sum(axis=(1, 2))
        np.testing.assert_allclose(found[:, j, i], truth, atol=1e-15 if device.has_fp64 else 1e-7)


@pytest.mark.parametrize("geometry", ["crossed", "30 degrees"])
@pytest.mark.parametrize("fault", ["wave", "kernel", "transpose", "mask", "sum"])
def test_a_fault_is_seen(device, fault, geometry, monkeypatch):
    mapping = GEOMETRIES[geometry]()
    op = split(device, mapping, **SAMPLED)
    parts, rng = op._factors, np.random.default_rng(9)
    images = noise(op.shape_in)
    check(op, mapping, *SAMPLED.values(), images, 0)
    check_adjoint(op, rng)
    if fault == "wave":  # the model shifted by a hundredth of a pixel: consistent, but wrong
        parts.set_transfer(op._transfer, np.array([0.01, 0]))
    elif fault == "kernel":  # a term of the kernel's spectrum by a thousandth
        d = np.array(op._transfer)
        d[:, 1, 1] *= 1.001
        parts.set_transfer(d, op.shift[0])
    elif fault == "transpose":  # forward and adjoint with different kernels
        kernel = parts.kernels[0][0][0]
        kernel[...] = 1.00001 * kernel
    elif fault == "mask":  # forward pixels outside the model
        parts.pixels.covered = device.put(np.ones(mapping.shape_out, np.uint8))
    elif fault == "sum":  # the model's lowest frequencies, or first row, taken for the next
        parts.slabs[0].first += 1
    parts.bound.clear()  # what was bound to the right ones
    with pytest.raises(AssertionError):
        check(op, mapping, *SAMPLED.values(), images, 0)
        check_adjoint(op, rng)


def test_errors_name_the_argument_and_give_both_values(device, monkeypatch):
    grid, psf = Grid.flat((9, 8), 0.1), PSF.gaussian(1.0)
    far = Grid.flat((4, 5), 0.1, center_arcsec=(0, 2.0))
    with pytest.raises(ValueError, match=r"\(4, 5\).*\(9, 8\)"):
        PaperResampler(grid, psf, far, psf, device=device)
    with pytest.raises(ValueError, match="psf_in has 2 bands.*3"):
        PaperResampler(grid, PSF.gaussian([1, 2]), grid, PSF.gaussian([1, 2, 3]), device=device)
    with pytest.raises(ValueError, match="grid_out departs .* 0.*Resampler"):
        split(device, distorted(turn(0)), *psfs())
    monkeypatch.setattr(device, "max_alloc", 1 << 12)
    with pytest.raises(DeviceError, match="4.0 KiB|4 KiB"):
        PaperResampler(grid, psf, grid, psf, device=device)


def test_the_same_pixels_and_psf_give_the_image_to_rounding(device):
    # not copied, as Resampler does: what the scheme itself leaves
    psf, mapping = PSF.gaussian(0.8), affine(np.eye(2), (31, 26), (31, 26), shift=(0, 0))
    for dtype in TYPES:
        op, images = split(device, mapping, psf, psf, dtype), noise((1, 31, 26))
        assert distance(op(images), images) < TOLERANCE[dtype]


def test_the_same_answer_as_ours_where_no_sinc_is_cut(device):
    for geometry in PATHS:
        mapping = GEOMETRIES[geometry]()
        op, ours = (make(device, mapping, **SAMPLED) for make in (split, operator))
        x, y = noise(op.shape_in), noise(op.shape_out)
        assert distance(op(x), ours(x)) < tolerance(device, np.float32)
        assert distance(op.adjoint(y), ours.adjoint(y)) < tolerance(device, np.float32)
