"""What is measured on a fitted model, against closed forms."""

import json

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from helpers.blends import SCALE, blend, gaussian, observe, round_component
from helpers.headers import SIP, grid_of, header

from clresample.deblending.result import Component
from clresample.measurement.catalogue import MEANINGS, Flag, catalogue
from clresample.measurement.photometry import fluxes, redistribute
from clresample.measurement.quality import labels, summary
from clresample.sky.footprint import Footprint, open_edge
from clresample.sky.grid import Grid
from clresample.sky.sources import Extended, Point

MIDDLE = (30.0, 35.0)


def two_sources(**given):
    """A bulge and a disk about one centre, and a neighbour."""
    return blend(
        [
            round_component(0, (30, 28), (2.0, 1.0)),
            round_component(0, (30, 28), (0.5, 3.0), n=31, sigma=2.5),
            round_component(1, (30, 44), (1.0, 4.0)),
        ],
        **given,
    )


# fluxes


def test_fluxes_add_up_over_components_with_their_covariances():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    result = two_sources(covariance=covariance)
    flux, found = fluxes(result)
    a, b, c = (component.morphology.sum() for component in result.components)
    np.testing.assert_allclose(flux, [[2 * a + 0.5 * b, a + 3 * b], [c, 4 * c]], rtol=1e-14)
    v = covariance
    np.testing.assert_allclose(
        found[:, 0, 0],
        a**2 * v[:, 0, 0] + b**2 * v[:, 1, 1] + 2 * a * b * v[:, 0, 1],
        rtol=1e-13,
    )
    np.testing.assert_allclose(found[:, 0, 1], a * c * v[:, 0, 2] + b * c * v[:, 1, 2], rtol=1e-12)
    np.testing.assert_allclose(found, found.transpose(0, 2, 1), rtol=1e-12)
    table = catalogue(result)
    np.testing.assert_allclose(table["flux_err_r"].value, np.sqrt([found[1, 0, 0], found[1, 1, 1]]))
    snr = np.sqrt((flux**2 / np.diagonal(found, axis1=1, axis2=2).T).sum(axis=1))
    np.testing.assert_allclose(table["snr"], snr, rtol=1e-13)


def test_a_gaussians_flux_and_error_are_the_closed_ones():
    # variance A of a spectrum of one Gaussian in white noise: 1 / sum w S^2 = 1 / (w pi sigma^2)
    weight, sigma = 4.0, 1.5
    variance = 1 / (weight * np.pi * sigma**2)
    covariance = variance * np.ones((2, 1, 1))
    table = catalogue(blend([round_component(0, MIDDLE, (3.0, 5.0))], covariance=covariance))
    np.testing.assert_allclose(table["flux_r"].value, 5 * 2 * np.pi * sigma**2, rtol=1e-7)
    np.testing.assert_allclose(
        table["flux_err_r"].value, 2 * np.sqrt(np.pi / weight) * sigma, rtol=1e-7
    )
    assert table["flux_r"].unit == u.ct


def test_zero_points_bring_fluxes_into_one_system():
    grid = Grid.flat((60, 70), SCALE)
    observations = (
        observe(grid, ("g", "r"), zero_points=[23.9, 28.9], name="one"),
        observe(grid, ("i",), zero_points=21.4, name="two"),
    )
    result = blend([round_component(0, MIDDLE, (1, 1, 0))], observations=observations)
    table = catalogue(result, magnitudes=True)
    counts = result.components[0].morphology.sum()
    for channel, scale, flux in (("g", 1, 1), ("r", 0.01, 1), ("i", 10, 0)):
        assert table[f"flux_{channel}"].unit == table[f"flux_err_{channel}"].unit == u.uJy
        found = [table[f"flux_{channel}"].value[0], table[f"flux_err_{channel}"].value[0]]
        np.testing.assert_allclose(found, [flux * scale * counts, scale * counts], rtol=1e-13)
    magnitude = table["flux_r"].to(u.ABmag).value
    np.testing.assert_allclose(table["mag_r"].value, magnitude, atol=1e-12)
    np.testing.assert_allclose(table["mag_err_g"].value, 1.0857362, rtol=1e-7)
    assert np.isnan(table["mag_i"]).all()
    assert "mag_g" not in catalogue(result).colnames
    assert "mag_g" not in catalogue(two_sources(), magnitudes=True).colnames


def test_channels_that_determine_no_flux_have_infinite_errors():
    covariance = np.tile(np.eye(3) + 0.1, (2, 1, 1))
    covariance[0, 1] = covariance[0, :, 1] = np.nan
    covariance[0, 1, 1] = np.inf
    result = two_sources(covariance=covariance)
    table = catalogue(result)
    assert np.isinf(table["flux_err_g"][0])
    assert np.isfinite([table["flux_err_g"][1].value, table["flux_err_r"][0].value]).all()
    assert list(table["flags"]) == [Flag.NO_COVERAGE, 0]
    a, b, c = (component.morphology.sum() for component in result.components)
    error = np.sqrt(1.1 * (a**2 + b**2) + 0.2 * a * b)
    np.testing.assert_allclose(table["snr"][0], (a + 3 * b) / error, rtol=1e-13)
    np.testing.assert_allclose(fluxes(result)[1][0], [[np.inf, 0], [0, 1.1 * c**2]])


# positions and shapes


@pytest.mark.parametrize("angle_deg", [0.0, 25.0, 90.0, 160.0])
def test_moments_of_an_elliptical_gaussian(angle_deg):
    """On a flat sky y is north and x west, so that east of north turns from +y to -x."""
    long, short, center = 3.0, 2.0, np.array([30.3, 34.8])
    t = np.radians(angle_deg)
    axis = np.array([np.cos(t), -np.sin(t)])
    other = np.array([np.sin(t), np.cos(t)])
    second = long**2 * np.outer(axis, axis) + short**2 * np.outer(other, other)
    origin = (5, 8)
    image = gaussian((50, 55), center - origin, second)
    row = catalogue(blend([Component(0, origin, image, np.array([1.0, 2.0]))]))[0]
    found = [row["y_centroid"].value, row["x_centroid"].value]
    np.testing.assert_allclose(found, center, atol=1e-6)
    sky = SCALE * (center - [29.5, 34.5])
    found = [row["y_sky_centroid"].value, row["x_sky_centroid"].value]
    np.testing.assert_allclose(found, sky, atol=1e-7)
    assert row["size"].unit == u.arcsec
    np.testing.assert_allclose(row["size"].value, SCALE * np.sqrt((9 + 4) / 2), rtol=1e-6)
    e = (9 - 4) / (9 + 4)
    np.testing.assert_allclose(row["e1"], e * np.cos(2 * t), atol=1e-6)
    np.testing.assert_allclose(row["e2"], e * np.sin(2 * t), atol=1e-6)
    np.testing.assert_allclose((row["angle"].value - angle_deg + 90) % 180 - 90, 0, atol=1e-4)
    assert 0 <= row["angle"].value < 180


@pytest.mark.parametrize("cards", [{}, {"CROTA2": 33.0}, {"CDELT1": 0.2 / 3600}, {"dec": 89.9}])
def test_angles_on_the_sky_are_east_of_north(cards):
    """Stretched along the line to a neighbour, whose position angle astropy knows."""
    grid = grid_of(header((60, 70), **cards), (60, 70))
    here, there = np.array([30.0, 35.0]), np.array([34.0, 47.0])
    axis = (there - here) / np.linalg.norm(there - here)
    other = np.array([-axis[1], axis[0]])
    image = gaussian((51, 51), (25, 25), 9 * np.outer(axis, axis) + 4 * np.outer(other, other))
    result = blend([Component(0, (5, 10), image, np.ones(2))], grid=grid)
    row = catalogue(result)[0]
    one, two = (SkyCoord(*grid.sky(*p), unit="deg") for p in (here, there))
    angle = one.position_angle(two).deg
    np.testing.assert_allclose((row["angle"].value - angle + 90) % 180 - 90, 0, atol=0.01)
    np.testing.assert_allclose(row["size"].value, 0.2 * np.sqrt(6.5), rtol=1e-5)
    for ra, dec in (("ra", "dec"), ("ra_centroid", "dec_centroid")):
        assert SkyCoord(row[ra], row[dec]).separation(one).arcsec < 1e-3


def test_components_weigh_in_moments_by_their_light_in_units_of_its_error():
    """Two Gaussians 6 px apart; channel g holds the first, r the second, with half the error."""
    parts = [round_component(0, (30, x), a) for x, a in ((32, (1.0, 0.0)), (38, (0.0, 1.0)))]
    result = blend(parts, covariance=np.array([1.0, 0.25])[:, None, None] * np.eye(2))
    row = catalogue(result)[0]
    np.testing.assert_allclose(row["x_centroid"].value, (32 + 2 * 38) / 3, rtol=1e-9)
    spread = np.sqrt(1.5**2 + 0.5 * (4**2 + 2 * 2**2) / 3)
    np.testing.assert_allclose(row["size"].value, SCALE * spread, rtol=1e-6)
    dark = [round_component(0, (30, x), (0, 0)) for x in (32, 38)]
    np.testing.assert_allclose(catalogue(blend(dark))["x_centroid"][0].value, 35, rtol=1e-12)


def test_names_and_frame_are_those_of_the_wcs():
    cards = header((60, 70), CTYPE1="GLON-TAN", CTYPE2="GLAT-TAN")
    result = blend([round_component(0, MIDDLE, (1, 1))], grid=grid_of(cards, (60, 70)))
    table = catalogue(result)
    assert {"glon", "glat_centroid"} <= set(table.colnames)
    assert table.meta["frame"] == "galactic"
    assert list(catalogue(two_sources())["name"]) == ["0", "1"]


# chi2


def test_chi2_in_the_box_counts_weighted_pixels_of_the_box_only():
    grid = Grid.flat((60, 70), SCALE)
    data = np.full((2, 60, 70), 7.0)  # far off outside of the box
    box = (slice(20, 41), slice(25, 46))
    data[:, *box] = np.array([2.0, 3.0])[:, None, None]
    weights = np.full((2, 60, 70), 0.5)
    weights[1, 20:41, 25:30] = 0
    observation = observe(grid, ("g", "r"), data=data, weights=weights, name="cam")
    result = blend([round_component(0, MIDDLE, (0, 0))], observations=(observation,))
    expected = 0.5 * (21 * 21 * 4 + 21 * 16 * 9) / (21 * 21 + 21 * 16)
    np.testing.assert_allclose(catalogue(result)["chi2_cam"], expected, rtol=1e-13)


@pytest.mark.parametrize("angle_deg, shift", [(0, (0, 0)), (30, (0, 0)), (30, (3.0, -2.0))])
def test_boxes_are_projected_by_the_mapping_and_the_shift(angle_deg, shift):
    """Residual 1 where the pixel's true place is in the box, huge elsewhere."""
    grid = Grid.flat((60, 70), SCALE)
    coarse = Grid.flat((20, 22), 0.3, angle_deg=angle_deg, flip=True)
    y, x = np.array([29.5, 34.5])[:, None, None] + coarse.sky(*np.indices(coarse.shape)) / SCALE
    y, x = y + shift[0], x + shift[1]
    inside = (y >= 19.5) & (y < 40.5) & (x >= 24.5) & (x < 45.5)
    observation = observe(coarse, ("g",), data=np.where(inside, 1.0, 1e3), weights=2.0)
    component = round_component(0, MIDDLE, (1.0,))
    result = blend([component], grid=grid, observations=(observation,), shifts=np.array([shift]))
    np.testing.assert_allclose(catalogue(result)["chi2_observation0"], 2.0, rtol=1e-13)


def test_pixels_without_a_model_do_not_count_in_a_box():
    """Two rings of pixels off the frame; a shift puts some on it, but they have no model."""
    data = np.full((1, 64, 74), 1e3)
    data[:, 2:-2, 2:-2] = 2.0
    observation = observe(Grid.flat((64, 74), SCALE), ("g",), data=data)
    component = round_component(0, (10, 35), (0,))
    result = blend([component], observations=[observation], shifts=np.array([[2.0, 0]]))
    np.testing.assert_allclose(catalogue(result)["chi2_observation0"], 4.0, rtol=1e-13)


def test_labels_are_unique():
    grid = Grid.flat((60, 70), SCALE)
    observations = [
        observe(grid, (c,), name=name) for c, name in zip("abcd", ("hst", None, "hst", "hsc"))
    ]
    result = blend([round_component(0, MIDDLE, np.ones(4))], observations=observations)
    assert labels(result) == ["hst0", "observation1", "hst2", "hsc"]


# flags


def one(center=MIDDLE, **given):
    return blend([round_component(0, center, (1, 1))], **given)


def flags(result):
    return [Flag(value) for value in catalogue(result)["flags"]]


def test_a_good_source_has_no_flag():
    assert flags(two_sources()) == [Flag(0), Flag(0)]


def test_every_flag_has_a_meaning_and_a_bit_of_its_own():
    assert set(MEANINGS) == set(Flag)
    assert sorted(flag.value for flag in Flag) == [1 << i for i in range(len(Flag))]
    assert Flag(np.int32(3)) == Flag.EDGE | Flag.NOT_CONVERGED


def test_edge_is_light_at_the_frames_edge_not_a_box():
    assert flags(blend([round_component(0, (14, 35), (1, 1), n=29)])) == [Flag(0)]
    wide = round_component(0, (14, 35), (1, 1), n=29, sigma=4.8)  # 1.4 % of the peak on row 0
    assert flags(blend([wide])) == [Flag.EDGE]
    narrow = round_component(0, (14, 35), (1, 1), n=29, sigma=4.4)  # 0.6 %
    assert flags(blend([narrow])) == [Flag(0)]


def test_edge_is_light_beside_sky_that_no_observation_saw():
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[:, :, 38:] = 0
    assert flags(one(observations=[observe(grid, ("g", "r"), weights=weights)])) == [Flag.EDGE]
    weights[1] = 1  # one channel sees it
    assert flags(one(observations=[observe(grid, ("g", "r"), weights=weights)])) == [Flag(0)]
    half = Grid.flat((30, 19), 0.2, center_arcsec=(0, -1.6))  # ends at column 37
    assert flags(one(observations=[observe(half, ("g", "r"))])) == [Flag.EDGE]
    holes = np.ones((2, 60, 70))
    holes[:, 31:34, 36:39] = 0  # a masked patch is no edge
    assert flags(one(observations=[observe(grid, ("g", "r"), weights=holes)])) == [Flag(0)]


def test_masked_is_the_centres_own_pixel():
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[1, 30, 36] = 0
    observations = [observe(grid, ("g", "r"), weights=weights)]
    for x, expected in ((35.4, 0), (35.6, Flag.MASKED), (36.4, Flag.MASKED), (36.6, 0)):
        sources = (Extended(position_px=(30.0, x)),)
        assert flags(one(observations=observations, sources=sources)) == [Flag(expected)]


def test_no_coverage_is_a_centre_off_an_image():
    full = observe(Grid.flat((60, 70), SCALE), ("g",))
    left = observe(Grid.flat((30, 17), 0.2, center_arcsec=(0, -1.8)), ("r",))  # to column 33
    assert flags(one(observations=[full, left])) == [Flag.NO_COVERAGE]
    assert flags(one((30, 33), observations=[full, left])) == [Flag(0)]
    moved = np.array([[0, 0], [0, 3.0]])  # its pixels lie 3 px further right than its WCS says
    assert flags(one(observations=[full, left], shifts=moved)) == [Flag(0)]


def test_zero_flux_and_not_converged():
    assert flags(blend([round_component(0, MIDDLE, (1, 0))])) == [Flag.ZERO_FLUX]
    covariance = np.array([1, np.inf])[:, None, None]
    unseen = blend([round_component(0, MIDDLE, (1, 0))], covariance=covariance)
    assert flags(unseen) == [Flag.NO_COVERAGE]
    assert flags(one(status="iteration limit")) == [Flag.NOT_CONVERGED]


def test_a_source_outside_the_frame_is_listed_and_not_measured():
    sources = (Extended(position_px=MIDDLE), Point(position_px=(30.0, 90.0), name="far"))
    table = catalogue(one(sources=sources))
    assert list(table["flags"]) == [0, Flag.OUTSIDE]
    assert table["name"][1] == "far"
    assert table["x"][1] == 90 * u.pix
    for name in table.colnames:
        if name not in ("name", "flags", "y", "x", "y_sky", "x_sky"):
            value = u.Quantity(table[name]).value[1]
            assert np.isinf(value) if "err" in name else np.isnan(value), name


def test_nothing_fitted_is_still_a_catalogue():
    data = np.full((2, 60, 70), 3.0)
    observation = observe(Grid.flat((60, 70), SCALE), ("g", "r"), data=data)
    far = (Point(position_px=(30.0, 90.0)),)
    result = blend([], sources=far, observations=[observation], sky=np.array([1.0, 3.0]))
    assert flags(result) == [Flag.OUTSIDE]
    assert summary(result)["chi2"] == {"g": 4.0, "r": 0.0}
    assert not redistribute(result, 0).any()
    assert len(catalogue(blend([], sources=()))) == 0


def test_a_failed_fit_with_nan_is_still_a_catalogue():
    table = catalogue(blend([round_component(0, MIDDLE, (np.nan, 1))], status="failed: NaN"))
    assert table["flags"][0] & Flag.NOT_CONVERGED
    assert np.isnan(table["flux_g"][0]) and np.isnan(table["size"][0])


# footprints


def test_locate_inverts_the_mapping_of_a_distorted_image():
    grid = grid_of(header((60, 70)), (60, 70))
    strong = {key: 20 * value if "_ORDER" not in key else value for key, value in SIP.items()}
    cards = header((40, 44), scale=0.3 / 3600, ctype="TAN-SIP", CROTA2=20, **strong)
    seen = grid_of(cards, (40, 44))
    shifts = np.array([[0.4, -1.3]])
    result = one(grid=grid, observations=[observe(seen, ("g", "r"))], shifts=shifts)
    footprint = Footprint.of(result, 0)
    assert footprint.mapping.kind == "distorted"
    truth = np.array([[20.0, 22.0], [8.3, 30.6], [25.2, 11.9]])
    points = grid.pixel(*seen.sky(*truth.T)) + [0.4, -1.3]
    np.testing.assert_allclose(footprint.locate(points), truth, atol=0.01)
    assert footprint.weighted(points).shape == (2, 3)
    np.testing.assert_array_equal(footprint.holds([[30, 35], [np.nan, 0], [500, 500]]), [1, 0, 0])


def test_the_open_edge_of_a_frame_that_is_all_seen_is_its_border():
    expected = np.ones((60, 70), bool)
    expected[1:-1, 1:-1] = False
    footprint = Footprint.of(one(), 0)
    np.testing.assert_array_equal(open_edge([footprint], (60, 70)), expected)


# the whole blend


def test_summary_holds_the_blends_figures_as_json():
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[0, :30], weights[1] = 0, 0
    wide = observe(Grid.flat((62, 72), SCALE), ("i",), data=2.0, weights=3.0, name="wide")
    observations = [observe(grid, ("g", "r"), data=1.5, weights=weights, name="cam"), wide]
    result = blend(
        [round_component(0, MIDDLE, (0, 0, 0))],
        observations=observations,
        sky=np.array([1.0, 0, 0]),
        shifts=np.array([[0, 0], [0.25, -1.5]]),
        seconds={"fit": np.float32(0.5)},
        messages=("one",),
    )
    found = summary(result)
    assert found["n_pixels"] == {"g": 30 * 70, "r": 0, "i": 60 * 70}  # not off the frame
    np.testing.assert_allclose([found["chi2"]["g"], found["chi2"]["i"]], [0.25, 12], rtol=1e-13)
    assert np.isnan(found["chi2"]["r"])
    assert found["shifts"] == {"cam": [0, 0], "wide": [0.25, -1.5]}
    assert found["losses"] == [100, 10, 9] and found["n_iterations"] == 2
    assert (found["n_sources"], found["n_fitted"], found["n_components"]) == (1, 1, 1)
    assert json.loads(json.dumps(found))["seconds"] == {"fit": 0.5}


def test_shares_add_up_to_the_data_in_the_models_proportions():
    rng = np.random.default_rng(5)
    data = rng.normal(5, 1, (2, 60, 70))
    weights = np.ones(data.shape)
    weights[0, 30, 30] = 0
    grid = Grid.flat((60, 70), SCALE)
    sky = np.array([0.5, -0.5])
    observations = [observe(grid, ("g", "r"), data=data, weights=weights)]
    result = two_sources(observations=observations, sky=sky)
    shares = redistribute(result, 0)
    assert np.isnan(shares[:, 0, 30, 30]).all() and np.isnan(shares).sum() == 2
    total = np.array([result.source_model(i, 0) for i in range(2)]).sum(axis=0)
    lit = (total > 1e-5 * total.max(axis=(1, 2), keepdims=True)) & (weights > 0)
    above = data - sky[:, None, None]
    np.testing.assert_allclose(shares.sum(axis=0)[lit], above[lit], rtol=1e-12)
    assert not np.nan_to_num(shares[:, ~lit]).any() and (~lit).sum() > 1000
    np.testing.assert_allclose(
        shares[1, 1, 30, 40] / shares[0, 1, 30, 40],
        result.source_model(1, 0)[1, 30, 40] / result.source_model(0, 0)[1, 30, 40],
        rtol=1e-12,
    )


def test_rounding_below_zero_gets_no_share():
    result = two_sources(observations=[observe(Grid.flat((60, 70), SCALE), ("g", "r"), data=1.0)])
    result.rendered[0][2, :, 30, 28] = -1e-7
    shares = redistribute(result, 0)
    assert (shares >= 0).all() and shares[0, 0, 30, 28] == 1
