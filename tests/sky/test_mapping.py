"""Mappings against two WCS evaluated pixel by pixel, and how far they may be simplified."""

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
    true_positions,
    with_tables,
)

from clresample.sky import grid as grid_module
from clresample.sky.grid import Grid
from clresample.sky.mapping import NOISE_PX
from clresample.sky.wcs import pixel_to_world


@pytest.mark.parametrize("model", ["TAN", "SIP"])
@pytest.mark.parametrize(
    ("name", "cards"), [pytest.param(*case, id=case[0]) for case in observed_headers()]
)
def test_mapping_is_that_of_the_two_wcs(name, cards, model):
    extra = dict(SIP, ctype="TAN-SIP") if model == "SIP" else {}
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5, **extra), MODEL)
    grid_out = grid_of(cards, (3, *OBSERVED))
    true = true_positions(grid_out, grid_in)
    mapping = grid_out.map_to(grid_in)
    assert (mapping.shape_in, mapping.shape_out) == (MODEL, OBSERVED)
    distorted = name in ("SIP", "TPV") or model == "SIP"
    assert (mapping.geometry == "distorted") == distorted
    found = mapping.at(*np.indices(OBSERVED))
    inside = ((true >= -0.5 - NOISE_PX) & (true <= np.array(MODEL) - 0.5 + NOISE_PX)).all(axis=-1)
    assert inside.mean() > 0.5
    error = np.hypot(*(found - true)[inside].T).max()
    assert error < (1e-7 if distorted else 1e-4)
    np.testing.assert_array_equal(mapping.covered, inside)

    # a looser tolerance takes the affine fit, and states what it leaves
    affine = grid_out.map_to(grid_in, tolerance_px=10.0)
    assert affine.geometry in ("affine", "aligned")
    departure = np.hypot(*(affine.at(*np.indices(OBSERVED)) - true)[inside].T).max()
    assert departure <= 1.02 * affine.departure_px + NOISE_PX
    if distorted:
        assert departure > 0.5 * affine.departure_px > 5e-5


def test_area_is_the_local_determinant():
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    grid_out = grid_of(header(OBSERVED, ctype="TAN-SIP", CROTA2=17.0, **SIP), OBSERVED)
    mapping = grid_out.map_to(grid_in)
    y, x = np.indices(OBSERVED, dtype=float)
    step = 0.05  # px

    def at(y, x):
        world = grid_out.wcs.all_pix2world(x, y, 0)
        return np.array(grid_in.wcs.all_world2pix(*world, 0, tolerance=1e-9))[::-1]

    (a, c), (b, d) = (
        (at(y + step * i, x + step * j) - at(y - step * i, x - step * j)) / (2 * step)
        for i, j in ((1, 0), (0, 1))
    )
    det = mapping.area * abs(np.linalg.det(mapping.matrix))
    # third derivatives over one pixel, 4e-7 of SIP here
    np.testing.assert_allclose(det, np.abs(a * d - b * c), rtol=1e-5)
    assert np.ptp(mapping.area) > 1e-3


def test_many_pixels_go_in_blocks(monkeypatch):
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    grid_out = grid_of(header(OBSERVED, ctype="TAN-SIP", **SIP), OBSERVED)
    whole = grid_out.map_to(grid_in)
    monkeypatch.setattr("clresample.sky.mapping.BLOCK", 200)  # four rows at a time
    blocks = grid_out.map_to(grid_in)
    np.testing.assert_allclose(blocks.positions, whole.positions, atol=1e-9)
    np.testing.assert_allclose(blocks.area, whole.area, atol=1e-9)


def test_one_distorted_pixel_has_an_area():
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    grid_out = grid_of(header(OBSERVED, ctype="TAN-SIP", **SIP), OBSERVED)
    whole = grid_out.map_to(grid_in)
    one = grid_out.cutout(5, 7, (1, 1)).map_to(grid_in, tolerance_px=1e-9)
    assert one.geometry == "distorted"
    np.testing.assert_allclose(one.positions[0, 0], whole.positions[5, 7], atol=1e-7)
    det = [abs(np.linalg.det(m.matrix)) for m in (one, whole)]
    assert one.area[0, 0] * det[0] == pytest.approx(whole.area[5, 7] * det[1], rel=1e-7)


@pytest.mark.parametrize("cards", [pytest.param(c, id=name) for name, c in observed_headers()])
def test_a_grid_maps_to_itself_exactly(cards):
    grid = grid_of(cards, OBSERVED)
    for other, offset in ((grid, (0, 0)), (grid.cutout(-3, 5, (60, 20)), (3, -5))):
        mapping = grid.map_to(other)
        assert mapping.geometry == "aligned" and mapping.departure_px < NOISE_PX
        np.testing.assert_array_equal(mapping.matrix, np.eye(2))
        np.testing.assert_array_equal(mapping.offset, offset)


def test_half_turns_and_mirrors_are_exact():
    for sign in ((-1, 1), (1, -1), (-1, -1)):
        turned = cd_header((20, 20), SCALE * np.diag([-sign[1], sign[0]]))
        mapping = grid_of(turned, (20, 20)).map_to(grid_of(header((20, 20)), (20, 20)))
        np.testing.assert_array_equal(mapping.matrix, np.diag(sign))
        np.testing.assert_array_equal(mapping.offset, [19 * (s < 0) for s in sign])


@pytest.mark.parametrize(("frame", "radesys"), [("fk5", "FK5"), ("galactic", None)])
def test_celestial_frames_are_converted(frame, radesys):
    place = SkyCoord(RA, DEC, unit="deg").transform_to(frame).spherical
    at = {"ra": place.lon.deg, "dec": place.lat.deg}
    if radesys is None:
        cards = header(OBSERVED, CTYPE1="GLON-TAN", CTYPE2="GLAT-TAN", **at)
    else:
        cards = header(OBSERVED, RADESYS=radesys, EQUINOX=2000.0, **at)
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5, RADESYS="ICRS"), MODEL)
    mapping = grid_of(cards, OBSERVED).map_to(grid_in)
    # the same point of the sky is the reference point of both
    centre = mapping.at(*((np.array(OBSERVED) - 1) / 2))
    np.testing.assert_allclose(centre, (np.array(MODEL) - 1) / 2, atol=1e-5)
    y, x = np.indices(OBSERVED)
    sky = SkyCoord(*WCS(cards).all_pix2world(x, y, 0), unit="deg", frame=frame).icrs
    true = np.array(grid_in.wcs.all_world2pix(sky.ra.deg, sky.dec.deg, 0))[::-1]
    np.testing.assert_allclose(np.moveaxis(mapping.at(y, x), -1, 0), true, atol=1e-4)


@pytest.mark.parametrize("quarter", [0, 90, 180, 270])
def test_rotation_that_moves_no_pixel_is_none(quarter):
    tolerance = 1e-3
    n = 51
    radius = np.hypot(n / 2, n / 2) * 2  # the outer corner [model px]
    grid_in = Grid.flat((200, 200), 0.1)
    for flip in (False, True):
        for part, geometry in ((0.9, "aligned"), (-0.9, "aligned"), (1.2, "affine")):
            angle = quarter + np.degrees(part * tolerance / radius)
            grid_out = Grid.flat((n, n), 0.2, angle_deg=angle, flip=flip)
            mapping = grid_out.map_to(grid_in, tolerance_px=tolerance)
            assert mapping.geometry == geometry
            if geometry == "aligned":
                assert np.count_nonzero(mapping.matrix) == 2
                assert mapping.departure_px == pytest.approx(0.9 * tolerance, rel=1e-3)
                # the error is spread about the stamp's centre, which stays where it is
                np.testing.assert_allclose(mapping.at(25, 25), (99.5, 99.5), atol=1e-9)


def test_a_shear_counts_as_a_rotation_does():
    for shear, geometry in ((1e-6, "aligned"), (1e-4, "affine")):
        grid_out = grid_of(cd_header(OBSERVED, SCALE * np.array([[-1, shear], [0, 1]])), OBSERVED)
        mapping = grid_out.map_to(grid_of(header(MODEL, scale=SCALE / 2.5), MODEL))
        assert mapping.geometry == geometry


def test_coverage_is_geometry():
    grid_in = Grid.flat((10, 12), 1.0)
    mapping = Grid.flat((14, 14), 1.0).map_to(grid_in)
    covered = np.zeros((14, 14), dtype=bool)
    covered[2:12, 1:13] = True
    np.testing.assert_array_equal(mapping.covered, covered)
    far = Grid.flat((14, 14), 1.0, center_arcsec=(0, 40)).map_to(grid_in)
    assert not far.covered.any()


def test_no_overlap_is_no_coverage_and_the_other_sky_an_error():
    grid_in = grid_of(header(MODEL), MODEL)
    for dec in (DEC + 0.1, DEC + 40, -DEC - 20):
        assert not grid_of(header(OBSERVED, dec=dec), OBSERVED).map_to(grid_in).covered.any()
    with pytest.raises(ValueError, match="overlap"):
        grid_of(header(OBSERVED, ra=RA - 180, dec=-DEC), OBSERVED).map_to(grid_in)


def test_only_what_the_model_covers_counts(monkeypatch):
    """A stamp in a distorted frame: affine where it lies, whatever the frame does elsewhere."""
    frame = (4000, 4000)
    cards = header(frame, ctype="TAN-SIP", A_ORDER=2, A_2_0=1e-7, B_ORDER=2, B_1_1=-1e-7)
    grid_out = grid_of(cards, frame)
    y, x = 700, 3100
    lon, lat = grid_out.sky(y, x)
    grid_in = grid_of(header((64, 64), ra=lon, dec=lat, scale=SCALE / 2), (64, 64))
    evaluated = []
    monkeypatch.setattr(
        grid_module,
        "pixel_to_world",
        lambda wcs, n, m: evaluated.append(np.size(n)) or pixel_to_world(wcs, n, m),
    )
    mapping = grid_out.map_to(grid_in, tolerance_px=1e-3)
    assert sum(evaluated) < 10_000  # not at 16 million pixels
    assert mapping.geometry == "affine"
    np.testing.assert_allclose(mapping.at(y, x), (31.5, 31.5), atol=1e-3)
    assert mapping.covered.sum() == pytest.approx(32 * 32, abs=80)
    assert mapping.covered[y, x]
    whole = grid_of(header(frame, scale=SCALE), frame)
    assert (
        grid_out.cutout(0, 0, (200, 200)).map_to(whole, tolerance_px=1e-3).geometry == "distorted"
    )


def test_window_is_the_mapping_of_the_cutouts():
    cases = {"aligned": {}, "affine": {"CROTA2": 17.0}, "distorted": dict(SIP, ctype="TAN-SIP")}
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    part_in, part_out = ((10, -7), (60, 50)), ((5, 8), (20, 21))
    n, m = np.indices(part_out[1])
    for geometry, cards in cases.items():
        grid_out = grid_of(header(OBSERVED, **cards), OBSERVED)
        mapping = grid_out.map_to(grid_in)
        assert mapping.geometry == geometry
        window = mapping.window(*part_in, *part_out)
        assert (window.shape_in, window.shape_out) == (part_in[1], part_out[1])
        np.testing.assert_allclose(window.at(n, m), mapping.at(n + 5, m + 8) - part_in[0])
        again = grid_out.cutout(*part_out[0], part_out[1]).map_to(
            grid_in.cutout(*part_in[0], (60, 50))
        )
        np.testing.assert_allclose(window.at(n, m), again.at(n, m), atol=2e-4)
        np.testing.assert_array_equal(window.covered, again.covered)
    with pytest.raises(ValueError, match="distorted"):
        mapping.window(*part_in, (5, 30), (20, 21))
    np.testing.assert_array_equal(window.area, mapping.area[5:25, 8:29])
    simple = mapping.window(*part_in, *part_out, tolerance_px=0.1)
    assert simple.geometry in ("aligned", "affine") and simple.positions is None
    error = np.hypot(*(simple.at(n, m) - window.at(n, m))[window.covered].T).max()
    assert 1e-4 < error <= simple.departure_px + NOISE_PX < 0.1
    assert mapping.window((0, 0), MODEL, (3, 3), (1, 1), tolerance_px=0.1).geometry == "distorted"


def test_tables_are_followed():
    grid_in = grid_of(header(MODEL, scale=SCALE / 2.5), MODEL)
    grid_out = Grid.from_wcs(with_tables(), OBSERVED)
    mapping = grid_out.map_to(grid_in)
    assert mapping.geometry == "distorted"
    np.testing.assert_allclose(mapping.positions, true_positions(grid_out, grid_in), atol=1e-6)


def test_real_headers(data):
    """HST is given in FK5, HSC in ICRS: 0.6 and 0.7 HST pixels that the frames account for."""
    hst, hsc = (
        Grid.from_wcs(WCS(fits.getheader(data / "hst_hsc" / f"{name}.fits")), shape)
        for name, shape in (("hst_f814w", (250, 250)), ("hsc_grizy", (50, 50)))
    )
    assert hst.pixel_scale_arcsec == pytest.approx(0.03, rel=1e-4)
    assert hsc.pixel_scale_arcsec == pytest.approx(0.168, rel=1e-4)
    mapping = hsc.map_to(hst)
    assert mapping.geometry == "affine"
    np.testing.assert_allclose(np.diag(mapping.matrix), 5.6, rtol=1e-4)
    angle = np.degrees(np.arctan2(mapping.matrix[1, 0], mapping.matrix[0, 0]))
    assert angle == pytest.approx(0.005, abs=5e-4)
    apart = (mapping.at(*np.indices((50, 50))) - true_positions(hsc, hst)).mean(axis=(0, 1))
    np.testing.assert_allclose(apart, (-0.592, -0.748), atol=1e-3)
