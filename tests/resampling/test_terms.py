"""Operators whose bands add up several images of the model, each through a PSF of its own."""

import numpy as np
import pytest
from helpers.geometries import (
    GEOMETRIES,
    ONE_OF_EACH,
    TOLERANCE,
    TYPES,
    affine,
    distance,
    expected,
    turn,
)

from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint

every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)
NARROW, N_TERMS = PSF.gaussian(0.8, n_pixels=15), 3
WIDTHS = np.array([[1.4, 1.6, 1.5], [1.9, 1.7, 2.1]])  # of two bands


def of_terms(device, mapping, widths, dtype):
    """The operator of Gaussian PSFs (C, T) [px], skipped where the device lacks the type."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    plan = make_resampling_plan(
        mapping,
        NARROW,
        PSF.gaussian(np.ravel(widths)),
        precision=Precision.of(dtype),
        n_terms=np.shape(widths)[1],
    )
    return Resampler.from_plans([plan], dtype=dtype, device=device)


def added(op, images, widths):
    """The operator by its definition: each image through its own PSF by the oracle, summed."""
    seen = expected(op, images, NARROW, PSF.gaussian(np.ravel(widths)))
    return seen.reshape(*seen.shape[:-3], *np.shape(widths), *seen.shape[-2:]).sum(axis=-3)


@every_type
@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_a_band_is_the_sum_of_images_each_through_its_own_psf(device, geometry, dtype):
    op, rng = of_terms(device, GEOMETRIES[geometry](), WIDTHS, dtype), np.random.default_rng(3)
    assert op.shape_in[0] == 6
    assert op.shape_out[0] == 2
    images = rng.normal(size=(2, *op.shape_in)).astype(dtype)
    assert distance(op(images), added(op, images, WIDTHS)) <= TOLERANCE[dtype]
    check_adjoint(op, rng, batch=(2,))


@pytest.mark.parametrize("geometry", ["aligned", "30 degrees", "distorted"])
def test_items_of_a_batch_have_terms_of_their_own(device, geometry):
    mapping, rng = GEOMETRIES[geometry](), np.random.default_rng(5)
    widths = [WIDTHS, WIDTHS[::-1] + 0.1]
    ops = [of_terms(device, mapping, w, np.float32) for w in widths]
    both = Resampler.of_items(ops)
    images = rng.normal(size=(2, *both.shape_in)).astype(np.float32)
    for one, image, op in zip(both(images), images, ops, strict=True):
        assert distance(one, op(image)) < 1e-6
    check_adjoint(both, rng, batch=(2,))


def test_operators_of_different_numbers_of_terms_share_no_batch(device):
    mapping = affine(turn(0))
    one = of_terms(device, mapping, WIDTHS, np.float32)
    other = of_terms(device, mapping, WIDTHS[:, :2], np.float32)
    assert one.layout != other.layout
    with pytest.raises(ValueError, match="n_terms 2, plans\\[0\\] has 3"):
        Resampler.of_items([one, other])
    with pytest.raises(ValueError, match="n_terms is 3"):
        one.render(np.zeros(one.shape_in[1:], np.float32))


def test_the_dot_test_fails_where_the_way_back_uses_another_psf(device):
    mapping = affine(turn(0))
    op = of_terms(device, mapping, WIDTHS, np.float32)
    other = of_terms(device, mapping, WIDTHS[:, ::-1], np.float32)
    op._adjoint = other._adjoint
    with pytest.raises(AssertionError, match="<Ax,y>"):
        check_adjoint(op, np.random.default_rng(6))
