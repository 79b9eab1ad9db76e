"""Observations as a fit sees them, in units of their noise, and what is rendered in windows."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending import view as view_module
from clresample.deblending.blend import Blend
from clresample.deblending.component_images import ComponentImages
from clresample.deblending.view import WhitenedView, _padded, _typical_noise, flush_faint
from clresample.paper import image_profiles
from clresample.sky.sources import ExtendedSource, PointSource


def view(shares=None, matrix=((0.5, 0.0), (0.0, 0.5))):
    """Two channels of 3 x 4 pixels, the last column of them not covered."""
    rng = np.random.default_rng(0)
    covered = np.ones((3, 4), bool)
    covered[:, 3] = False
    weights = np.array([4.0, 25.0])[:, None, None] * np.ones((2, 3, 4))
    weights[0, 0, 0], weights[1, 1, 1] = 0, 100
    data = rng.normal(10, 1, (2, 3, 4))
    data[0, 0, 0] = np.nan
    mapping = _Mapping((3, 4), covered, np.array(matrix))
    return WhitenedView.of(SimpleNamespace(mapping=mapping), _Home, data, weights, shares), data


class _Home:
    shape = (6, 8)


class _Mapping:
    def __init__(self, shape_in, covered, matrix):
        self.shape_in, self.covered, self.matrix = shape_in, covered, matrix


@pytest.fixture(autouse=True)
def plain_mapping(monkeypatch):
    """Views of `view` need no more of a mapping than which pixels it covers."""
    real = view_module.replace
    monkeypatch.setattr(
        view_module, "replace", lambda x, **kw: x if isinstance(x, _Mapping) else real(x, **kw)
    )


def test_data_count_in_the_noise_of_a_typical_pixel():
    one, data = view()
    np.testing.assert_allclose(one.noise_unit, [0.5, 0.2])
    root = np.ones((2, 3, 4))
    root[0, 0, 0], root[:, :, 3], root[1, 1, 1] = 0, 0, 2
    np.testing.assert_allclose(one.sqrt_weights, root)
    wanted = np.where(root > 0, data, 0) / np.array([0.5, 0.2])[:, None, None]
    np.testing.assert_allclose(one.data, wanted)
    np.testing.assert_allclose(one.pixel_noise, [2, 2])
    turned = view(matrix=((0.0, 0.5), (-2.0, 0.0)))[0]
    np.testing.assert_allclose(turned.pixel_noise, [1, 1])


def test_data_are_above_the_sky_that_is_expected():
    """In the view's units; a level of which nothing is known has no precision."""
    one, data = view()
    found = one.expecting_sky(np.array([1.5, -2.0]), np.array([0.25, np.inf]))
    np.testing.assert_allclose(found.sky_level, [3, -10])
    np.testing.assert_allclose(found.sky_precision, [4, 0])
    wanted = np.where(one.sqrt_weights > 0, data - np.array([1.5, -2.0])[:, None, None], 0)
    np.testing.assert_allclose(found.data, wanted / np.array([0.5, 0.2])[:, None, None])
    assert (
        found.sqrt_weights is one.sqrt_weights
        and one.sky_level is None
        and one.sky_precision is None
    )


def test_an_error_of_the_model_is_added_to_the_noise():
    one, _ = view()
    error = np.full((2, 3, 4), 3.0)
    with np.errstate(divide="ignore"):
        found, before = 1 / one.with_model_error(error).sqrt_weights ** 2, 1 / one.sqrt_weights**2
    np.testing.assert_allclose(found, before + 9)


def test_typical_noise_is_the_median_of_what_was_seen():
    assert _typical_noise(np.array([0.0, 1.0, 4.0, 16.0, 0.0])) == 0.5
    assert _typical_noise(np.zeros(3)) == 1 and _typical_noise(np.array([0.0, 0.25])) == 2


def test_dark_pixels_are_none():
    """Under 1e-20 of the brightest, of either sign; in place."""
    images = np.array([1.0, 1.1e-20, 0.9e-20, -0.9e-20, -1.1e-20, 0.0])
    assert flush_faint(images) is images
    assert images.tolist() == [1, 1.1e-20, 0, 0, -1.1e-20, 0]
    assert not flush_faint(np.zeros(2)).any() and not flush_faint(np.zeros(0)).size


def test_images_are_padded_at_their_ends():
    images = np.arange(12.0).reshape(2, 2, 3)
    found = _padded(images, (7, 4, 5))
    assert found.shape == (2, 4, 5) and found.sum() == images.sum()
    np.testing.assert_array_equal(found[:, :2, :3], images)
    assert _padded(images, (2, 3)).shape == images.shape


def three(rng):
    """Windows of three components in an observation of 2 channels."""
    low = np.array([[0, 0], [3, 2], [5, 6]])
    images = [rng.random((2, *shape)) for shape in ((3, 4), (4, 4), (2, 1))]
    return ComponentImages((3, 2, 8, 7), low, images)


def test_what_is_stored_in_windows_is_an_array():
    rng = np.random.default_rng(0)
    one = three(rng)
    whole = np.zeros((3, 2, 8, 7))
    for i, ((y, x), image) in enumerate(zip(one.low, one.images, strict=True)):
        whole[i, :, y : y + image.shape[1], x : x + image.shape[2]] = image
    np.testing.assert_array_equal(np.asarray(one), whole)
    assert np.asarray(one, np.float32).dtype == np.float32
    assert (len(one), one.ndim, one.dtype, one.shape) == (3, 4, np.float64, whole.shape)
    assert ComponentImages((0, 2, 8, 7), np.zeros((0, 2)), []).dtype == np.float64
    for key in (1, -1, np.int64(2), (1, 0), (2, 1, slice(5, 7)), slice(1, 3), (slice(None), 0)):
        np.testing.assert_array_equal(one[key], whole[key])
    np.testing.assert_array_equal(list(one), whole)
    with pytest.raises(IndexError):
        one[3]
    for low, high in (((3, 2), (7, 6)), ((1, 1), (8, 7)), ((3, 0), (8, 6)), ((4, 3), (8, 5))):
        window = tuple(map(slice, low, high))
        np.testing.assert_array_equal(one.within(1, window), whole[1][:, *window])
    spectra = rng.random((3, 2))
    wanted = np.einsum("nc,ncyx->cyx", spectra, whole)
    for rendered in (one, ComponentImages.of(whole)):
        np.testing.assert_allclose(rendered.total(spectra), wanted)


@pytest.mark.parametrize("low", [(-1, 2), (6, 5), (2, -2), (-4, 0), (8, 0), (0, 9), (2, 3)])
def test_windows_are_cut_to_the_observation(low):
    rng = np.random.default_rng(1)
    image = rng.random((1, 4, 3))
    padded = np.zeros((1, 30, 30))
    padded[:, 10 + low[0] : 14 + low[0], 10 + low[1] : 13 + low[1]] = image
    found = ComponentImages.cropped((1, 1, 8, 7), np.array([low]), [image])
    np.testing.assert_array_equal(found[0], padded[:, 10:18, 10:17])


def test_a_profile_read_off_images_is_symmetric_and_above_the_noise():
    """Light on one side alone is omitted; light under one sigma is 0."""
    image = np.arange(30.0).reshape(5, 6)
    mirrored = image_profiles._mirror(image, (1, 2))
    assert mirrored[0, 0] == image[2, 4] and mirrored[2, 4] == image[0, 0]
    assert mirrored[3, 2] == image[3, 2] and mirrored[1, 5] == image[1, 5]  # beyond the edge
    mirrored = image_profiles._mirror(image, (3, 4))  # as near the far corner
    assert mirrored[2, 3] == image[4, 5] and mirrored[4, 5] == image[2, 3]
    np.testing.assert_array_equal(mirrored[:2], image[:2])
    np.testing.assert_array_equal(mirrored[:, :3], image[:, :3])
    images = np.zeros((2, 3, 3))
    images[0, 1, 1], images[1, 1, 1], images[1, 0, 0] = 3.0, 4.0, 10.0
    found = image_profiles._combine(images, (1, 1))
    assert found[1, 1] == pytest.approx(5) and found[0, 0] == pytest.approx(8)
    images[1, 1, 1] = -1  # a channel that does not see the centre takes no part
    np.testing.assert_allclose(image_profiles._combine(images, (1, 1)), images[0])
    images[:, 1, 1] = -1
    assert image_profiles._combine(images, (1, 1))[0, 0] == pytest.approx(10 / np.sqrt(2))


def test_the_sharpest_image_that_sees_a_source_shows_it(device):
    """Above five sigma; else all together; 30 px about it, and 1 at its own pixel at least."""
    y, x = np.indices((90, 80))

    def spot(height, sigma):
        return (height * np.exp(-0.5 * ((y - 40) ** 2 + (x - 39) ** 2) / sigma**2))[None]

    def profile(*images):
        return image_profiles._profile((90, 80), np.array([40.2, 38.9]), list(images), device)

    sharp, wide = spot(5.1, 2.0), spot(50, 6.0)
    found = profile(sharp, wide)
    assert found.max() == 1 and np.unravel_index(found.argmax(), found.shape) == (40, 39)
    assert found[40, 44] == 0  # 0.2 sigma
    assert found[40, 41] == pytest.approx(np.exp(-0.5), rel=1e-5)
    found = profile(spot(4.9, 2.0), wide)
    assert found[40, 45] == pytest.approx(np.exp(-0.5), rel=1e-5)
    beside = np.exp(-0.5 * ((y - 40) ** 2 + (x - 50) ** 2) / 4)[None]
    found = profile(spot(50, 3.0) + 20 * beside)  # what one side alone shows is none of it
    assert found[40, 50] < 0.01 and found[40, 28] < 0.01 and found[40, 42] > 0.5
    flat = profile(np.full((1, 90, 80), 8.0))
    assert flat[10:71, 9:70].min() == pytest.approx(1) and flat.sum() == pytest.approx(61**2)
    alone = profile(np.zeros((1, 90, 80)))
    assert alone.sum() == alone[40, 39] == 1


def test_extended_sources_of_one_component_get_profiles(monkeypatch):
    """Wherever they stand in the list; those that have one, and what lies outside, stay."""
    monkeypatch.setattr(image_profiles, "get_device", lambda device: device)
    monkeypatch.setattr(image_profiles, "_in_frame", lambda o, *_: o.name)
    monkeypatch.setattr(image_profiles, "_sharpness", lambda o: {"a": 2.0, "b": 1.0}[o.name])
    found = []

    def profile(shape, position, views, device):
        found.append((position.tolist(), views))
        return np.ones((2, 2))

    monkeypatch.setattr(image_profiles, "_profile", profile)
    given = np.full((2, 2), 0.5)
    sources = (
        PointSource(position_px=(1, 1)),
        ExtendedSource(position_px=(2, 2), n_components=2),
        ExtendedSource(position_px=(3, 3), profile=given),
        ExtendedSource(position_px=(4, 4)),
        ExtendedSource(position_px=(90, 5)),
        ExtendedSource(position_px=(6, 6), n_components=1),
    )
    frame = SimpleNamespace(
        shape=(20, 20),
        positions_of=lambda sources, *_: np.array([s.position_px for s in sources], float),
        contains=lambda positions: (positions < 20).all(1),
    )
    blend = Blend([SimpleNamespace(name="a"), SimpleNamespace(name="b")], sources, frame)
    made = image_profiles.with_image_profiles(blend, device="any")
    assert found == [([4, 4], ["b", "a"]), ([6, 6], ["b", "a"])]  # the sharpest first
    assert [getattr(s, "profile", None) is not None for s in made.sources] == [
        False, False, True, True, False, True
    ]  # fmt: skip
    assert made.sources[2].profile is sources[2].profile and made.frame is frame


def test_sources_outside_an_observation_have_its_psf_at_the_nearest_pixel():
    """If the observation's projection contains none of them, that at its middle."""
    at = np.array([[3.0, 4.0], [-2.0, 50.0], [np.nan, np.nan], [10.0, 40.0]])
    grid = SimpleNamespace(positions_in=lambda grid, y, x: at)
    home = view_module.SceneGeometry(SimpleNamespace(grid=grid), None, np.zeros((4, 2)), 0.0)
    observation = SimpleNamespace(grid=None, data=np.zeros((2, 13, 41)))
    assert home._on(observation).tolist() == [[3, 4], [0, 40], [6, 20], [10, 40]]
