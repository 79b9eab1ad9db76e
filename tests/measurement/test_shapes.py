"""Centroids, sizes and angles of fitted sources, against closed forms."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from helpers.blends import SCALE, blend, gaussian, round_component
from helpers.headers import grid_of, header

from clresample.deblending.posterior.errors import Errors
from clresample.deblending.result import Component
from clresample.measurement.catalogue import catalogue
from clresample.measurement.shapes import shape, shape_slopes


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
    assert row["rms_size"].unit == u.arcsec
    np.testing.assert_allclose(row["rms_size"].value, SCALE * np.sqrt((9 + 4) / 2), rtol=1e-6)
    e = (9 - 4) / (9 + 4)
    np.testing.assert_allclose(row["e1"], e * np.cos(2 * t), atol=1e-6)
    np.testing.assert_allclose(row["e2"], e * np.sin(2 * t), atol=1e-6)
    np.testing.assert_allclose(
        (row["position_angle"].value - angle_deg + 90) % 180 - 90, 0, atol=1e-4
    )
    assert 0 <= row["position_angle"].value < 180


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
    np.testing.assert_allclose((row["position_angle"].value - angle + 90) % 180 - 90, 0, atol=0.01)
    np.testing.assert_allclose(row["rms_size"].value, 0.2 * np.sqrt(6.5), rtol=1e-5)
    for ra, dec in (("ra", "dec"), ("ra_centroid", "dec_centroid")):
        assert SkyCoord(row[ra], row[dec]).separation(one).arcsec < 1e-3


def test_components_weigh_in_moments_by_their_light_in_units_of_its_error():
    """Two Gaussians 6 px apart; channel g holds the first, r the second, with half the error."""
    parts = [round_component(0, (30, x), a) for x, a in ((32, (1.0, 0.0)), (38, (0.0, 1.0)))]
    result = blend(parts, covariance=np.array([1.0, 0.25])[:, None, None] * np.eye(2))
    row = catalogue(result)[0]
    np.testing.assert_allclose(row["x_centroid"].value, (32 + 2 * 38) / 3, rtol=1e-9)
    spread = np.sqrt(1.5**2 + 0.5 * (4**2 + 2 * 2**2) / 3)
    np.testing.assert_allclose(row["rms_size"].value, SCALE * spread, rtol=1e-6)
    dark = [round_component(0, (30, x), (0, 0)) for x in (32, 38)]
    np.testing.assert_allclose(catalogue(blend(dark))["x_centroid"][0].value, 35, rtol=1e-12)


def test_slopes_of_shapes_are_finite_differences():
    second = np.array([[5.0, 0.7], [0.7, 3.0]])
    axes = np.array([[0.1, 0.02], [-0.03, -0.12]])
    found, e = shape_slopes(second, axes), 1e-5
    for i, (a, b) in enumerate(((0, 0), (1, 0), (1, 1))):
        change = np.zeros((2, 2))
        change[a, b] = change[b, a] = e
        up, down = (shape(axes @ (second + s * change) @ axes.T) for s in (1, -1))
        np.testing.assert_allclose(found[:, i], np.subtract(up, down) / (2 * e), rtol=1e-5)
    assert np.isnan(shape_slopes(np.zeros((2, 2)), axes)).all()


@pytest.mark.parametrize("cards", [{}, {"CROTA2": 33.0}, {"ra": 0.0, "dec": 60.0}])
def test_errors_of_positions_on_the_sky(cards):
    """Those of the pixel position, in degrees of right ascension and of declination."""
    grid = grid_of(header((60, 70), **cards), (60, 70))
    component = round_component(0, (30, 34), [1.0, 2.0])
    pixel = np.array([[0.04, 0.01], [0.01, 0.09]])
    covariance = np.zeros((1, 5, 5))
    covariance[0, :2, :2], covariance[0, 2:, 2:] = pixel, 0.01 * np.eye(3)
    flux = np.ones((2, 1, 1))
    maps = (component.morphology,)
    unbound = np.zeros((1, 2)), np.zeros((1, 5)), np.zeros((1, 2))
    errors = Errors(flux, np.ones((1, 2, 2)), covariance, maps, np.zeros((1, 6)), *unbound)
    row = catalogue(blend([component], grid=grid, errors=errors))[0]
    assert row["y_centroid_err"].value == pytest.approx(0.2)
    assert row["x_centroid_err"].value == pytest.approx(0.3)
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal([30, 34], pixel, 20000)
    lon, lat = grid.sky(*drawn.T)
    lon = (lon - lon[0] + 180) % 360 - 180
    assert row["ra_centroid_err"].to_value("deg") == pytest.approx(np.std(lon), rel=0.03)
    assert row["dec_centroid_err"].to_value("deg") == pytest.approx(np.std(lat), rel=0.03)
    assert row["flux_err_g"].value == 1
    assert row["position_angle_err"].value == pytest.approx(180 / np.sqrt(12))  # a round source's


def test_shapes_are_without_what_the_bound_adds():
    """Unless nothing would be left."""
    component = round_component(0, (30, 34), [1.0, 2.0])
    given = np.zeros((1, 5, 5)), (component.morphology,), np.zeros((1, 6)), np.zeros((1, 2))
    moved = np.array([[0.1, -0.2, -0.5, 0.25, -0.125]])
    rows = []
    for by in (0, 1, 100):
        last = by * moved, np.zeros((1, 2))
        errors = Errors(np.ones((2, 1, 1)), np.ones((1, 2, 2)), *given, *last)
        rows.append(catalogue(blend([component], errors=errors))[0])
    plain, changed, kept = rows
    for axis, by in (("y", 0.1), ("x", -0.2)):
        name = f"{axis}_centroid"
        assert (changed[name] - plain[name]).value == pytest.approx(by)
    assert changed["rms_size"] < plain["rms_size"] and changed["e2"] != plain["e2"]
    assert kept["rms_size"] == plain["rms_size"] and kept["y_centroid"] == plain["y_centroid"]


def test_a_single_pixel_has_size_0_and_no_ellipticity():
    """Without any division by 0."""
    with np.errstate(all="raise"):
        size, *others = shape(np.zeros((2, 2)))
        slopes = shape_slopes(np.zeros((2, 2)), np.eye(2))
    assert size == 0 and np.isnan(others).all()
    assert slopes.shape == (4, 3) and np.isnan(slopes).all()
    assert shape(-np.eye(2))[0] == 0  # what rounding can leave
