"""Rules of a fit's start, each alone: boxes, thresholds, pairs of windows, light and darkness."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import MODEL_PSF, frame

from clresample.deblending.profiles import (
    COMPONENT_SPREAD,
    ELLIPTICITY_SCATTER,
    FixedProfile,
    GalaxyProfile,
    StarProfile,
    components_of,
    draw_psf,
    galaxy_reach,
    psf_second_moment,
)
from clresample.deblending.spectra import RIDGE, unit_diagonal
from clresample.deblending.start.component_batch import (
    BOX_SIDES,
    ComponentBatch,
    StartComponent,
    _box_about,
    boxes_of,
    cumulative_offsets,
    peaks_of,
    profile_thresholds,
)
from clresample.deblending.start.equations import _eliminated
from clresample.deblending.start.final_render import _ImageProfile
from clresample.deblending.start.profile_start import LIGHT_SIGMAS, _is_dark, profile_peak
from clresample.deblending.start.slot_observation import _listed, _pairs
from clresample.paper.solver.scene import UNSEEN
from clresample.sky.sources import ExtendedSource, PointSource

BIG = (1000, 900)


def test_boxes_reach_to_a_hundredth_of_the_noise():
    """Within what float32 keeps, and at least to 0.2 % of the peak."""
    found = profile_thresholds(np.array([0.0, 1.0, 5.0, 100.0, 1e4, 1e9]))
    np.testing.assert_allclose(found, [2e-3, 2e-3, 2e-3, 1e-4, 1e-6, 1e-6])


@pytest.mark.parametrize(
    "half, side",
    [(0, 24), (11.5, 24), (11.6, 40), (63.5, 128), (63.6, 256), (127.5, 256), (127.6, 512)],
)
def test_boxes_have_few_sizes(half, side):
    """The least side that holds what reaches `half` to both sides of a pixel."""
    assert BOX_SIDES == (24, 40, 64, 96, 128)
    for along in ((half, 0), (0, half)):
        low, size = _box_about((500.0, 450.0), np.array(along), BIG)
        assert size == [side, side] and low == [500 - side // 2, 450 - side // 2]


@pytest.mark.parametrize(
    "middle, low", [((2, 97), (0, 76)), ((50.4, 60.5), (38, 49)), ((12, 88), (0, 76))]
)
def test_boxes_lie_inside_the_frame(middle, low):
    assert _box_about(middle, np.array([5.0, 5.0]), (100, 100)) == (list(low), [24, 24])


def test_a_box_is_no_larger_than_the_frame():
    assert _box_about((5, 50), np.array([300.0, 10.0]), (20, 90)) == ([0, 0], [20, 90])
    assert _box_about((5, 50), np.array([300.0, 10.0]), (20, 300)) == ([0, 0], [20, 300])
    assert _box_about((5, 150), np.array([9.0, 9.0]), (20, 300)) == ([0, 138], [20, 24])


def test_where_arrays_begin_that_follow_each_other():
    begin, n = cumulative_offsets(np.array([3, 4, 5]))
    assert begin.tolist() == [0, 3, 7] and n == 12
    assert cumulative_offsets(np.zeros(0, int))[1] == 0
    assert cumulative_offsets(np.array([2**30, 2**30 - 1]))[1] == 2**31 - 1
    with pytest.raises(MemoryError, match="2147483648 pixels"):
        cumulative_offsets(np.array([2**30, 2**30]))


def components(*shapes, scenes=None):
    home = frame()
    return [
        StartComponent(0 if scenes is None else scenes[i], i, i, shape, np.array([14.3, 17.6]), BIG)
        for i, shape in enumerate(shapes)
    ], home


def test_peaks_are_those_of_what_is_drawn():
    home = frame()
    theta = np.array([0.7, 0.3, -0.2, 1.5])
    stars = [
        StarProfile(home, free=True),
        GalaxyProfile(home),
        FixedProfile(np.array([[1.0, 3.0], [4.0, 2.0]])),
    ]
    chosen, _ = components(*stars)
    found = peaks_of(chosen, [np.zeros(2), theta, np.zeros(0)])
    drawn = stars[1].draw(theta, (20, 20), (41, 41))[0]
    np.testing.assert_allclose(found, [MODEL_PSF.images.max(), drawn[20, 20], 0.4])


def test_galaxies_reach_as_far_as_they_are_above_the_threshold():
    """Along both axes, of a turned ellipse with wings."""
    home = frame()
    theta, part = np.array([0.9, 0.3, -0.4, 1.2]), 0.01
    image = GalaxyProfile(home).draw(theta, (100, 100), (201, 201))[0]
    lit = image > part * image.max()
    half = galaxy_reach(theta[None], psf_second_moment(MODEL_PSF)[None], np.array([part]))[0]
    for axis in (0, 1):
        along = np.flatnonzero(lit.any(axis=1 - axis))
        assert along[-1] - 100 <= half[axis] < along[-1] - 98
    middle, own = GalaxyProfile(home).bounding_box(theta, (3.0, 4.0), part)
    np.testing.assert_allclose([*middle, *own], [3, 4, *half])
    box = boxes_of(components(GalaxyProfile(home))[0], [theta], np.array([part]))[0]
    assert box == _box_about((14.3, 17.6), half, BIG)


def test_a_star_reaches_to_the_end_of_its_image_or_of_its_rings():
    """0.002 px over the threshold, in parts of the peak, and a pixel."""
    star = StarProfile(frame(), free=True)
    n = max(MODEL_PSF.images.shape[1:])
    for part, half in ((0.01, n / 2 + 1), (2e-5, 101.0)):
        place, found = star.bounding_box(np.array([0.5, -0.25]), np.array([3.0, 4.0]), part)
        np.testing.assert_allclose([*place, *found], [3.5, 3.75, half, half])
    fixed = StarProfile(frame(), free=False)
    assert fixed.center(np.zeros(0), (3.0, 4.0)) == (3.0, 4.0) and len(fixed.scatter) == 0
    assert star.scatter.tolist() == [0.5, 0.5] and star.mean.tolist() == [0, 0]


def test_a_given_profile_reaches_to_its_faintest_pixel_above_the_threshold():
    image = np.zeros((20, 30))
    image[5, 6], image[5, 9], image[11, 8], image[0, 0] = 8.0, -2.0, 1.5, 0.5
    middle, half = FixedProfile(image).bounding_box(np.zeros(0), (0, 0), 1 / 16)
    np.testing.assert_array_equal([*middle, *half], [8, 7.5, 4, 2.5])
    assert FixedProfile(image).draw(None, None).sum() == 1 and FixedProfile(image).peak == 1


def test_what_is_expected_of_galaxies():
    """0.25" on pixels of 0.1", components of a source a factor e apart, round, wings of 6.5."""
    one = GalaxyProfile(frame())
    np.testing.assert_allclose(one.mean, [np.log(2.5), 0, 0, np.log(6.5)])
    assert ELLIPTICITY_SCATTER == 0.17 and COMPONENT_SPREAD == 1
    np.testing.assert_allclose(one.scatter, [0.4, 0.17, 0.17, 0.7])
    free = StarProfile(frame(), free=True)  # half a pixel about its place
    assert free.mean.tolist() == [0, 0] and free.scatter.tolist() == [0.5, 0.5]
    wide = GalaxyProfile(frame(), 1, 2, widened=6.0)
    assert wide.mean[0] == pytest.approx(np.log(2.5 * 6) + 0.5)
    kinds = [
        (PointSource(position_px=(1, 1)), [StarProfile]),
        (ExtendedSource(position_px=(1, 1)), [GalaxyProfile]),
        (ExtendedSource(position_px=(1, 1), n_components=2), [GalaxyProfile, GalaxyProfile]),
        (ExtendedSource(position_px=(1, 1), profile=np.ones(frame().shape)), [FixedProfile]),
    ]
    for source, wanted in kinds:
        assert [type(shape) for shape in components_of(source, frame())] == wanted


def test_a_psf_is_drawn_without_its_neighbours_in_the_fft():
    """Light at the edge of a box does not come back on the other side."""
    image = draw_psf(MODEL_PSF, (0.0, 0.0), (25, 31))[0]
    assert image[0, 0] == pytest.approx(MODEL_PSF.images.max(), rel=1e-6)
    assert np.abs(image[12:]).max() < 1e-6 and np.abs(image[:, 12:]).max() < 1e-6
    whole = draw_psf(MODEL_PSF, (20.25, 22.5), (41, 45))
    assert whole[0].sum() == pytest.approx(1, abs=1e-3) and len(whole) == 3
    y, x = np.indices(whole[0].shape)
    middle = [(v * whole[0]).sum() for v in (y, x)]
    np.testing.assert_allclose(middle, [20.25, 22.5], atol=0.03)


def test_slots_of_equal_boxes_follow_each_other():
    """By size, then how many images, then scene; runs end where any of these changes."""
    home = frame()
    shapes = [
        GalaxyProfile(home),
        StarProfile(home, free=False),
        GalaxyProfile(home),
        GalaxyProfile(home),
        GalaxyProfile(home),
    ]
    chosen, _ = components(*shapes, scenes=[1, 0, 0, 1, 0])
    thetas = [np.zeros(len(shape.mean)) for shape in shapes]
    boxes = [((0, 0), (n, m)) for n, m in ((24, 24), (24, 24), (40, 24), (24, 24), (24, 40))]
    slots = ComponentBatch(chosen, thetas, boxes, slopes=True)
    assert slots.order.tolist() == [1, 0, 3, 2, 4] or slots.order.tolist() == [1, 0, 3, 4, 2]
    assert slots.n_images.tolist() == [1, 5, 5, 5, 5]
    sizes = slots.n_images * slots.size.prod(axis=1)
    assert slots.begin.tolist() == [0, *np.cumsum(sizes)[:-1]] and slots.n_elements == sizes.sum()
    assert slots.runs(np.zeros(5)) == [(0, 1), (1, 3), (3, 4), (4, 5)]
    assert slots.runs(np.array([0, 7, 8, 0, 0])) == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    bare = ComponentBatch(chosen, thetas, boxes, slopes=False)
    assert bare.n_images.tolist() == [1] * 5


def test_slots_are_listed_by_scene():
    slots = SimpleNamespace(scene=np.array([2, 0, 2, 5, 0]))
    scenes, first, listed = _listed(slots, [0, 2, 3])
    assert scenes.tolist() == [0, 2, 3] and first.tolist() == [0, 2, 4, 4]
    assert listed[:4].tolist() == [1, 4, 0, 2] and len(listed) == 5  # never empty
    assert _listed(slots, [3])[2].tolist() == [0]


def test_pairs_are_windows_of_one_scene_that_meet_on_the_pixels():
    #          scene low     size
    place = [
        (0, -2, 0, 6, 5),
        (0, 3, 4, 4, 4),
        (0, 4, 0, 3, 4),
        (1, 3, 4, 4, 4),
        (0, 9, 9, 5, 5),
        (0, 2, 2, 0, 3),
    ]
    found = _pairs(np.array(place)[:, 0], np.array(place)[:, 1:], (10, 11))
    wanted = [
        (0, 0, 0, 0, 4, 5),  # cut at row 0
        (0, 1, 3, 4, 1, 1),
        (1, 1, 3, 4, 4, 4),
        (2, 2, 4, 0, 3, 4),  # beside both others, and meets none
        (4, 4, 9, 9, 1, 2),  # cut at the last pixels
        (3, 3, 3, 4, 4, 4),
    ]
    assert sorted(map(tuple, found.tolist())) == sorted(wanted)


def test_darkness_is_under_three_sigma_in_any_channel_and_in_all_together():
    assert LIGHT_SIGMAS == 3
    snr = [(2.9, 0, 0), (3.1, 0, 0), (2.0, 2.0, 0), (2.2, 2.2, 0), (2.0, 2.0, 1.1), (-9, 3.1, 0)]
    assert _is_dark(np.array(snr)).tolist() == [True, False, True, False, True, False]
    assert _is_dark(np.zeros((1, 3))).tolist() == [True]
    assert _is_dark(np.full((1, 100), 0.31)).tolist() == [False]  # faint in each of many
    assert _is_dark(np.full((1, 100), 0.29)).tolist() == [True]


@pytest.mark.parametrize("centre", [(14.3, 17.6), (-0.4, 35.4), (29.4, 0.0)])
def test_the_peak_of_a_profile_is_its_largest_pixel_on_the_frame(centre):
    home = frame()
    for shape, theta in (
        (StarProfile(home, free=True), np.zeros(2)),
        (GalaxyProfile(home), GalaxyProfile(home).mean),
    ):
        place = np.array(centre)
        wanted = shape.draw(theta, place)[0].max()
        found = profile_peak(shape, theta, place, place, home.shape)
        assert found == pytest.approx(wanted, rel=1e-4)


def test_parameters_without_the_spectra_are_a_schur_complement():
    """Of those that are free alone, with the ridge on the others' own diagonal."""
    rng = np.random.default_rng(1)
    k, n_channels, n, p = 2, 3, 2, 4
    size, m = n * p, n + 1
    normal, right = np.zeros((k, n, p, n, p)), rng.normal(size=(k, n, p))
    inner, cross = np.zeros((k, n_channels, m, m)), rng.normal(size=(k, n_channels, m, n, p))
    for b in range(k):
        a = rng.normal(size=(size, size))
        normal[b] = (a @ a.T + 50 * np.eye(size)).reshape(n, p, n, p)
        for c in range(n_channels):
            a = rng.normal(size=(m, m))
            inner[b, c] = a @ a.T + np.eye(m)
    rest, lit = rng.normal(size=(k, n_channels, m)), rng.random((k, n_channels, m)) > 0.3
    assert not lit.all()
    found = _eliminated(normal.copy(), right.copy(), inner.copy(), cross.copy(), rest, lit)
    for b in range(k):
        wanted, pull = normal[b].reshape(size, size).copy(), right[b].ravel().copy()
        for c in range(n_channels):
            on = np.flatnonzero(lit[b, c])
            x = cross[b, c].reshape(m, size)[on]
            solved = np.linalg.solve(inner[b, c][np.ix_(on, on)], np.c_[x, rest[b, c, on]])
            wanted -= x.T @ solved[:, :-1]
            pull -= x.T @ solved[:, -1]
        np.testing.assert_allclose(found[0][b], wanted, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(found[1][b], pull, rtol=1e-5, atol=1e-5)


def test_spectra_of_two_equal_profiles_can_be_eliminated():
    inner = np.array([[[[2.0, 2, 0], [2, 2, 0], [0, 0, 0]]]])
    cross, rest = np.ones((1, 1, 3, 2, 4)), np.ones((1, 1, 3))
    cross[:, :, 2], rest[..., 2] = 0, 0
    lit = np.array([[[True, True, False]]])
    normal, right = _eliminated(
        np.zeros((1, 2, 4, 2, 4)), np.zeros((1, 2, 4)), inner, cross, rest, lit
    )
    np.testing.assert_allclose(normal, -0.5, rtol=1e-6)
    np.testing.assert_allclose(right, -0.5, rtol=1e-6)


def test_small_frames_are_seen_whole_and_large_ones_in_boxes():
    """160 pixels a side are small."""
    image = np.arange(12.0).reshape(3, 4)
    middle, half = _ImageProfile(image, (5, 7), (160, 160)).bounding_box(None, None, None)
    assert middle.tolist() == [79.5, 79.5] and half.tolist() == [160, 160]
    middle, half = _ImageProfile(image, (5, 7), (161, 160)).bounding_box(None, None, None)
    assert middle.tolist() == [6, 8.5] and half.tolist() == [1.5, 2]
    cut = _ImageProfile(image, (5, 7), (40, 40)).draw_box(
        None, None, np.array([4, 8]), np.array([3, 2])
    )
    np.testing.assert_array_equal(cut, [[[0, 0], [1, 2], [5, 6]]])


def test_what_is_hardly_seen_is_not_seen():
    """Diagonals under 1e-12 of the largest root; each has its own ridge."""
    matrix, scale, seen = unit_diagonal(np.diag([1.0, 1.1e-24, 0.9e-24]))
    assert seen.tolist() == [True, True, False]
    np.testing.assert_allclose(scale, [1, np.sqrt(1.1e-24), 1])
    np.testing.assert_allclose(np.diag(matrix), 1 + RIDGE, rtol=1e-15)
    both = unit_diagonal(np.array([[[4.0, 3.0], [3.0, 9.0]], [[0.0, 0.0], [0.0, 0.0]]]))
    np.testing.assert_allclose(both[0][0], [[1 + RIDGE, 0.5], [0.5, 1 + RIDGE]], rtol=1e-15)
    assert not both[2][1].any() and UNSEEN == 1e14
