"""Astronomers' own objects as arguments: coordinates, units, WCS, arrays and images."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, NDData, StdDevUncertainty
from astropy.utils.masked import Masked
from astropy.wcs.wcsapi import HighLevelWCSWrapper, SlicedLowLevelWCS

import clresample
from clresample import (
    PSF,
    ExtendedSource,
    Failure,
    Frame,
    Grid,
    NoiseWarning,
    Observation,
    PointSource,
    catalogue,
    deblend,
    model_frame,
)
from clresample.deblending.ended import Ended
from clresample.sky.validation.checks import described

SHAPE = (24, 28)
PLACED = Grid.flat(SHAPE, 0.2, angle_deg=10).to_wcs(ra_deg=150, dec_deg=2)
GRID = Grid.from_wcs(PLACED, SHAPE)
ROUND = PSF.gaussian(1.2, n_pixels=15)
NOISE = np.random.default_rng(0).normal(size=SHAPE)
PLACES = np.array([[9.0, 10.0], [15.0, 19.0]])


def light(flux=(3000.0, 2000.0)):
    """A blend (Ny, Nx) of two galaxies with noise of 1."""
    y, x = np.indices(SHAPE)
    image = NOISE.copy()
    for (y0, x0), f in zip(PLACES, flux, strict=True):
        image += f / (8 * np.pi) * np.exp(-((y - y0) ** 2 + (x - x0) ** 2) / 8)
    return image


def placed_at(y, x):
    ra, dec = GRID.sky(y, x)
    return SkyCoord(ra, dec, unit="deg")


@pytest.mark.parametrize("frame", ["icrs", "galactic", "fk5"])
@pytest.mark.parametrize("of_grid", ["icrs", "galactic"])
def test_a_source_is_where_its_coordinate_is_in_any_frame(frame, of_grid):
    wcs = PLACED.deepcopy()
    if of_grid == "galactic":
        wcs.wcs.ctype = ["GLON-TAN", "GLAT-TAN"]
        wcs.wcs.radesys = ""
        wcs.wcs.set()
    grid = Grid.from_wcs(wcs, SHAPE)
    lon, lat = grid.sky(9.5, 3.25)
    coordinate = SkyCoord(lon, lat, unit="deg", frame=of_grid).transform_to(frame)
    np.testing.assert_allclose(grid.pixel(coordinate), (9.5, 3.25), atol=1e-5)
    for kind in (ExtendedSource, PointSource):
        source = kind(sky_deg=coordinate)
        assert source.sky_frame == "icrs" and source == kind(sky_deg=coordinate.icrs)
        np.testing.assert_allclose(source.pixel(grid), (9.5, 3.25), atol=1e-5)


def test_angles_and_pixels_with_units_are_positions():
    plain = ExtendedSource(sky_deg=(150.0, 2.0))
    assert ExtendedSource(sky_deg=(150 * u.deg, 120 * u.arcmin)).sky_deg == pytest.approx(
        plain.sky_deg
    )
    assert ExtendedSource(sky_deg=[150, 2] * u.deg) == plain and plain.sky_frame is None
    assert PointSource(position_px=[3, 4] * u.pix).position_px == (3, 4)


def test_coordinates_that_are_no_place_say_the_way():
    several = SkyCoord([1, 2], [3, 4], unit="deg")
    with pytest.raises(ValueError, match=r"must be of one place: .*sky_deg=c. for c in coord"):
        ExtendedSource(sky_deg=several)
    with pytest.raises(ValueError, match="this grid is flat: give .y, x. .arcsec."):
        ExtendedSource(sky_deg=several[0]).pixel(Grid.flat(SHAPE, 0.2))
    with pytest.raises(ValueError, match="sky_frame is 'fk5', must be 'icrs' or None"):
        ExtendedSource(sky_deg=(1, 2), sky_frame="fk5")


@pytest.mark.parametrize("wcs", [PLACED, HighLevelWCSWrapper(SlicedLowLevelWCS(PLACED, ...))])
def test_a_wcs_is_a_grid_and_an_array_a_psf(wcs):
    made = Observation(NOISE, ROUND.images, wcs, weights=1.0)
    assert made.grid.shape == SHAPE
    np.testing.assert_allclose(made.grid.sky(3, 4), GRID.sky(3, 4), rtol=1e-14)
    np.testing.assert_allclose(made.psf.images, ROUND.images, rtol=1e-14)


def test_frames_take_them_too():
    wcs = PLACED.deepcopy()
    with pytest.raises(ValueError, match=r"grid is a WCS without a shape: give Grid.from_wcs\(wcs"):
        Frame(wcs, ROUND)
    wcs.array_shape = SHAPE
    frame = Frame(wcs, ROUND.images[0])
    assert frame.shape == SHAPE and frame.psf.n_bands == 1
    seen = Observation(NOISE, ROUND, GRID, weights=1.0)
    assert model_frame([seen], grid=wcs).shape == SHAPE


def test_messages_name_the_way_and_dump_no_array():
    for given, said in (
        ((NOISE, ROUND, np.eye(3)), r"grid is of type ndarray and shape .3, 3., must be Grid: give "
         r"Grid.from_wcs\(wcs, shape\)"),
        ((NOISE, "psf.fits", GRID), r"psf is 'psf.fits' \(str\), must be PSF or PSFField: give"),
        ((NDData(NOISE), ROUND, GRID), r"data is of type NDData: give Observation.from_nddata\("),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=said) as error:
            Observation(*given, weights=1.0)
        assert len(str(error.value)) < 200
    assert described(PLACED) == "of type WCS"
    assert described([1.0] * 50) == "of type list"
    with pytest.raises(ValueError, match="observations is a single one, must be a sequence"):
        deblend(Observation(NOISE, ROUND, GRID, weights=1.0), [ExtendedSource(position_px=(1, 2))])


SEEN = Observation(NOISE, ROUND, GRID, weights=1.0)
RESULT, OBSERVATION = (
    "result is .*, must be Result: give a result of deblend",
    "must be Observation",
)


@pytest.mark.parametrize(
    "function, given, said",
    [
        (clresample.catalogue, SEEN, RESULT),
        (clresample.catalogue, Failure(None, Ended.FAILED), RESULT),
        (clresample.fluxes, None, RESULT),
        (lambda given: clresample.redistribute(given, 0), SEEN, RESULT),
        (clresample.summary, [SEEN], RESULT),
        (clresample.detect_more, SEEN, RESULT),
        (lambda given: clresample.write_result("a.fits", given), SEEN, RESULT),
        (lambda given: clresample.write_catalogue("a.ecsv", given), SEEN, "table is .* Table"),
        (lambda given: clresample.write_cutouts("a.fits", given), [SEEN], "cutouts.0. .* CCDData"),
        (clresample.detect, [GRID], OBSERVATION),
        (lambda given: clresample.detect([SEEN], given), GRID, "frame is .*, must be Frame: give"),
        (clresample.model_frame, [GRID], OBSERVATION),
        (clresample.match, 5, r"observations is 5 \(int\), must be a sequence"),
        (clresample.match, [GRID], OBSERVATION),
        (clresample.deblend_many, SEEN, "blends is .*, must be a sequence"),
        (clresample.with_image_profiles, SEEN, "blend is .*, must be Blend: give Blend"),
        (lambda given: clresample.run_field(given, "run"), [SEEN], "mosaics.0. .*, must be Mosaic"),
    ],
)
def test_an_object_of_another_kind_is_named(function, given, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=said):
        function(given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "given",
    [
        {"data": NOISE * u.nJy, "variance": 0.25e-6 * u.uJy**2},
        {"data": Masked(NOISE * u.nJy, False), "weights": 4.0},
        {"data": NOISE / 1e3 * u.uJy, "unit": "nJy", "weights": 4e6 * u.uJy**-2},
        {"data": NOISE * u.nJy / u.pix, "weights": 4 * (u.pix / u.nJy) ** 2},
    ],
    ids=["Quantity", "masked", "converted", "per pixel"],
)
def test_units_of_images_noise_and_saturation_are_honoured(given):
    plain = Observation(NOISE, ROUND, GRID, weights=4.0, zero_points=31.4, saturation=900.0)
    level = 900 * u.nJy / u.pix if "pix" in str(given["data"].unit) else 0.9 * u.uJy
    found = Observation(psf=ROUND, grid=GRID, saturation=level, **given)
    assert found.unit == u.nJy
    for name in ("data", "weights", "saturation"):
        np.testing.assert_allclose(getattr(found, name), getattr(plain, name), rtol=1e-13)
    np.testing.assert_allclose(found.flux_scale, 1e-3, rtol=1e-12)


def test_counts_have_no_unit_and_a_name_of_one_does():
    assert Observation(NOISE, ROUND, GRID, weights=1.0, unit="nJy").unit == u.nJy
    for counts in (u.adu, u.electron, u.electron / u.s, u.DN):
        found = Observation(NOISE * counts, ROUND, GRID, weights=1 / counts**2, zero_points=30)
        assert found.unit is None and found.zero_points == [30]


@pytest.mark.parametrize(
    "given, said",
    [
        ({"data": NOISE * u.MJy / u.sr}, "MJy / sr, .*: multiply it by the solid angle of a pixel"),
        ({"data": NOISE * u.m}, "data has the unit m, neither a flux density nor counts"),
        ({"data": NOISE * u.nJy, "zero_points": 25.0}, "whose zero point is 31.4: give one"),
        ({"data": NOISE * u.nJy, "weights": 1 / u.m**2}, "has the unit 1 / m2, not 1 / nJy2"),
        ({"data": NOISE, "weights": 1 / u.nJy**2}, "weights has the unit"),
        ({"data": NOISE, "unit": "parsnips"}, "unit is 'parsnips', must be a unit of astropy"),
    ],
)  # fmt: skip
def test_units_that_do_not_fit_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        Observation(**({"psf": ROUND, "grid": GRID, "weights": 1.0} | given))


def test_a_list_of_weights_may_have_gaps():
    with pytest.warns(NoiseWarning, match="noise of channel r estimated .*: sigma = 1.0.* nJy$"):
        Observation(NOISE * u.nJy, ROUND, GRID, channels=["r"])
    three = np.stack([NOISE, 3 * NOISE[::-1], NOISE])
    with pytest.warns(NoiseWarning, match="noise of channel channel1 estimated .* sigma = [23]"):
        found = Observation(three, ROUND, GRID, weights=[4.0, None, np.full(SHAPE, 2.0)])
    assert (found.weights[0] == 4).all() and (found.weights[2] == 2).all()
    assert found.weights[1, 0, 0] == pytest.approx(1 / 9, rel=0.3)
    with pytest.warns(NoiseWarning):
        other = Observation(three, ROUND, GRID, variance=[0.25, None, 0.5])
    np.testing.assert_array_equal(other.weights, found.weights)
    with pytest.raises(ValueError, match="weights has 2 values, data have 3 channels"):
        Observation(three, ROUND, GRID, weights=[4.0, None])


def ccd(image=None, **given):
    given = {"unit": "nJy", "uncertainty": StdDevUncertainty(np.ones(SHAPE))} | given
    return CCDData(light() if image is None else image, wcs=PLACED, **given)


def test_astropys_images_are_observations_with_their_units(device):
    """Fluxes come in the data's unit; sources are given by coordinates, observations by name."""
    image = ccd(psf=ROUND.images[0])
    sources = [ExtendedSource(sky_deg=placed_at(*place)) for place in PLACES]
    result = deblend([image, ccd(psf=ROUND.images[0])], sources, device=device)
    assert [o.name for o in result.observations] == ["image0", "image1"]
    table = catalogue(result, magnitudes=True)
    assert table["flux_image00"].unit == table["flux_err_image00"].unit == u.nJy
    np.testing.assert_allclose(table["flux_image00"].value, (3000, 2000), rtol=0.1)
    np.testing.assert_allclose(
        table["mag_image00"].value, table["flux_image00"].to_value(u.ABmag), atol=1e-6
    )
    found = [result.index_of(key) for key in (0, 1, -1, "image0", "image1")]
    assert found == [0, 1, 1, 0, 1]
    for i, name in enumerate(("image0", "image1")):
        np.testing.assert_array_equal(result.model(name), result.model(i))
        np.testing.assert_array_equal(result.residual(name), result.residual(i))
        np.testing.assert_array_equal(result.source_model(1, name), result.source_model(1, i))
    with pytest.raises(ValueError, match="observation is 'Rubin', but no observation has"):
        result.model("Rubin")
    with pytest.raises(ValueError, match="observation is 2, must be a number below 2 or a name"):
        result.residual(2)


def test_images_of_several_units_have_one_in_the_catalogue(device):
    """uJy where they differ; counts and flux densities do not go together."""
    sources = [ExtendedSource(sky_deg=placed_at(*place)) for place in PLACES]
    one = Observation.from_nddata(ccd(), ROUND, channels=["g"], name="one")
    rest = ccd(light() / 1e3, unit="uJy", uncertainty=StdDevUncertainty(np.full(SHAPE, 1e-3)))
    two = Observation.from_nddata(rest, ROUND, channels=["r"], name="two")
    table = catalogue(deblend([one, two], sources, device=device))
    assert table["flux_g"].unit == table["flux_r"].unit == u.uJy
    np.testing.assert_allclose(table["flux_g"].value, (3.0, 2.0), rtol=0.1)
    np.testing.assert_allclose(table["flux_r"].value, table["flux_g"].value, rtol=0.02)
    counts = Observation(light(), ROUND, GRID, weights=1.0, channels=["r"], name="two")
    with pytest.raises(ValueError, match="observation 'one' has zero_points, 'two' has none"):
        deblend([one, counts], sources, device=device)


def test_images_without_a_psf_or_a_wcs_say_the_way():
    with pytest.raises(ValueError, match=r"CCDData, has no psf: give from_nddata\(image, psf\)"):
        deblend([ccd()], [ExtendedSource(position_px=(1, 2))])
    with pytest.raises(ValueError, match=r"NDData, has no wcs: set it, or give Observation\("):
        Observation.from_nddata(NDData(NOISE), ROUND)
