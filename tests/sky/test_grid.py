"""Grids flat and on the sky, their cutouts and boxes, and what is none."""

import gc

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from helpers.headers import (
    DEC,
    MODEL,
    OBSERVED,
    RA,
    SCALE,
    SIP,
    cd_header,
    grid_of,
    header,
    observed_headers,
    with_tables,
)

from clresample.sky.extent import grid_intersection, grid_union
from clresample.sky.grid import LAST, Grid


def test_flat_grids():
    grid = Grid.flat((4, 7), 0.5, angle_deg=30, center_arcsec=(1.0, -2.0))
    np.testing.assert_allclose(grid.sky(1.5, 3), (1.0, -2.0), atol=1e-15)
    # counter-clockwise: the column axis turns from x towards y
    step = grid.sky(0, 1) - grid.sky(0, 0)
    np.testing.assert_allclose(step, 0.5 * np.array([0.5, np.sqrt(0.75)]), atol=1e-15)
    mirrored = Grid.flat((4, 7), 0.5, angle_deg=30, flip=True)
    np.testing.assert_allclose(mirrored.sky(0, 1) - mirrored.sky(0, 0), -step, atol=1e-15)
    assert np.linalg.det(grid.jacobian) > 0 > np.linalg.det(mirrored.jacobian)
    assert grid.pixel_scale_arcsec == pytest.approx(0.5)
    rectangular = Grid.flat((4, 7), (0.5, 0.25))
    np.testing.assert_array_equal(rectangular.jacobian, np.diag([0.5, 0.25]))


@pytest.mark.parametrize("flip", [False, True])
def test_flat_mapping_is_exact(flip):
    grid_in, grid_out = Grid.flat((50, 60), 0.1), Grid.flat((20, 20), 0.2, flip=flip)
    mapping = grid_out.map_to(grid_in)
    assert (mapping.geometry, mapping.departure_px) == ("aligned", 0)
    np.testing.assert_array_equal(mapping.matrix, np.diag([2, -2 if flip else 2]))
    np.testing.assert_allclose(mapping.at(9.5, 9.5), (24.5, 29.5), atol=1e-13)
    quarter = Grid.flat((20, 20), 0.2, angle_deg=-90, flip=flip).map_to(grid_in)
    np.testing.assert_array_equal(quarter.matrix, [[0, 2 if flip else -2], [2, 0]])
    turned = Grid.flat((20, 20), 0.2, angle_deg=30, flip=flip).map_to(grid_in)
    sky = grid_in.sky(*np.moveaxis(turned.at(*np.indices((20, 20))), -1, 0))
    truth = Grid.flat((20, 20), 0.2, angle_deg=30, flip=flip).sky(*np.indices((20, 20)))
    np.testing.assert_allclose(sky, truth, atol=1e-14)


@pytest.mark.parametrize(("ra", "dec"), [(RA, DEC), (0.0, 0.0), (359.9999, -60.0), (40.0, 90.0)])
def test_flat_grids_keep_their_mapping_on_the_sky(ra, dec):
    flat_in = Grid.flat(MODEL, 0.08)
    flat_out = Grid.flat(OBSERVED, 0.2, angle_deg=33, flip=True, center_arcsec=(0.4, -1.1))
    grid_in, grid_out = (
        Grid.from_wcs(WCS(grid.to_wcs(ra_deg=ra, dec_deg=dec).to_header()), grid.shape)
        for grid in (flat_in, flat_out)
    )
    flat, placed = flat_out.map_to(flat_in), grid_out.map_to(grid_in)
    np.testing.assert_allclose(placed.matrix, flat.matrix, atol=1e-9)
    np.testing.assert_allclose(placed.offset, flat.offset, atol=1e-7)
    np.testing.assert_array_equal(placed.covered, flat.covered)
    assert grid_out.pixel_scale_arcsec == pytest.approx(0.2, rel=1e-6)
    # east is left: right ascension falls along x
    west = SkyCoord(*grid_in.sky(44.5, [44.5, 64.5]), unit="deg")
    assert west[0].position_angle(west[1]).deg % 360 == pytest.approx(270, abs=1e-2) or dec == 90


@pytest.mark.parametrize("case", ["CD", "PC+CDELT", "SIP", "TPV", "tables"])
def test_cutout_keeps_its_sky(case):
    wcs = with_tables() if case == "tables" else WCS(dict(observed_headers())[case])
    grid = Grid.from_wcs(wcs, OBSERVED)
    for y0, x0 in ((4, 9), (-2, -1)):
        cutout = grid.cutout(y0, x0, (11, 12))
        n, m = np.mgrid[2:9, 2:9]
        np.testing.assert_allclose(cutout.sky(n, m), grid.sky(n + y0, m + x0), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(grid.wcs.wcs.crpix, wcs.wcs.crpix)


def test_union_and_intersection_lie_on_the_pixels_of_one():
    like = Grid.flat((10, 10), 1.0)
    other = Grid.flat(
        (4, 30), 0.5, center_arcsec=(4.0, 6.0)
    )  # edges: rows 7.5 to 9.5, columns 3 to 18
    both = grid_union([like, other], like=like)
    shared = grid_intersection([like, other], like=like)
    assert (both.shape, shared.shape) == ((10, 19), (2, 7))
    for grid, origin in ((both, (0, 0)), (shared, (8, 3))):
        mapping = grid.map_to(like)
        np.testing.assert_array_equal(mapping.matrix, np.eye(2))
        np.testing.assert_array_equal(mapping.offset, origin)
    with pytest.raises(ValueError, match="overlap"):
        grid_intersection([like, Grid.flat((4, 4), 1.0, center_arcsec=(0, 20))], like=like)


def test_union_holds_every_pixel_on_the_sky():
    like = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    grids = [like] + [grid_of(cards, OBSERVED) for _, cards in observed_headers()]
    whole = grid_union(grids, like=like)
    for grid in grids:
        assert grid.map_to(whole).covered.all()
    assert like.map_to(whole).geometry == "aligned"
    shared = grid_intersection(grids, like=like)
    assert shared.map_to(like).covered.all()


def test_central_pixel_scale_is_the_sky_s():
    for dec in (0.0, 60.0, 90.0):
        cards = cd_header(OBSERVED, SCALE * np.array([[-1.0, 0.2], [0.1, 1.5]]), dec=dec)
        scale = grid_of(cards, OBSERVED).pixel_scale_arcsec
        assert scale == pytest.approx(0.2 * np.sqrt(1.52), rel=1e-6)


@pytest.mark.parametrize(
    ("cards", "match"),
    [
        ({}, "no celestial"),
        ({"CTYPE1": "FREQ", "CTYPE2": "VELO"}, "no celestial"),
        (cd_header(OBSERVED, np.ones((2, 2)) * SCALE), "cannot be used"),
    ],
)
def test_what_is_no_celestial_wcs(cards, match):
    wcs = WCS(fits.Header(cards))
    with pytest.raises(ValueError, match=match) as raised:
        Grid.from_wcs(wcs, OBSERVED)
    assert "\n" not in str(raised.value)


def test_what_is_no_grid():
    for scale in (0, -1, np.nan, (1, 0)):
        with pytest.raises(ValueError, match="scale_arcsec"):
            Grid.flat((4, 4), scale)
    for shape in ((0, 4), (4,), (4, 4, 4)):
        with pytest.raises(ValueError, match="shape"):
            Grid.flat(shape, 1.0)
    with pytest.raises(ValueError, match="grid_in is placed by a WCS and this grid flat"):
        Grid.flat((4, 4), 1.0).map_to(grid_of(header(MODEL), MODEL))
    thin = Grid.from_jacobian((4, 4), [[1.0, 1.0], [1.0, 1.0 + 1e-14]], (0, 0))
    with pytest.raises(ValueError, match="singular"):
        thin.map_to(Grid.flat((4, 4), 1.0))


@pytest.mark.parametrize("case", [name for name, _ in observed_headers()] + ["tables"])
def test_pixel_undoes_sky(case):
    wcs = with_tables() if case == "tables" else WCS(dict(observed_headers())[case])
    grid = Grid.from_wcs(wcs, OBSERVED)
    n, m = np.meshgrid([-3.0, 0.0, 17.3, 36.0], [-0.5, 20.75, 50.0], indexing="ij")
    back = grid.pixel(*grid.sky(n, m))
    assert back.shape == (4, 3, 2)
    np.testing.assert_allclose(back, np.stack([n, m], axis=-1), atol=1e-7)
    # right ascension first, whatever the order of the header's axes
    if case not in ("tables", "SIP", "TPV"):
        np.testing.assert_allclose(grid.pixel(RA, DEC), (18, 21.5), atol=1e-7)


def test_pixel_of_a_flat_grid_and_of_no_place():
    grid = Grid.flat((4, 7), (0.5, 0.3), angle_deg=30, flip=True, center_arcsec=(1.0, -2.0))
    np.testing.assert_allclose(grid.pixel(1.0, -2.0), (1.5, 3.0), atol=1e-14)
    sky = np.random.default_rng(2).normal(size=(2, 5))
    np.testing.assert_allclose(grid.sky(*grid.pixel(*sky).T), sky, atol=1e-14)
    for ctype in ("TAN", "SIN", "TAN-SIP"):
        cards = header(MODEL, ctype=ctype, **(SIP if ctype == "TAN-SIP" else {}))
        pixels = grid_of(cards, MODEL).pixel([RA, RA + 180, np.nan, 0], [DEC, -DEC, 0, np.inf])
        np.testing.assert_allclose(pixels[0], (44.5, 54.5), atol=1e-6)
        assert np.isnan(pixels[1:]).all()
    # so far from the image, the polynomials of SIP have no inverse (the last grid's)
    assert np.isnan(grid_of(cards, MODEL).pixel(RA, [DEC, DEC + 60])[1]).all()
    assert grid_of(cards, MODEL).pixel([], []).shape == (0, 2)


def test_the_two_kinds():
    flat, placed = Grid.flat((4, 7), 0.5, angle_deg=20), grid_of(header(MODEL), MODEL)
    assert isinstance(flat, Grid) and isinstance(placed, Grid)
    assert (flat.is_flat, flat.sky_description) == (True, "flat")
    assert (placed.is_flat, placed.sky_description) == (False, "placed by a WCS")
    for grid in (flat, placed):
        cutout = grid.cutout(1, 2, (2, 3))
        assert type(cutout) is type(grid) and cutout.shape == (2, 3)
        n, m = np.indices(cutout.shape)
        np.testing.assert_allclose(
            cutout.positions_in(grid, n, m), np.stack([n + 1, m + 2], axis=-1), atol=1e-8
        )
    flat.check_like(flat.cutout(0, 0, (1, 1)), "other")
    for one, other in ((flat, placed), (placed, flat)):
        with pytest.raises(
            ValueError,
            match=f"there is {other.sky_description} and this grid {one.sky_description}",
        ):
            one.check_like(other, "there")


def test_a_flat_grid_from_its_jacobian():
    grid = Grid.flat((4, 7), (0.5, 0.3), angle_deg=30, flip=True, center_arcsec=(1.0, -2.0))
    again = Grid.from_jacobian(grid.shape, grid.jacobian.tolist(), grid.origin.tolist())
    for name in ("shape", "jacobian", "origin"):
        np.testing.assert_array_equal(getattr(again, name), getattr(grid, name))
    for jacobian, origin, match in (
        (np.eye(3), (0, 0), r"jacobian is .*\(2, 2\)"),
        (np.diag([1, np.nan]), (0, 0), "jacobian is .*finite"),
        (np.eye(2), (0, 0, 0), r"origin is .*\(2,\)"),
        (np.eye(2), (np.inf, 0), "origin is .*finite"),
    ):
        with pytest.raises(ValueError, match=match):
            Grid.from_jacobian((4, 4), jacobian, origin)
    with pytest.raises(ValueError, match="shape"):
        Grid.from_jacobian((0, 4), np.eye(2), (0, 0))


def test_a_mapping_is_found_once_and_kept_no_longer_than_its_grids():
    wcs = Grid.flat((40, 50), 0.2, angle_deg=30).to_wcs(ra_deg=10.0, dec_deg=20.0)
    one, other = (
        Grid.from_wcs(wcs, (40, 50)),
        Grid.flat((64, 64), 0.1).to_wcs(ra_deg=10.0, dec_deg=20.0),
    )
    other = Grid.from_wcs(other, (64, 64))
    first = one.map_to(other)
    assert one.map_to(other) is first and other.map_to(one) is not first
    assert one.map_to(other, 1e-3) is not first
    again = Grid.from_wcs(wcs, (40, 50)).map_to(other)
    assert again is not first
    np.testing.assert_array_equal(again.matrix, first.matrix)
    n_kept = len(LAST)
    del one, other
    gc.collect()
    assert len(LAST) < n_kept
