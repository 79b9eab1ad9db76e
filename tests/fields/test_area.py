"""The area of a field: the sky of all mosaics, and notes on all that is left out of it."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS, Sip

from clresample import FieldOptions, Grid, Mosaic, run_field
from clresample.fields.area import field_area
from clresample.fields.blends.plan import source_ids
from clresample.fields.blends.search import snr_scatter
from clresample.fields.reference import reference_grid
from clresample.fields.run import _names_by_id
from clresample.sky.box import Box

PSF = np.outer(*[np.exp(-(np.linspace(-2, 2, 9) ** 2))] * 2)
GROWTH = r'area = "all" in \[field\] adds the rest, with 898 times as many model pixels'


def mosaic(name, n, scale, center=(0.0, 0.0), angle=0.0, wcs=False):
    grid = Grid.flat((n, n), scale, angle_deg=angle, center_arcsec=center)
    grid = Grid.from_wcs(grid.to_wcs(ra_deg=150.0, dec_deg=2.0), grid.shape) if wcs else grid
    data = np.random.default_rng(n).standard_normal((1, n, n))
    return Mosaic.of_arrays(name, data, PSF, grid, weights=np.ones(data.shape))


def area(*mosaics, which="auto", **given):
    return field_area(mosaics, reference_grid(mosaics), which, **given)


@pytest.mark.parametrize("which", ["auto", "all", "finest"])
@pytest.mark.parametrize("wcs", [False, True])
@pytest.mark.parametrize(
    "more", [(), ((32, 0.2, 0),), ((64, 0.1, 0), (16, 0.4, 90)), ((20, 0.2, 30),)]
)
def test_mosaics_of_the_same_sky_or_less_have_the_area_of_the_finest(which, wcs, more):
    others = [mosaic(f"m{i}", n, s, angle=a, wcs=wcs) for i, (n, s, a) in enumerate(more)]
    found = area(mosaic("fine", 64, 0.1, wcs=wcs), *others, which=which)
    assert found == (Box(0, 0, 64, 64), Box(0, 0, 64, 64), ())


def test_a_wider_mosaic_extends_the_area():
    found = area(mosaic("wide", 64, 0.2), mosaic("fine", 64, 0.1))
    assert found.wanted == found.searchable and not found.notes
    assert found.wanted == Box(-32, -32, 96, 96)


@pytest.mark.parametrize(
    "which, others, message",
    [
        ("auto", {"far": 600}, rf"is not searched \(99 % of far\); .*smallest pixels: {GROWTH}"),
        ("finest", {"far": 600, "same": 20}, r"not searched \(99 % of far\); "),
        ("finest", {"wide": 40}, r"not searched \(7. % of wide\); "),
    ],
)
def test_sky_that_is_not_searched_is_noted_once(which, others, message):
    wide = [mosaic(name, n, 0.3, (0.05, 0.05)) for name, n in others.items()]
    found = area(mosaic("fine", 60, 0.1), *wide, which=which)
    assert found.wanted == Box(0, 0, 60, 60)
    (note,) = found.notes
    assert re.search(message, note), note


def test_sky_that_the_finest_wcs_does_not_place_is_noted():
    """A distortion that is none over the image folds the sky beyond it."""
    fine, wide = mosaic("fine", 64, 0.1, wcs=True), mosaic("wide", 150, 0.2, wcs=True)
    wcs = WCS(fine.grid.to_wcs().to_header())
    a = np.zeros((4, 4))
    a[3, 0] = -5e-5  # m + a m^3 has its maximum at m = 82
    wcs.sip = Sip(a, np.zeros((4, 4)), None, None, wcs.wcs.crpix)
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    fine = replace(fine, grid=Grid.from_wcs(wcs, (64, 64)))
    found = area(fine, wide, which="all")
    assert found.searchable.x1 < 120
    (note,) = found.notes
    assert "% of wide); the WCS of the mosaic with the smallest pixels cannot be" in note


def test_known_sources_outside_are_noted():
    given = {"positions": np.array([[3.0, 3.0], [-4.0, 3.0], [np.nan, 1.0]])}
    (note,) = area(mosaic("fine", 64, 0.1), **given).notes
    assert note.endswith("are not in the catalogue (2 of 3)")


def test_ids_of_sources_on_all_sides_differ():
    at = np.array([(y, x) for y in (-300.0, -1.0, 0.0, 70.0) for x in (-200.0, -1.0, 5.0)])
    ids = source_ids(at, 3)
    assert len(set(ids.tolist())) == len(at) and (ids >> 40 == 3).all()
    assert ids[8] == (3 << 40) + 5 and (source_ids(at[4:7], 3) == ids[4:7]).all()


def test_the_scatter_of_a_mosaic_beside_the_finest_is_measured():
    mosaics = [mosaic("fine", 64, 0.1), mosaic("beside", 64, 0.1, center=(0.0, 8.0))]
    found = snr_scatter(mosaics, reference_grid(mosaics))
    assert found["beside"] != [1.0] * 3 and np.all(np.array(found["beside"]) > 0)


@pytest.mark.parametrize(
    ("positions", "remedy"),
    [
        ([[2.0, 150.0]], "swap the two"),
        ([[10.0, 2.0]], "multiply right ascensions in hours by 15"),
        ([[40.0, -5.0], [41.0, 0.0]], "(longitude, latitude) [deg] of sources there"),
    ],
)
def test_a_list_without_a_source_in_the_area_is_refused_before_the_run(tmp_path, positions, remedy):
    one = mosaic("m", 32, 0.2, wcs=True)
    message = r"positions are all outside the field's area \([12] sources, .*" + re.escape(remedy)
    with pytest.raises(ValueError, match=message):
        run_field([one], tmp_path / "out", options=FieldOptions(positions=positions))
    assert not (tmp_path / "out").exists()


NOWHERE = SkyCoord([], [], unit="deg")


@pytest.mark.parametrize("positions", [[], [1.0, 2.0], np.zeros((3, 3)), NOWHERE])
def test_positions_of_another_shape_are_refused(positions):
    with pytest.raises(ValueError, match="positions has the shape .*, must be .S, 2. with"):
        FieldOptions(positions=positions)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"threshold": "a"}, "threshold is 'a', must be a positive number of sigmas"),
        ({"margin_px": "a"}, "margin_px is 'a', must be a whole number, 0 or more"),
        ({"tile_px": -5}, "tile_px is -5, must be 1 or more"),
        ({"tile_px": 64}, "overlap_px is 96, must be below tile_px, 64"),
    ],
)
def test_numbers_of_options_are_checked(given, message):
    with pytest.raises(ValueError, match=message):
        FieldOptions(**given)


def test_a_field_without_a_detection_has_a_note(tmp_path):
    found = run_field([mosaic("m", 64, 0.2)], tmp_path, options=FieldOptions(threshold=1e4))
    assert found.outputs.n_sources == 0
    assert "no source was detected over 10000 sigma, and the catalogue" in found.outputs.notes[0]


def test_names_are_those_at_the_places_of_a_plan_that_lacks_some():
    """Of a tile that failed; two at one place keep their order."""
    listed = np.array([[5.0, 1.0], [2.0, 3.0], [5.0, 1.0], [9.0, 9.0]])
    plan = SimpleNamespace(ids=np.array([7, 8, 9]), positions=listed[[1, 0, 2]])
    assert _names_by_id(plan, list("abcd"), listed) == {7: "b", 8: "a", 9: "c"}
    assert _names_by_id(plan, None, None) is None
