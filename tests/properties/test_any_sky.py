"""Grids, PSFs and arrays of any kind: laws that all of them keep."""

import warnings

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from hypothesis.extra import numpy as hnp

from clresample import get_device
from clresample.resampling.resampler import Resampler
from clresample.sky.fourier import phases
from clresample.sky.grid import Grid
from clresample.sky.nufft import nufft_type2
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning
from clresample.sky.validation.checks import as_float_array

ANGLE = st.floats(-720, 720) | st.sampled_from([0, 45, 90, 180, 270])
SIDE = st.integers(1, 24)


@given(
    shape=st.tuples(SIDE, SIDE),
    scale=st.floats(0.01, 10),
    angle=ANGLE,
    flip=st.booleans(),
    ra=st.floats(0, 360),
    dec=st.floats(-89, 89),
)
def test_pixels_come_back_from_the_sky(shape, scale, angle, flip, ra, dec):
    flat = Grid.flat(shape, scale, angle_deg=angle, flip=flip)
    placed = Grid.from_wcs(flat.to_wcs(ra_deg=ra, dec_deg=dec), shape)
    n, m = np.meshgrid(*(np.linspace(-0.5, k - 0.5, 4) for k in shape), indexing="ij")
    for grid in (flat, placed):
        np.testing.assert_allclose(grid.pixel(*grid.sky(n, m)), np.stack([n, m], -1), atol=1e-5)
        mapping = grid.map_to(grid)
        assert mapping.geometry == "aligned" and mapping.covered.all()
        np.testing.assert_allclose(mapping.matrix, np.eye(2), atol=1e-9)
    assert placed.pixel_scale_arcsec == pytest.approx(scale, rel=1e-6)


IMAGES = hnp.arrays(
    np.float64, st.tuples(SIDE, SIDE), elements=st.floats(-1e3, 1e3) | st.just(np.nan)
)


def psf_of(image, **given):
    """A PSF, or None where it is refused by name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        try:
            return PSF(image, **given)
        except ValueError as error:
            assert str(error).startswith(("images", "spacing", "center"))
            return None


@given(IMAGES, st.floats(0.1, 3))
def test_transfer_functions_begin_with_1(image, spacing):
    psf = psf_of(image, spacing=spacing)
    assume(psf is not None)
    assert np.isfinite(image).all() and psf.images.sum() == pytest.approx(1)
    nu = np.array([0.0, 0.05, 0.3]) / spacing
    matrix = np.array([[0.9, 0.2], [-0.3, 1.1]])
    for given_matrix in (None, matrix):
        otf = psf.otf(nu, nu, given_matrix)
        assert otf[0, 0, 0] == pytest.approx(1, abs=1e-9 * np.abs(psf.images).sum())
        assert (np.abs(otf) <= np.abs(psf.images).sum() * (1 + 1e-9)).all()


@given(
    hnp.arrays(np.float64, st.tuples(st.just(2), SIDE, SIDE), elements=st.floats(-1e3, 1e3)),
    hnp.arrays(np.float64, (3, 4), elements=st.floats(-0.7, 0.7)),
    hnp.arrays(np.float64, (3, 4), elements=st.floats(-0.7, 0.7)),
)
def test_the_fast_transform_is_the_sum(images, f, g):
    y, x = (np.arange(n) for n in images.shape[1:])
    waves = (np.exp(-1j * phases(v, u)) for v, u in ((f, y), (g, x)))
    expected = np.einsum("byx,fgy,fgx->bfg", images, *waves)
    light = np.abs(images).sum() + 1e-300
    assert np.abs(nufft_type2(images, f, g) - expected).max() <= 2e-14 * light


@given(
    hnp.arrays(
        hnp.scalar_dtypes() | st.just(np.dtype(object)),
        st.tuples(st.integers(0, 3)),
        fill=st.nothing(),
    )
)
def test_arrays_are_their_numbers_or_refused(array):
    try:
        found = as_float_array("a", array)
    except ValueError as error:
        assert str(error).startswith("a ")
        assert array.dtype.kind not in "biuf"
        return
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, array.astype(np.float64))


@given(
    shape_in=st.tuples(st.integers(6, 20), st.integers(6, 20)),
    shape_out=st.tuples(SIDE, SIDE),
    scale=st.floats(0.3, 4),
    angle=ANGLE,
    flip=st.booleans(),
    sigma=st.tuples(st.floats(0.5, 2), st.floats(0.5, 2)),
    shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_geometry_has_its_adjoint(shape_in, shape_out, scale, angle, flip, sigma, shift, seed):
    """<A x, y> = <x, A^T y>, for arrays of any layout, alone or in a batch."""
    grid_in = Grid.flat(shape_in, 0.1)
    grid_out = Grid.flat(shape_out, 0.1 * scale, angle_deg=angle, flip=flip)
    assume(grid_out.map_to(grid_in).covered.any())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        psfs = [PSF.gaussian(s, n_pixels=11) for s in sigma]
        op = Resampler(grid_in, psfs[0], grid_out, psfs[1], device=get_device(), shift=shift)
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(3, *op.shape_in)).astype(np.float32)
    y = rng.normal(size=(3, *op.shape_out)).astype(np.float32)
    ax, aty = op(x), op.adjoint(y)
    size = np.linalg.norm(ax) * np.linalg.norm(y) + np.linalg.norm(x) * np.linalg.norm(aty)
    assert abs(np.vdot(ax, y) - np.vdot(x, aty)) <= 1e-5 * size + 1e-12
    np.testing.assert_array_equal(op(np.asfortranarray(x.astype(">f8"))), ax)
    np.testing.assert_allclose(op(x[1]), ax[1], atol=1e-5 * np.abs(ax).max(initial=1e-30))
