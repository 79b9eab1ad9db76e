"""Small aligned operators of float32 images, which go through float64: kernels/folded.cl."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, affine, distance, expected, psfs, turn

from clresample.device.tuning import Tuning
from clresample.resampling import folded as folded_module, plan as plan_module
from clresample.resampling.folded import FoldedExecutor
from clresample.resampling.reference import frequency_sum
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint

pytestmark = pytest.mark.filterwarnings("ignore::clresample.sky.psf_checks.PSFWarning")

ALIGNED = ("aligned", "mirrored", "half turn", "crossed", "crossed back, mirrored", "finer")
# relative L2 of white noise: the image rounded once in, once out, and what the band leaves out
ROUNDED_TWICE = 6e-8


@pytest.fixture(autouse=True)
def where_it_serves(device):
    if not (device.has_fp64 and Tuning.of(device).use_folded):
        pytest.skip(f"{device.name} does not go through float64")


def folded(device, mapping, *pair, **options):
    op = Resampler.from_mapping(mapping, *(pair or psfs()), device=device, **options)
    assert isinstance(op._whole, FoldedExecutor)
    return op


def noise(shape, seed=3):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def check(op, pair, batch=()):
    """Both ways against float64: the sum over frequencies, and the operator in float64."""
    x, y = noise((*batch, *op.shape_in)), noise((*batch, *op.shape_out), seed=4)
    exact = Resampler.from_mapping(
        op.mapping, *pair, dtype=np.float64, device=op.device, shift=op.shift
    )
    away = replace(op.mapping, offset=op.mapping.offset + op.shift)
    n_fft = exact.certificate.n_fft
    positions = away.at(*np.indices(away.shape_out))
    truth = frequency_sum(x, positions, away.matrix, *pair, n_fft) * op.mapping.covered
    for found, true in ((op(x), truth), (op.adjoint(y), exact.adjoint(y))):
        assert distance(found, true) < ROUNDED_TWICE, f"relative error {distance(found, true):.1e}"


@pytest.mark.parametrize("geometry", ALIGNED)
def test_images_are_rounded_in_and_out_and_nowhere_else(device, geometry):
    matrix = GEOMETRIES[geometry]().matrix
    for shape_in, shape_out in (((31, 26), (13, 18)), ((20, 31), (8, 9)), ((7, 5), (1, 3))):
        op = folded(device, affine(matrix, shape_in, shape_out))
        check(op, psfs(), batch=(3,))
        assert check_adjoint(op, np.random.default_rng(5), batch=(2,)) < ROUNDED_TWICE


def test_float32_all_the_way_rounds_more(device):
    """Sums in float32 would exceed the bound above."""
    op = folded(device, affine(turn(0), (60, 61), (29, 30)))
    x = noise(op.shape_in)
    truth = expected(op, x, *psfs())
    plain = Resampler.from_plans(op.plans, device=device)
    assert not isinstance(plain._whole, FoldedExecutor)
    assert distance(plain(x), truth) > 2 * distance(op(x), truth)


def without_partners(weights):
    def broken(n, n_half, lit):
        after, before = weights(n, n_half, lit)
        return np.stack([after, np.maximum(before, n % 2)])  # a middle pixel counts twice

    return broken


@pytest.mark.parametrize("fault", ["a middle pixel twice", "no shift of the middle", "odd lost"])
def test_the_oracle_sees_a_broken_operator(device, monkeypatch, fault):
    if fault == "a middle pixel twice":
        monkeypatch.setattr(folded_module, "_weights", without_partners(folded_module._weights))
    if fault == "odd lost":
        turned = folded_module._turned
        monkeypatch.setattr(folded_module, "_turned", lambda t: turned(t) * [[[1]], [[0]]])
    if fault == "no shift of the middle":
        monkeypatch.setattr(plan_module, "_moved", lambda plus, minus, *_: (plus, minus))
    op = folded(device, affine(turn(90), (31, 26)))
    with pytest.raises(AssertionError, match="relative error"):
        check(op, psfs())


def test_shifts_move_it(device):
    op = folded(device, affine(turn(90)), shift=(0.3, -0.4))
    check(op, psfs())
    op.shift = -1.2, 0.7
    check(op, psfs())


def test_one_image_in_every_band_and_copies_are_the_same_to_the_bit(device):
    op = folded(device, affine(turn(90)))
    x = noise((5, *op.shape_in[1:]))
    truth = op(np.repeat(x[:, None], 2, axis=1))
    np.testing.assert_array_equal(op.render(x), truth)
    np.testing.assert_array_equal(op.render(x[3]), truth[3])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(op)).render(x), truth)
    assert not isinstance(pickle.loads(pickle.dumps(op.T.op))._executor, FoldedExecutor)


def test_what_it_is_not_made_for(device):
    """Large images, other types and geometries, and batches of plans, which round alike."""
    assert isinstance(folded(device, affine(turn(0), (180, 180), (90, 90)))._whole, FoldedExecutor)
    for mapping in (affine(turn(0), (420, 420), (210, 210)), affine(turn(30)), GEOMETRIES["SIP"]()):
        op = Resampler.from_mapping(mapping, *psfs(), device=device)
        assert op._whole is op._executor
    op = Resampler.from_mapping(affine(turn(0)), *psfs(), dtype=np.float64, device=device)
    assert op._whole is op._executor


def moments(image, positions):
    """Light, centre (2,) and variances (2,) of an image."""
    weight = image / image.sum()
    centre = (weight[..., None] * positions).sum(axis=(0, 1))
    return image.sum(), centre, (weight[..., None] * (positions - centre) ** 2).sum(axis=(0, 1))


def test_light_and_centre_stay_and_variances_grow_by_those_of_the_psfs(device):
    pair = PSF.gaussian(1.6, n_pixels=41), PSF.gaussian(1.0, n_pixels=41)  # each in its own pixels
    op = folded(device, affine(turn(0), (81, 80), (40, 39), shift=(0.3, 0.1)), *pair)
    here = np.stack(np.indices((81, 80)), axis=-1).astype(float)
    image = np.exp(-((here - (41.3, 38.2)) ** 2).sum(axis=-1) / 2 / 3.0**2)
    light, centre, variance = moments(image, here)
    found = op(image[None].astype(np.float32))[0].astype(float)
    seen_light, seen_centre, seen_variance = moments(found, op.mapping.at(*np.indices((40, 39))))
    samples = np.stack(np.indices((41, 41)), axis=-1)
    before, after = (moments(psf.images[0], samples)[2] for psf in pair)
    np.testing.assert_allclose(seen_light, light, rtol=1e-6)
    np.testing.assert_allclose(seen_centre, centre, atol=1e-5)
    np.testing.assert_allclose(seen_variance - variance, 4 * after - before, rtol=1e-3)
