"""Arguments other than plain floats are used as such or rejected by name, never as floats."""

import copy
import pickle
import re
from decimal import Decimal

import numpy as np
import pytest
from astropy import units as u
from astropy.table import MaskedColumn
from astropy.utils.masked import Masked

from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource
from clresample.sky.validation.checks import (
    as_float_array,
    check_dtype,
    check_integer,
    check_number,
)

SHAPE = (9, 8)
GRID, ROUND = Grid.flat(SHAPE, 0.2), PSF.gaussian(1.0, n_pixels=11)
IMAGE = np.random.default_rng(0).normal(size=SHAPE)
HIDDEN = np.zeros(SHAPE, bool)
HIDDEN[2, 3:6] = True
ODD = {
    "complex": (IMAGE + 1j, "complex128"),
    "dates": (np.full(SHAPE, "2020-01-01", "M8[D]"), "datetime64"),
    "durations": (np.full(SHAPE, 5, "m8[s]"), "timedelta64"),
    "texts": (np.full(SHAPE, "1.5"), "<U3"),
    "bytes": (np.full(SHAPE, b"1.5"), "|S3"),
    "texts as objects": (np.full(SHAPE, "1.5", object), "it holds '1.5'"),
    "complex objects": (np.full(SHAPE, 1j, object), "it holds 1j"),
    "a unit": (IMAGE * u.m, "has the unit m"),
    "records": (np.zeros(SHAPE, [("a", float)]), "must be an array of real numbers"),
}


def observed(data=IMAGE, **given):
    return Observation(data, ROUND, GRID, **({"weights": 1.0} | given))


@pytest.mark.parametrize("kind", ODD)
def test_observation_and_psf_refuse_what_is_no_real_number(kind):
    values, said = ODD[kind]
    for name, make in (
        ("data", observed),
        ("weights", lambda v: observed(weights=v)),
        ("variance", lambda v: observed(weights=None, variance=v)),
        ("images", PSF),
    ):
        with pytest.raises(ValueError, match=f"^{name} .*{said.replace('|', '.')}"):
            make(values)


def test_numbers_of_other_types_are_numbers():
    for values in (
        IMAGE.astype(np.float16),
        np.full(SHAPE, Decimal("1.5")),
        np.arange(72).reshape(SHAPE).astype(object),
        (IMAGE * u.dimensionless_unscaled),
        np.ma.MaskedArray(IMAGE, False),
        IMAGE > 0,
    ):
        np.testing.assert_array_equal(observed(values).data[0], np.asarray(values, float))


@pytest.mark.parametrize("masked", [np.ma.MaskedArray, Masked], ids=["NumPy", "astropy"])
def test_masks_of_arrays_are_weight_0(masked):
    spoilt = np.where(HIDDEN, 1e9, IMAGE)
    expected = observed(IMAGE, mask=HIDDEN)
    for given in (
        {"data": masked(spoilt, HIDDEN)},
        {"weights": masked(np.where(HIDDEN, 7.0, 1.0), HIDDEN)},
        {"variance": masked(np.where(HIDDEN, 7.0, 1.0), HIDDEN), "weights": None},
    ):
        found = observed(**given)
        np.testing.assert_array_equal(found.weights, expected.weights)
        assert found.n_invalid == 0  # masked by intent, not lost
    more = np.roll(HIDDEN, 3, axis=0)
    both = observed(masked(spoilt, HIDDEN), mask=more)
    np.testing.assert_array_equal(both.weights[0] == 0, HIDDEN | more)
    # what is masked in a mask is not known to be good
    np.testing.assert_array_equal(
        observed(mask=np.ma.MaskedArray(np.zeros(SHAPE, bool), HIDDEN)).weights, expected.weights
    )
    # the noise is estimated without what is masked
    noise = np.random.default_rng(1).normal(size=(40, 40))
    left = np.zeros((40, 40), bool)
    left[:, :19] = True
    grid = Grid.flat((40, 40), 0.2)
    rough = Observation(masked(np.where(left, 50 * noise, noise), left), ROUND, grid)
    truth = Observation(noise, ROUND, grid, mask=left)
    np.testing.assert_array_equal(rough.weights, truth.weights)


def test_masked_values_are_refused_where_a_weight_has_no_place():
    kernel = np.ma.MaskedArray(ROUND.images[0], False)
    np.testing.assert_array_equal(PSF(kernel).images, PSF(ROUND.images).images)
    kernel[3, 3] = np.ma.masked
    with pytest.raises(ValueError, match="^images is masked at 1 of 121 values"):
        PSF(kernel)
    with pytest.raises(ValueError, match="^zero_points is masked at 1 of 1"):
        observed(zero_points=np.ma.MaskedArray([25.0], [True]))


def test_angles_with_a_unit_are_converted():
    given = PointSource(sky_deg=(np.array([150.0, 2.0]) * u.deg).to(u.rad))
    assert given.sky_deg == pytest.approx((150.0, 2.0), rel=1e-14)
    assert isinstance(given.sky_deg[0], float)
    with pytest.raises(ValueError, match="position_px has the unit deg"):
        ExtendedSource(position_px=[1, 2] * u.deg)
    with pytest.raises(ValueError, match="sky_deg has the unit m, not deg"):
        ExtendedSource(sky_deg=[1, 2] * u.m)
    assert Grid.flat(SHAPE, 200 * u.mas).jacobian[0, 0] == pytest.approx(0.2)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: PSF(IMAGE**2, spacing="a"), "spacing is .a., must be a positive number of pixels"),
        (lambda: PSF(IMAGE**2, spacing=1e300), "spacing is 1e.300, must be .* from 0.001 to 1000"),
        (lambda: PSF(IMAGE**2, spacing=1e-9), "spacing is 1e-09"),
        (lambda: PSF(IMAGE**2, spacing=[1, 2]), "spacing is .*positive number of pixels"),
        (lambda: PSF(IMAGE**2, center="b"), "center must be"),
        (lambda: PSF(None), "images must be .*None"),
        (lambda: ROUND.select([]), r"bands \[\] of a PSF that has 1"),
        (lambda: ROUND.select("g"), "bands 'g' of a PSF"),
        (lambda: ROUND.select(None), "bands None of a PSF"),
        (lambda: ROUND.select(1.5), "bands 1.5 of a PSF"),
        (lambda: PSF.gaussian("a"), "sigma_px"),
        (lambda: Grid.flat(4, 1), r"shape must be \(Ny, Nx\).* not 4"),
        (lambda: Grid.flat((4.5, 4), 1), "shape must be"),
        (lambda: Grid.flat((np.nan, 4), 1), "shape must be"),
        (lambda: Grid.flat((4, 4), "a"), "scale_arcsec"),
        (lambda: Grid.flat((4, 4), (1, 1, 1)), "scale_arcsec"),
        (lambda: Grid.flat((4, 4), 1, angle_deg=np.nan), "angle_deg is nan"),
        (lambda: Grid.flat((4, 4), 1, center_arcsec=np.inf), "center_arcsec is inf"),
        (lambda: Grid.from_jacobian((4, 4), "a", (0, 0)), "jacobian"),
        (lambda: GRID.map_to(GRID, tolerance_px=-1), "tolerance_px is -1"),
        (lambda: GRID.map_to(GRID, tolerance_px=np.nan), "tolerance_px is nan"),
        (lambda: GRID.map_to(None), r"grid_in is None \(NoneType\), must be Grid"),
        (lambda: Observation(IMAGE, None, GRID), r"psf is None \(NoneType\), must be PSF"),
        (lambda: Observation(IMAGE, ROUND, SHAPE), r"grid is \(9, 8\) \(tuple\), must be Grid"),
        (lambda: ExtendedSource(position_px="ab"), "position_px"),
        (lambda: ExtendedSource(position_px=(1, 2), n_components=1.5), "n_components is 1.5"),
        (lambda: ExtendedSource(position_px=(1, 2), n_components=True), "n_components is True"),
        (lambda: ExtendedSource(position_px=(1, 2), profile="a"), "profile"),
    ],
)
def test_other_types_are_refused_by_name(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_numbers_and_whole_numbers():
    assert as_float_array("a", [1, 2]).dtype == np.float64
    assert check_number("a", np.float32(2)) == 2 and check_integer("n", np.int16(3), 3) == 3
    for value in (2.0, "2", None, [2]):
        with pytest.raises(ValueError, match="n is .*whole number, 3 or more"):
            check_integer("n", value, 3)
    with pytest.raises(ValueError, match="n is 2, must be 3 or more"):
        check_integer("n", 2, 3)
    with pytest.raises(ValueError, match="a must be an array of real numbers"):
        as_float_array("a", [[1], [2, 3]])


@pytest.mark.parametrize("way", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_are_as_read_only(way):
    o = observed(noise=np.array([[0, 0.1, 0], [0.1, 1, 0.1], [0, 0.1, 0]]), zero_points=25.0)
    other = way(o)
    np.testing.assert_array_equal(other.data, o.data)
    np.testing.assert_array_equal(other.whitened.data, o.whitened.data)
    for array in (
        other.data,
        other.weights,
        other.zero_points,
        other.psf.images,
        other.psf.center,
        other.noise[0].filter,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@pytest.mark.parametrize(
    "given, said",
    [
        (
            {"data": np.where(HIDDEN, 1e101, 1.0), "weights": 1e-99},
            "data reach 1e.101 at .*2, 3",
        ),
        ({"weights": 1e120}, "weights reach 1e.120"),
        ({"variance": 1e120, "weights": None}, "variances reach 1e.120"),
        ({"data": np.where(HIDDEN, 1e13, 1.0)}, "data in units of their noise reach 1e.13"),
    ],
)
def test_numbers_that_no_fit_can_bear_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        observed(**given)


def test_such_numbers_do_no_harm_where_they_are_masked():
    o = observed(np.where(HIDDEN, 1e300, IMAGE), mask=HIDDEN)
    assert not o.weights[0, HIDDEN].any() and (o.weights[0, ~HIDDEN] == 1).all()


def test_pixels_far_longer_than_wide_are_a_mistake():
    wcs = GRID.to_wcs(ra_deg=10, dec_deg=20)
    Grid.from_wcs(wcs, SHAPE)
    wcs.wcs.cd = wcs.wcs.cd * (1, 200)
    with pytest.raises(ValueError, match="central pixel is 200 times as long as wide"):
        Grid.from_wcs(wcs, SHAPE)


@pytest.mark.parametrize("mask", [False, True])
def test_units_of_masked_arrays_are_refused_too(mask):
    column = MaskedColumn(np.ones(8), mask=[mask] * 8, unit="adu")
    with pytest.raises(ValueError, match="weights has the unit adu"):
        observed(weights=column)


def test_types_of_floats():
    for name in ("f4", ">f8", np.float32, "float64"):
        assert check_dtype(name) in (np.dtype(name),)
    for name in (None, "f2", "f16", "i4", "i8", "c8", "M8[s]", "nonsense", 3):
        with pytest.raises(ValueError, match="dtype is .* must be float32 or float64"):
            check_dtype(name)


def test_the_smallest_grid_and_half_a_pair():
    assert Grid.flat((1, 1), (0.2, 0.3)).shape == (1, 1)
    for pair in ((0.2, np.nan), (np.nan, 0.2)):
        with pytest.raises(ValueError, match="scale_arcsec is"):
            Grid.flat((1, 1), pair)


@pytest.mark.filterwarnings("error")
def test_signalling_nan_is_nan():
    data = IMAGE.astype(np.float32)
    data.view(np.uint32)[0, 0] = 0x7F800001  # as flipped bits leave it
    assert observed(data).weights[0, 0, 0] == 0


@pytest.mark.parametrize(
    ("psf", "remedy"), [("psf.fits", "read_psf(path)"), (abs, "FunctionPSF(function)")]
)
def test_a_psf_of_another_kind_is_refused_with_its_remedy(psf, remedy):
    with pytest.raises(ValueError, match=re.escape(remedy)):
        Observation(IMAGE, psf, GRID, weights=1.0)
