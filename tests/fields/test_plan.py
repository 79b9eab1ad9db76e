"""Tiles, links, cuts, ids and groups: plain arrays, against what they must be."""

import numpy as np
import pytest
from scipy import ndimage

from clresample.deblending.blend import Blend
from clresample.fields.blends.cut import FitLimits, cut_blend
from clresample.fields.blends.cutouts import listed_source, with_profiles
from clresample.fields.blends.link import link_footprints
from clresample.fields.blends.plan import STEP_PX, FitPlan, make_fit_plan, source_ids
from clresample.fields.blends.search import TileDetections, grown_footprints
from clresample.fields.blends.tiles import tiles_of
from clresample.sky.box import Box
from clresample.sky.sources import ExtendedSource, PointSource


def test_cores_of_tiles_fill_the_region_once():
    region = Box(10, 20, 310, 525)
    tiles = tiles_of(region, 128, 32)
    count = np.zeros((600, 600), int)
    for tile in tiles:
        assert max(tile.core.shape) <= 128
        assert (
            tile.outer.intersection(tile.core) == tile.core
            and region.intersection(tile.outer) == tile.outer
        )
        count[tile.core.slices] += 1
    assert (count[region.slices] == 1).all() and count.sum() == region.area
    with pytest.raises(ValueError, match="size 0"):
        tiles_of(region, 0, 3)


@pytest.mark.parametrize("size", [37, 64, 200])
def test_links_do_not_depend_on_tiles(size):
    rng = np.random.default_rng(0)
    lit = ndimage.gaussian_filter(rng.standard_normal((150, 130)), 3) > 0.03
    region = Box(5, 7, 155, 137)
    tiles = tiles_of(region, size, 10)

    def found(number):
        part = lit[tiles[number].core.relative_to(region).slices]
        return TileDetections(np.zeros((0, 2)), np.zeros(0), part * 3.0, part)

    footprints = link_footprints(tiles, found, region)
    expected, n = ndimage.label(lit, np.ones((3, 3)))
    pairs = np.unique(np.stack([footprints.labels, expected]).reshape(2, -1), axis=1)
    assert pairs.shape[1] == n + 1  # one to one
    for label in range(1, n + 1):
        rows, columns = np.nonzero(footprints.labels == label)
        box = Box(rows.min() + 5, columns.min() + 7, rows.max() + 6, columns.max() + 8)
        assert footprints.boxes[label - 1] == box


def test_a_footprint_is_what_is_connected_to_a_source_and_grown():
    bright = np.zeros((40, 40), bool)
    bright[5:10, 5:10] = bright[30:35, 30:35] = True
    lit = grown_footprints(bright, np.array([(7.0, 7.0), (20.0, 3.0)]), 2)
    assert lit[7, 11] and not lit[7, 12]  # grown by two pixels
    assert not lit[32, 32]  # noise without a source
    assert lit[20, 3] and lit[20, 5] and not lit[20, 6]  # a source in the dark


def blobs(positions, heights, shape=(60, 200)):
    y, x = np.indices(shape)
    return sum(
        h * np.exp(-((y - p) ** 2 + (x - q) ** 2) / 50)
        for (p, q), h in zip(positions, heights, strict=True)
    )


def test_a_giant_parts_where_its_light_is_weakest():
    positions = np.array([(30, 20), (30, 34), (30, 50), (30, 90), (30, 104), (30, 160)], float)
    light = blobs(positions, [50, 20, 30, 40, 25, 60]) + 2.5
    inside = np.ones(light.shape, bool)
    territory, piece = cut_blend(light, inside, positions, FitLimits(max_sources=3), 8)
    assert piece.tolist() == [0, 0, 0, 1, 1, 1]
    assert (territory > 0).all()
    for s, (y, x) in enumerate(positions.astype(int)):
        assert territory[y, x] == piece[s] + 1
    column = np.flatnonzero(np.diff(territory[30]))[0]
    assert abs(column - light[30, 50:90].argmin() - 50) <= 2
    _, whole = cut_blend(light, inside, positions, FitLimits(max_sources=10), 8)
    assert set(whole) == {0}
    _, small = cut_blend(
        light, inside, positions, FitLimits(max_sources=10, max_pixels=76 * 100), 8
    )
    assert len(set(small)) > 1


def plan_of(n=40, **given):
    rng = np.random.default_rng(3)
    region = Box(0, 0, 300, 400)
    positions = rng.uniform(5, 295, (n, 2))
    peaks = rng.uniform(5, 100, n)
    light = np.zeros(region.shape)
    for y, x in np.floor(positions + 0.5).astype(int):
        light[y, x] = 10
    lit = ndimage.distance_transform_edt(light == 0) < 20
    found = TileDetections(positions, peaks, ndimage.gaussian_filter(light, 4) * 100, lit)
    footprints = link_footprints(tiles_of(region, 500, 0), lambda number: found, region)
    return make_fit_plan(positions, peaks, footprints, region, **given), footprints


def test_every_source_is_in_one_patch_and_one_group_and_its_pixel_is_labelled():
    plan, footprints = plan_of(limits=FitLimits(max_sources=6), memory=1 << 24, n_channels=3)
    assert sorted(s for p in plan.patches for s in p.sources) == list(range(40))
    assert sorted(n for g in plan.groups for n in g) == list(range(len(plan.patches)))
    assert any(p.pieces > 1 for p in plan.patches)
    assert all(len(p.sources) <= 6 for p in plan.patches)
    assert all(n % STEP_PX == 0 for p in plan.patches for n in p.box.shape)
    for patch in plan.patches:
        for y, x in np.floor(plan.positions[list(patch.sources)] + 0.5).astype(int):
            assert footprints.labels[y, x] == patch.number + 1
        for other in patch.siblings:
            assert plan.patches[other].parent == patch.parent
    pieces = {n for g in plan.cut_groups for n in g}
    assert pieces == {p.number for p in plan.patches if p.pieces > 1}
    assert FitPlan.from_json(plan.to_json()).patches == plan.patches


def test_stars_of_a_plan_are_points_in_its_fits():
    plan, _ = plan_of(n=6, stars=np.arange(6) == 4)
    plan = FitPlan.from_json(plan.to_json())
    assert plan.stars == (int(plan.ids[4]),)
    (patch,) = [p for p in plan.patches if 4 in p.sources]
    star, galaxy = (listed_source(patch, plan, s) for s in (4, 3))
    assert isinstance(star, PointSource) and star.free_position
    assert isinstance(galaxy, ExtendedSource) and galaxy.n_components is None
    assert star.name == str(plan.ids[4])
    np.testing.assert_allclose(star.position_px, plan.positions[4] - patch.box[:2])


@pytest.mark.parametrize(("single", "counts"), [(1, [1, 2, None]), (None, [None, 2, None])])
def test_sources_go_on_from_the_profiles_of_an_earlier_fit(single, counts):
    """With as many components, unless a single one is left to the data; new ones from nothing."""
    galaxies = [ExtendedSource(position_px=(i, 0), name=str(10 + i)) for i in range(3)]
    star = PointSource(position_px=(9, 0), name="20", free_position=True)
    own, two = ((1.0, 0, 0, 2.0),), ((0.5, 0, 0, 2.0), (1.5, 0, 0, 2.0))
    blend = with_profiles(
        Blend((), (*galaxies, star)),
        {10: own, 11: two, 20: ((0.1, 0.2),)},
        {11: ("two", "structures")},
        single=single,
    )
    assert [source.n_components for source in blend.sources[:3]] == counts
    assert blend.sources[3] == star
    assert blend.thetas == (own, two, (), ((0.1, 0.2),))
    assert blend.structures == ((), ("two", "structures"), (), ())
    assert with_profiles(blend, {}, {}, single=single).structures == ()


def test_ids_do_not_depend_on_the_run_and_say_where():
    places = np.array([(3.4, 7.0), (3.2, 7.4), (1e6, 0.0)])
    ids = source_ids(places, 5)
    assert len(set(ids)) == 3
    assert ids[0] == (5 << 40) + (3 << 20) + 7
    assert source_ids(places[2:], 5)[0] == ids[2]
    assert (source_ids(places, 6) != ids).all()


def test_a_source_in_a_halo_over_the_limits_keeps_the_pixels_near_it():
    positions = np.array([(150, 150), (150, 170), (40, 260)], float)
    light = blobs(positions, [50, 20, 30], (300, 300)) + 3
    light += 5 / (1 + np.hypot(*(np.indices(light.shape) - 150)) / 50)
    inside = np.ones(light.shape, bool)
    limits = FitLimits(max_sources=2, max_pixels=100 * 100)
    territory, piece = cut_blend(light, inside, positions, limits, 8)
    for number, box in enumerate(ndimage.find_objects(territory)):
        n_y, n_x = (s.stop - s.start for s in box)
        assert (n_y + 16) * (n_x + 16) <= limits.max_pixels
        assert number in piece
    for s, (y, x) in enumerate(positions.astype(int)):
        assert territory[y, x] == piece[s] + 1
    few = FitLimits(max_sources=2, max_bytes=4 * 60 * 60 * (20 + 3 * 11), n_channels=3)
    territory, _ = cut_blend(light, inside, positions, few, 8)
    assert max(s.stop - s.start for box in ndimage.find_objects(territory) for s in box) <= 60 - 16
