"""Peaks in large galaxies: structure, members of the galaxy's group, sources of their own."""

import numpy as np
import pytest
from helpers.blends import blend
from scipy import ndimage

from clresample.deblending.result import Component
from clresample.measurement.clumps import _Tree, bodies_of, small_bodies_of
from clresample.measurement.columns import Columns
from clresample.measurement.hills import saddles
from clresample.measurement.photometry import group_fluxes, whole_groups
from clresample.measurement.searched import Search
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import group_rows

FWHM = 2.0
SIZE = 120
MIDDLE = np.array([60.0, 60.0])


def point(at, height, width=FWHM * 2**0.5 / 2.355):
    y, x = np.indices((SIZE, SIZE))
    return height * np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * width**2))


def disk(size, height=400.0, at=MIDDLE):
    """An exponential disk of a half-light radius [px], flat in its core."""
    y, x = np.indices((SIZE, SIZE))
    away = np.hypot(y - at[0], x - at[1])
    return height * np.exp(-1.678 * np.maximum(away - 2, 0) / size)


def spiral(size):
    """A disk with two arms."""
    y, x = np.indices((SIZE, SIZE)) - SIZE / 2
    return disk(size) * (1 + 0.6 * np.cos(2 * np.arctan2(y, x) - np.hypot(y, x) / 5))


def judged(image, places, scale=0.1):
    return bodies_of(image, np.array(places), FWHM, 5.0, scale)


def test_a_weak_peak_in_a_disk_is_structure_and_a_strong_one_a_member():
    weak, strong = (60, 80), (42, 60)
    image = spiral(20) + point(weak, 60) + point(strong, 1800)
    found = judged(image, [MIDDLE, weak, strong])
    assert len(found.bodies) == 1
    assert found.bodies[0].center.tolist() == MIDDLE.tolist()
    assert found.structure.tolist()[1:] == [True, False]
    assert found.owners[2] == 0
    assert found.body_at(np.array(weak)) == 0 and found.body_at(np.array([3.0, 3.0])) == -1


def test_a_weak_peak_on_so_large_a_galaxy_that_there_are_others_by_chance_is_a_source():
    weak = (60, 80)
    image = spiral(20) + point(weak, 80)
    assert judged(image, [MIDDLE, weak], scale=0.1).structure[1]
    assert not judged(image, [MIDDLE, weak], scale=0.4).structure[1]


@pytest.mark.parametrize("galaxy, is_structure", [(disk, False), (spiral, True)])
def test_a_peak_of_its_hosts_light_is_structure_unless_the_host_is_smooth(galaxy, is_structure):
    peak = (60, 80)
    image = galaxy(20)
    found = judged(image + point(peak, image[peak]), [MIDDLE, peak])
    assert found.structure.tolist() == [False, is_structure] and found.owners.tolist() == [0, 0]


@pytest.mark.parametrize("heights", [(20.0, 90.0), (90.0, 20.0)])
def test_light_around_two_galaxies_is_the_brighter_ones(heights):
    basins = np.array([[1, 1, 1, 2, 2, 2, 3]])
    tree = _Tree(np.repeat([*heights, 9.0], [3, 3, 1])[None], basins, 2)
    tree.join(0, 1, 10.0)
    tree.join(0, 2, 8.0)
    assert tree.levels[tree.body[2]] == 90


def test_a_faint_galaxys_peaks_stay_sources_of_its_group():
    weak = (60, 80)
    found = judged(disk(20, 40.0) + point(weak, 12), [MIDDLE, weak])
    assert not found.structure.any() and found.owners.tolist() == [0, 0]
    assert found.body_at(MIDDLE) == -1


def test_what_holds_much_of_the_light_is_a_source_of_its_own():
    image = disk(20) + point((60, 85), 60000)
    found = judged(image, [MIDDLE, (60, 85)])
    assert not len(found.bodies) or found.owners[1] == -1
    assert not found.structure[1]


@pytest.mark.parametrize("height", [50, 5000])
def test_small_galaxies_and_stars_have_no_body(height):
    image = point((60, 60), height) + point((60, 66), height / 3)
    found = judged(image, [(60, 60), (60, 66)])
    assert not found.bodies and not found.structure.any() and (found.owners == -1).all()


def test_a_source_in_the_outskirts_is_no_member():
    away = (60, 112)
    image = disk(14, 1000.0) + point(away, 60)
    found = judged(image, [MIDDLE, away])
    assert found.owners.tolist() == [0, -1] and not found.structure[1]


def test_a_knot_brighter_than_the_middle_does_not_become_the_galaxy():
    knots = [(60, 74), (50, 50), (72, 58)]
    image = disk(20) + sum(point(k, 1200) for k in knots)
    found = judged(image, knots)
    assert np.hypot(*(found.bodies[0].center - MIDDLE)) < 8


def test_two_disks_apart_are_two_bodies():
    y, x = np.indices((SIZE, SIZE))
    image = sum(400 * np.exp(-1.678 * np.hypot(y - 60, x - at) / 10) for at in (30.0, 90.0))
    image = ndimage.gaussian_filter(image, 1.0)
    found = judged(image, [(60, 30), (60, 90)])
    assert sorted(body.center[1] for body in found.bodies) == [30, 90]
    assert len(set(found.owners.tolist())) == 2


def test_knots_of_a_small_galaxy_are_sources_in_its_group():
    knot, far = (60, 66), (60, 90)
    image = disk(4) + point(knot, 100) + point(far, 200)
    assert not judged(image, [MIDDLE, knot]).bodies
    places = np.array([MIDDLE, knot, far])
    found = small_bodies_of(image, places, FWHM, 5.0, 0.1)
    assert found.owners.tolist() == [0, 0, -1] and not found.structure.any()
    assert found.group_at(np.array(knot), 100, 75) == 0
    assert found.group_at(np.array(knot), 1e5, 40) == found.group_at(np.array(far), 200, 1) == -1
    wide = small_bodies_of(image, places, FWHM, 5.0, 0.2)  # where neighbours are more frequent
    assert (wide.owners == -1).all() and wide.group_at(np.array(knot), 100, 75) == -1
    # a peak as bright is part of it where hardly any light is less bright between the two
    for twin, owners in (((60, 53), [0, 0]), ((60, 46), [-1, 0])):
        twins = disk(4) + disk(4, 380.0, twin)
        found = small_bodies_of(twins, np.array([MIDDLE, twin]), FWHM, 5.0, 0.05)
        assert sorted(found.owners) == owners


def test_nothing_and_faint_light_have_no_body():
    assert not judged(np.zeros((SIZE, SIZE)), np.zeros((0, 2))).bodies
    assert not judged(np.full((SIZE, SIZE), 4.0), [(5, 5)]).bodies


def test_saddles_tell_their_heights():
    light = np.array([[5.0, 2.0, 4.0], [1.0, 3.0, 1.0]])
    basins = np.array([[1, 1, 2], [1, 2, 2]], np.int32)
    pairs, heights = saddles(light, basins, heights=True)
    assert pairs == [[0, 1]] and heights == [3.0]


def test_a_groups_flux_is_the_sum_with_the_covariances_of_its_pieces():
    flux = np.array([[10.0], [4.0], [7.0]])
    covariance = np.array([[[4.0, -1.5, 0.3], [-1.5, 1.0, 0.2], [0.3, 0.2, 9.0]]])
    total, error = group_fluxes(flux, covariance, [5, 5, 2])
    np.testing.assert_allclose(total[:, 0], [14, 14, 7])
    np.testing.assert_allclose(error[:, 0] ** 2, [2, 2, 9])
    covariance[0, 1] = covariance[0, :, 1] = 0
    covariance[0, 1, 1] = np.inf
    flux[1] = np.nan
    total, error = group_fluxes(flux, covariance, [5, 5, 2])
    assert np.isnan([total[:2], error[:2]]).all() and error[2, 0] == 3


def test_groups_that_were_fitted_apart_are_put_together():
    rows = Columns(
        {
            "id": np.array([2, 1, 3]),
            "group_id": np.array([1, 1, 3]),
            "n_group": np.array([1, 1, 1], np.int32),
            "flux_r": np.array([10.0, 4.0, 7.0]),
            "flux_err_r": np.array([3.0, 4.0, 1.0]),
            "group_flux_r": np.array([10.0, 4.0, 7.0]),
            "group_flux_err_r": np.array([3.0, 4.0, 1.0]),
        }
    )
    whole_groups(rows, ["r"])
    assert rows["group_id"].tolist() == [2, 2, 3]  # of the brightest, with 10
    assert rows["n_group"].tolist() == [2, 2, 1]
    assert rows["group_flux_r"].tolist() == [14, 14, 7]
    assert rows["group_flux_err_r"].tolist() == [5, 5, 1]


def test_a_large_knotty_galaxy_is_one_group_and_a_field_of_light_is_no_limit():
    """300,000 pixels above the threshold, more than sep holds unless it is told to."""
    pytest.importorskip("sep")
    from clresample.measurement.detection import detect

    rng = np.random.default_rng(1)
    n = 580
    y, x = np.indices((n, n)) - n / 2
    light = 3000 * np.exp(-1.678 * np.hypot(y, x) / 120)
    for at in rng.normal(0, 60, (20, 2)):
        light += 900 * np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * 1.5**2))
    o = Observation(
        light + rng.normal(size=light.shape) + 4,
        PSF.gaussian(1.5, n_pixels=21),
        Grid.flat((n, n), 0.1),
        weights=1.0,
    )
    found = detect([o])
    groups = set(found.groups.tolist())
    assert (found.image > 5).sum() > 300_000
    assert len(groups) < 6 and len(found.sources) < 25
    assert [found.groups[i] for i in group_rows(found.sources)] == found.groups.tolist()


def test_what_a_fit_leaves_of_a_large_galaxys_structure_is_no_source():
    """A residual of half of the galaxy's light there; one of ten times as much is a source."""
    pytest.importorskip("sep")
    from clresample.measurement.detection import detect_more

    grid = Grid.flat((SIZE, SIZE), 0.1)
    light = disk(20, 400.0)
    weak, strong = (60, 84), (84, 60)
    found = []
    for part in (0.9, 12.0):
        data = light.copy()
        for at in (weak, strong) if part > 1 else (weak,):
            data += point(at, part * light[at], 1.0)
        o = Observation(data, PSF.gaussian(1.0, n_pixels=15), grid, weights=0.05)
        component = Component(0, (0, 0), light / light.max(), np.array([light.max()]))
        result = blend([component], observations=(o,), grid=grid)
        found.append(detect_more(result))
    assert len(found[0].sources) == len(found[0].hosts) == 0
    assert len(found[1].sources) >= 1
    assert set(found[1].hosts.tolist()) == {0}  # each of them may be a clump of the galaxy


def test_two_galaxies_in_one_light_are_two_bodies_with_their_own_clumps():
    other, clumps = (60, 80), [(44, 56), (74, 88)]
    image = disk(16) + disk(8, 800.0, other) + sum(point(at, 900) for at in clumps)
    found = judged(image, [MIDDLE, other, *clumps])
    assert [body.center.tolist() for body in found.bodies] == [[60, 60], [60, 80]]
    assert found.owners.tolist() == [0, 1, 0, 1]
    first, second = (body.outline[1].sum() for body in found.bodies)
    assert min(first, second) > 0.3 * (first + second)  # each has its side of the light


def test_a_clump_between_two_galaxies_is_the_ones_to_whose_centre_it_is_far_nearer():
    """It rises from the brighter one's light."""
    faint, clump = np.array([60.0, 90.0]), (78, 80)
    image = disk(16, 1500.0, (60, 30)) + disk(12, 200.0, faint) + point(clump, 200)
    found = judged(image, [(60, 30), faint, clump])
    assert len(found.bodies) == 2
    assert found.owners[2] == found.owners[1] != found.owners[0]
    assert found.body_at(np.array(clump)) == found.owners[1]


@pytest.mark.parametrize("height, width, n_more", [(2e4, 0.9, 0), (20.0, 2.0, 4)])
def test_what_a_stars_psf_leaves_is_no_source_but_what_a_galaxy_does_may_be(height, width, n_more):
    """Four peaks of a quarter of the model's light, 5 pixels from a point or a galaxy."""
    pytest.importorskip("sep")
    from clresample.measurement.detection import detect_more

    grid, psf = Grid.flat((SIZE, SIZE), 0.1), PSF.gaussian(0.8, n_pixels=15)
    y, x = np.indices((SIZE, SIZE)) - MIDDLE[0]
    square = y**2 + x**2
    light = height * np.exp(-square / (2 * width**2)) + 40 / (1 + square / 30)
    left = sum(point((60 + a, 60 + b), 16, 1.0) for a, b in ((5, 0), (-5, 0), (0, 5), (0, -5)))
    o = Observation(light + left, psf, grid, weights=1.0)
    component = Component(0, (0, 0), light / light.max(), np.array([light.max()]))
    result = blend([component], observations=(o,), grid=grid)
    assert len(detect_more(result).sources) == n_more


def test_a_knot_beside_a_galaxys_light_is_in_its_group_inside_its_radius():
    """Its disk is hidden there."""
    knots, away = [(60, 81), (52, 80)], (60, 110)
    image = disk(20)
    image[:, 76:] = 0
    image += sum(point(at, 100) for at in (*knots, away))
    found = judged(image, [MIDDLE, *knots, away])
    assert len(found.bodies) == 1
    assert found.owners.tolist() == [0, 0, 0, -1]


@pytest.mark.parametrize(
    "part, radius, height, width, middle", [(0.4, 20, 200, 4, 1300), (0.6, 24, 40, 3, 500)]
)
def test_a_ring_and_its_middle_are_in_one_group(part, radius, height, width, middle):
    """Brighter on two sides, which look like nuclei; or, of a faint one, beyond a dark gap."""
    y, x = np.indices((SIZE, SIZE)) - 60
    around = 1 + part * np.cos(2 * np.arctan2(y, x))
    image = height * np.exp(-0.5 * ((np.hypot(y, x) - radius) / width) ** 2) * around
    image += disk(4, middle)
    found = Search(None, 5.0, [])
    for place in (MIDDLE, MIDDLE - (0, radius), MIDDLE + (0, radius)):
        found._put(place, float(image[tuple(place.astype(int))]), "E")
    found.sort_out(image, FWHM, 0.1)
    groups = found.in_order()[1]
    assert len(groups) == 3 and len(set(groups.tolist())) == 1
