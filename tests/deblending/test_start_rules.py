"""Rules of a fit's start, in tables: boxes, thresholds, pairs of windows, light and darkness."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import MODEL_PSF, frame

from clresample.deblending.linear.component_batch import (
    BOX_SIDES,
    ComponentBatch,
    StartComponent,
    boxes_of,
    cumulative_offsets,
    listed_by_scene,
    peaks_of,
    profile_thresholds,
)
from clresample.deblending.linear.equations import _eliminate
from clresample.deblending.linear.rendered_models import _ImageProfile
from clresample.deblending.linear.slot_observation import _pairs
from clresample.deblending.linear.spectra import RIDGE, unit_diagonal
from clresample.deblending.profiles import (
    FixedProfile,
    GalaxyProfile,
    StarProfile,
    components_of,
    draw_psf,
    galaxy_reach,
    psf_second_moment,
)
from clresample.deblending.start.profile_start import LIGHT_SIGMAS, _is_dark, profile_peak
from clresample.paper.solver.scene import UNSEEN
from clresample.sky.sources import ExtendedSource, PointSource

HOME, BIG = frame(), (1000, 900)
IMAGE = np.zeros((20, 30))
IMAGE[[5, 5, 11, 0], [6, 9, 8, 0]] = 8.0, -2.0, 1.5, 0.5


def galaxy(*args, **given):
    return GalaxyProfile(HOME, *args, **given)


def star(free=True):
    return StarProfile(HOME, free=free)


def fixed(image=IMAGE):
    return FixedProfile(image)


def component(shape, scene=0, index=0, frame=BIG):
    return StartComponent(scene, index, index, shape, np.array([14.3, 17.6]), frame)


def box_about(middle, half, frame):
    """Box of a component whose light reaches `half` to both sides of `middle` [px]."""
    reaching = SimpleNamespace(bounding_box=lambda *_: (middle, half))
    return boxes_of([component(reaching, frame=frame)], [None], [None])[0].tolist()


def test_boxes_reach_to_a_hundredth_of_the_noise():
    """Within what float32 keeps, and at least to 0.2 % of the peak."""
    found = profile_thresholds(np.array([0.0, 1.0, 5.0, 100.0, 1e4, 1e9]))
    np.testing.assert_allclose(found, [2e-3, 2e-3, 2e-3, 1e-4, 1e-6, 1e-6])


@pytest.mark.parametrize(
    "half, side",
    [(0, 24), (11.5, 24), (11.6, 40), (63.5, 128), (63.6, 256), (127.5, 256), (127.6, 512)],
)
def test_boxes_have_few_sizes(half, side):
    assert BOX_SIDES == (24, 40, 64, 96, 128)
    wanted = [[500 - side // 2, 450 - side // 2], [side, side]]
    assert box_about((500.0, 450.0), (half, 0), BIG) == wanted
    assert box_about((500.0, 450.0), (0, half), BIG) == wanted


@pytest.mark.parametrize(
    "middle, half, shape, low, size",
    [
        ((2, 97), (5, 5), (100, 100), [0, 76], [24, 24]),
        ((50.4, 60.5), (5, 5), (100, 100), [38, 49], [24, 24]),
        ((12, 88), (5, 5), (100, 100), [0, 76], [24, 24]),
        ((5, 50), (300, 10), (20, 90), [0, 0], [20, 90]),
        ((5, 50), (300, 10), (20, 300), [0, 0], [20, 300]),
        ((5, 150), (9, 9), (20, 300), [0, 138], [20, 24]),
    ],
)
def test_boxes_lie_inside_the_frame(middle, half, shape, low, size):
    assert box_about(middle, half, shape) == [low, size]


def test_first_elements_of_arrays_one_after_another():
    begin, n = cumulative_offsets(np.array([3, 4, 5]))
    assert begin.tolist() == [0, 3, 7] and n == 12
    assert cumulative_offsets(np.zeros(0, int))[1] == 0
    assert cumulative_offsets(np.array([2**30, 2**30 - 1]))[1] == 2**31 - 1
    with pytest.raises(MemoryError, match="2147483648 pixels"):
        cumulative_offsets(np.array([2**30, 2**30]))


def test_peaks_are_those_of_drawn_profiles():
    theta, square = np.array([0.7, 0.3, -0.2, 1.5]), np.array([[1.0, 3.0], [4.0, 2.0]])
    shapes = [star(), galaxy(), fixed(square)]
    found = peaks_of([component(shape) for shape in shapes], [np.zeros(2), theta, np.zeros(0)])
    drawn = shapes[1].draw(theta, (20, 20), (41, 41))[0]
    np.testing.assert_allclose(found, [MODEL_PSF.images.max(), drawn[20, 20], 0.4])


def test_galaxies_reach_as_far_as_they_are_above_the_threshold():
    """Along both axes, of a turned ellipse with wings."""
    theta, part = np.array([0.9, 0.3, -0.4, 1.2]), 0.01
    image = galaxy().draw(theta, (100, 100), (201, 201))[0]
    half = galaxy_reach(theta[None], psf_second_moment(MODEL_PSF)[None], np.array([part]))[0]
    for axis in (0, 1):
        along = np.flatnonzero((image > part * image.max()).any(axis=1 - axis))
        assert along[-1] - 100 <= half[axis] < along[-1] - 98
    np.testing.assert_allclose(galaxy().bounding_box(theta, (3.0, 4.0), part), [(3, 4), half])
    box = boxes_of([component(galaxy())], [theta], np.array([part]))[0]
    assert box.tolist() == box_about((14.3, 17.6), half, BIG)


HALF = max(MODEL_PSF.images.shape[1:]) / 2 + 1
PATCH = np.arange(12.0).reshape(3, 4)


@pytest.mark.parametrize(
    "kind, theta, threshold, middle, half",
    [
        (star, [0.5, -0.25], 2e-5, (3.5, 3.75), (HALF, HALF)),  # its image and a pixel
        (fixed, [], 1 / 16, (8, 7.5), (4, 2.5)),  # to the faintest pixel above the threshold
        (lambda: _ImageProfile(PATCH, (5, 7), (160, 160)), [], None, (79.5, 79.5), (160, 160)),
        (lambda: _ImageProfile(PATCH, (5, 7), (161, 160)), [], None, (6, 8.5), (1.5, 2)),
    ],
)
def test_reach_of_other_profiles(kind, theta, threshold, middle, half):
    found = kind().bounding_box(np.array(theta), np.array([3.0, 4.0]), threshold)
    np.testing.assert_allclose(found, [middle, half])


def test_images_are_cut_to_boxes():
    one, low, size = _ImageProfile(PATCH, (5, 7), (40, 40)), np.array([4, 8]), np.array([3, 2])
    assert one.draw_box(None, None, low, size).tolist() == [[[0, 0], [1, 2], [5, 6]]]
    assert fixed().draw(None, None).sum() == 1 and fixed().peak == 1


SCATTER = [0.4, 0.17, 0.17, 1.5]


@pytest.mark.parametrize(
    "shape, mean, scatter",
    [  # 0.25" on pixels of 0.1", round, wings of 12; of two components, a factor e apart
        (galaxy, [np.log(2.5), 0, 0, np.log(12)], SCATTER),
        (lambda: galaxy(1, 2, widened=6), [np.log(15) + 0.5, 0, 0, np.log(12)], SCATTER),
        (star, [0, 0], [0.5, 0.5]),  # half a pixel about its position
        (lambda: star(free=False), [], []),
    ],
)
def test_expected_parameters_of_profiles(shape, mean, scatter):
    one = shape()
    np.testing.assert_allclose(one.mean, mean)
    np.testing.assert_allclose(one.scatter, scatter)
    assert mean or one.center(np.zeros(0), (3.0, 4.0)) == (3.0, 4.0)


@pytest.mark.parametrize(
    "kind, given, shapes",
    [
        (PointSource, {}, [StarProfile]),
        (ExtendedSource, {}, [GalaxyProfile]),
        (ExtendedSource, {"n_components": 2}, [GalaxyProfile, GalaxyProfile]),
        (ExtendedSource, {"profile": np.ones(HOME.shape)}, [FixedProfile]),
    ],
)
def test_profiles_of_sources(kind, given, shapes):
    found = components_of(kind(position_px=(1, 1), **given), HOME)
    assert [type(shape) for shape in found] == shapes


def test_a_psf_is_drawn_without_its_neighbours_in_the_fft():
    """Light at the edge of a box does not come back on the other side."""
    image = draw_psf(MODEL_PSF, (0.0, 0.0), (25, 31))[0]
    assert image[0, 0] == pytest.approx(MODEL_PSF.images.max(), rel=1e-6)
    assert np.abs(image[12:]).max() < 1e-6 and np.abs(image[:, 12:]).max() < 1e-6
    whole = draw_psf(MODEL_PSF, (20.25, 22.5), (41, 45))
    assert whole[0].sum() == pytest.approx(1, abs=1e-3) and len(whole) == 3
    middle = [(v * whole[0]).sum() for v in np.indices(whole[0].shape)]
    np.testing.assert_allclose(middle, [20.25, 22.5], atol=0.03)


def test_slots_of_equal_boxes_follow_each_other():
    """By size, then number of images, then scene; runs end where any of these changes."""
    shapes = [galaxy(), star(free=False), galaxy(), galaxy(), galaxy()]
    chosen = [component(*one) for one in zip(shapes, [1, 0, 0, 1, 0], range(5), strict=True)]
    thetas = [np.zeros(len(shape.mean)) for shape in shapes]
    boxes = [((0, 0), (n, m)) for n, m in ((24, 24), (24, 24), (40, 24), (24, 24), (24, 40))]
    slots = ComponentBatch(chosen, thetas, boxes, slopes=True)
    assert slots.order.tolist() in ([1, 0, 3, 2, 4], [1, 0, 3, 4, 2])
    assert slots.n_images.tolist() == [1, 5, 5, 5, 5]
    sizes = slots.n_images * slots.size.prod(axis=1)
    assert slots.begin.tolist() == [0, *np.cumsum(sizes)[:-1]] and slots.n_elements == sizes.sum()
    assert slots.runs(np.zeros(5)) == [(0, 1), (1, 3), (3, 4), (4, 5)]
    assert slots.runs(np.array([0, 7, 8, 0, 0])) == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    assert ComponentBatch(chosen, thetas, boxes, slopes=False).n_images.tolist() == [1] * 5


def test_slots_are_listed_by_scene():
    slots = np.array([2, 0, 2, 5, 0])
    scenes, first, listed = listed_by_scene(slots, [0, 2, 3])
    assert scenes.tolist() == [0, 2, 3] and first.tolist() == [0, 2, 4, 4]
    assert listed[:4].tolist() == [1, 4, 0, 2] and len(listed) == 5  # never empty
    assert listed_by_scene(slots, [3])[2].tolist() == [0]


def test_pairs_are_windows_of_one_scene_that_overlap_on_the_pixels():
    windows = [(0, -2, 0, 6, 5), (0, 3, 4, 4, 4), (0, 4, 0, 3, 4)]  # scene, low, size
    windows = np.array([*windows, (1, 3, 4, 4, 4), (0, 9, 9, 5, 5), (0, 2, 2, 0, 3)])
    wanted = [
        (0, 0, 0, 0, 4, 5),  # cut at row 0
        (0, 1, 3, 4, 1, 1),
        (1, 1, 3, 4, 4, 4),
        (2, 2, 4, 0, 3, 4),  # beside both others, without overlap
        (4, 4, 9, 9, 1, 2),  # cut at the last pixels
        (3, 3, 3, 4, 4, 4),
    ]
    found = _pairs(windows[:, 0], windows[:, 1:], (10, 11))
    assert sorted(map(tuple, found.tolist())) == sorted(wanted)


def test_dark_positions_have_under_3_sigma_in_every_channel_and_in_all():
    assert LIGHT_SIGMAS == 3
    snr = [(2.9, 0, 0), (3.1, 0, 0), (2.0, 2.0, 0), (2.2, 2.2, 0), (2.0, 2.0, 1.1), (-9, 3.1, 0)]
    assert _is_dark(np.array([*snr, (0, 0, 0)])).tolist() == [True, False] * 3 + [True]
    faint_in_many = np.array([np.full(100, 0.31), np.full(100, 0.29)])
    assert _is_dark(faint_in_many).tolist() == [False, True]


@pytest.mark.parametrize("centre", [(14.3, 17.6), (-0.4, 35.4), (29.4, 0.0)])
@pytest.mark.parametrize("kind", [star, galaxy])
def test_the_peak_of_a_profile_is_its_largest_pixel_on_the_frame(kind, centre):
    shape, place = kind(), np.array(centre)
    wanted = shape.draw(shape.mean, place)[0].max()
    found = profile_peak(shape, shape.mean, place, place, HOME.shape)
    assert found == pytest.approx(wanted, rel=1e-4)


def test_parameters_without_the_spectra_are_a_schur_complement():
    """Of free spectra alone, with the ridge on the others' own diagonal."""
    rng = np.random.default_rng(1)
    k, n_channels, n, p = 2, 3, 2, 4
    size, m = n * p, n + 1

    def positive(shape, n, level):
        a = rng.normal(size=(*shape, n, n))
        return a @ np.swapaxes(a, -1, -2) + level * np.eye(n)

    normal, inner = positive((k,), size, 50.0), positive((k, n_channels), m, 1.0)
    right, cross = rng.normal(size=(k, size)), rng.normal(size=(k, n_channels, m, size))
    rest, lit = rng.normal(size=(k, n_channels, m)), rng.random((k, n_channels, m)) > 0.3
    assert not lit.all()
    found = normal.reshape(k, n, p, n, p).copy(), right.reshape(k, n, p).copy()
    _eliminate(*found, inner, cross.reshape(k, n_channels, m, n, p), rest, lit)
    for b in range(k):
        for c in range(n_channels):
            on = np.flatnonzero(lit[b, c])
            x = cross[b, c, on]
            solved = np.linalg.solve(inner[b, c][np.ix_(on, on)], np.c_[x, rest[b, c, on]])
            normal[b] -= x.T @ solved[:, :-1]
            right[b] -= x.T @ solved[:, -1]
    for part, wanted in zip(found, (normal, right), strict=True):
        np.testing.assert_allclose(part.reshape(wanted.shape), wanted, rtol=1e-5, atol=1e-5)


def test_spectra_of_two_equal_profiles_can_be_eliminated():
    inner = np.array([[[[2.0, 2, 0], [2, 2, 0], [0, 0, 0]]]])
    cross, rest = np.ones((1, 1, 3, 2, 4)), np.ones((1, 1, 3))
    cross[:, :, 2], rest[..., 2] = 0, 0
    lit = np.array([[[True, True, False]]])
    found = np.zeros((1, 2, 4, 2, 4)), np.zeros((1, 2, 4))
    _eliminate(*found, inner, cross, rest, lit)
    for part in found:
        np.testing.assert_allclose(part, -0.5, rtol=1e-6)


@pytest.mark.parametrize(
    "given, scale, seen, beside",
    [
        ([[1.0, 0, 0], [0, 1.1e-24, 0], [0, 0, 0.9e-24]], [1, np.sqrt(1.1e-24), 1], [1, 1, 0], 0),
        ([[4.0, 0.0], [0.0, 0.0]], [2, 1], [1, 0], 0),
        ([[4.0, 3.0], [3.0, 9.0]], [2, 3], [1, 1], 0.5),
        ([[0.0, 0.0], [0.0, 0.0]], [1, 1], [0, 0], 0),
    ],
)
def test_normal_matrices_have_a_unit_diagonal_with_a_ridge(given, scale, seen, beside):
    """Diagonals under 1e-12 of the largest root do not count, but can be divided by."""
    found = unit_diagonal(np.array([given, given]))
    n = len(scale)
    wanted = np.full((n, n), beside) + (1 + RIDGE - beside) * np.eye(n)
    for matrix, sizes, known in zip(*found, strict=True):
        np.testing.assert_allclose(matrix, wanted, rtol=1e-15)
        np.testing.assert_allclose(sizes, scale)
        assert known.tolist() == list(map(bool, seen))
    assert UNSEEN == 1e14
