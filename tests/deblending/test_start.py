"""Starts of fits: slopes by finite differences, spectra by scipy, shapes and positions."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import GALAXIES, SHAPE, blend, frame, observe, sources, truth
from helpers.start import least_squares, point_of, profiles, rendered, started, view, views

from clresample.deblending.linear.rendered_models import MorphologyModel, render_models
from clresample.deblending.start.boxes import SMALLEST_RADIUS_PX, box_around, component_box
from clresample.resampling.cache import cached_resampler
from clresample.sky.box import box_slices
from clresample.sky.sources import ExtendedSource, PointSource

FLUX = (100.0, 80.0, 90.0)


def begin(device, objects, catalogue=None, *, observations=None, **given):
    """Spectra and sky are for profiles of unit integral, those of the truth."""
    catalogue = catalogue or sources(objects)
    positions = np.array([s.position_px for s in catalogue])
    v = views(device, observations or observe(objects))
    found = started(frame(), catalogue, positions, v, **given)
    return found, found.spectra / found.peaks[:, None], found.sky


@pytest.mark.parametrize("sky", [False, True])
def test_spectra_are_the_non_negative_least_squares(device, sky):
    rng = np.random.default_rng(3)
    v = views(device, observe())
    images = np.array(
        [
            truth([(p, (1, 1, 1), s)])[0]
            for p, s in (((13, 12), 2), ((16, 14), 1.5), ((16, 23), 1.4), ((5, 30), 0))
        ]
    )
    v = [replace(w, data=w.data + (0.5 if sky else -0.1)) for w in v]
    v[1].data[...] += 0.3 * rng.normal(size=v[1].data.shape)
    units = [rendered(w, images) for w in v]
    found = seen_by(v, images, fit_sky=sky)
    assert (found.spectra >= 0).all() and (found.spectra == 0).any()
    spectra, levels, covariance = least_squares(units, v, sky)
    np.testing.assert_allclose(found.spectra, spectra, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.sky, levels, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-4, atol=1e-9)
    assert sky == bool(levels.any())


def seen_by(v, images, **given):
    n = len(images)
    source = np.arange(n)
    model = MorphologyModel(SHAPE, v, [None] * len(v), source, np.zeros((n, 2), int), list(images))
    return render_models([model], **given)[0]


def test_components_that_nothing_sees(device):
    """Spectrum 0 of infinite variance in channels without weight; the others as without it."""
    (first, second) = views(device, observe())
    blind = replace(second, sqrt_weights=second.sqrt_weights * np.array([0, 1])[:, None, None])
    images = np.array([truth([g])[0] / g[1][0] for g in GALAXIES])
    one, other = (seen_by(v, images) for v in ([first, second], [first, blind]))
    assert not other.spectra[:, 1].any()
    assert np.isinf(np.diag(other.covariance[1])).all() and other.covariance[1, 0, 1] == 0
    np.testing.assert_array_equal(other.spectra[:, [0, 2]], one.spectra[:, [0, 2]])
    np.testing.assert_array_equal(other.covariance[[0, 2]], one.covariance[[0, 2]])


def test_shapes_are_found(device):
    """Of bright galaxies: size, ellipticity and spectra as they were drawn."""
    objects = tuple((p, tuple(10 * np.array(f)), s) for p, f, s in GALAXIES)
    found, spectra, _ = begin(device, objects, observations=observe(objects, noise=0.01))
    unit = profiles(found, SHAPE) * found.peaks[:, None, None]
    for image, spectrum, drawn in zip(unit, spectra, objects, strict=True):
        np.testing.assert_allclose(spectrum, drawn[1], rtol=0.03)
        want = truth([drawn])[0]
        assert np.abs(image * spectrum[0] - want).max() < 0.03 * want.max()


def test_a_free_star_is_found(device):
    drawn = (((15.3, 18.2), FLUX, 0),)
    held, wrong, _ = begin(device, drawn, [PointSource(position_px=(15, 18.5))])
    np.testing.assert_array_equal(held.positions, [(15, 18.5)])
    found, spectra, _ = begin(
        device, drawn, [PointSource(position_px=(15, 18.5), free_position=True)]
    )
    np.testing.assert_allclose(found.positions, [(15.3, 18.2)], atol=0.01)
    np.testing.assert_allclose(spectra, [FLUX], rtol=0.02)
    assert abs(wrong[0, 0] - FLUX[0]) > 0.04 * FLUX[0]


def test_sky_is_found(device):
    sky = (0.3, -0.2, 0.5)
    objects = tuple((p, tuple(10 * np.array(f)), s) for p, f, s in GALAXIES)
    _, _, levels = begin(device, objects, observations=observe(objects, sky=sky), fit_sky=True)
    np.testing.assert_allclose(levels, sky, atol=0.02)


def test_a_source_that_one_instrument_sees_starts_right(device):
    """Invisible in the sharp one, its size and spectrum come from the blurred one."""
    drawn = ((14.0, 17.0), (0.0, 80.0, 90.0), 2.5)
    found, spectra, _ = begin(device, (drawn,))
    np.testing.assert_allclose(spectra[0, 1:], drawn[1][1:], rtol=0.03)
    assert spectra[0, 0] < 1
    want = truth([drawn])[1] / 80
    assert np.abs(profiles(found, SHAPE)[0] * found.peaks[0] - want).max() < 0.1 * want.max()


@pytest.mark.parametrize("kind", [PointSource, ExtendedSource])
def test_sources_on_top_of_each_other_share_the_light(device, kind):
    drawn = ((15.0, 18.0), FLUX, 0 if kind is PointSource else 2.0)
    twins = [kind(position_px=(15, 18)), kind(position_px=(15, 18))]
    found, spectra, _ = begin(device, (drawn,), twins)
    np.testing.assert_allclose(spectra.sum(axis=0), FLUX, rtol=0.05)
    assert (spectra >= 0).all() and np.isfinite(found.peaks).all()
    if kind is PointSource:  # galaxies may share it as a compact and a wide one
        np.testing.assert_allclose(spectra[0], spectra[1], rtol=0.05)


def test_components_of_a_source(device):
    """Two about one centre, a compact and a wide one, each with its spectrum."""
    disk, bulge = ((15.0, 18.0), (50, 100, 20), 3.0), ((15.0, 18.0), (60, 10, 90), 1.0)
    catalogue = [ExtendedSource(position_px=(15, 18), n_components=2)]
    seen = observe((disk, bulge), noise=0.01)
    found, spectra, _ = begin(device, (disk, bulge), catalogue, observations=seen)
    assert found.source.tolist() == [0, 0]
    compact = int(np.argmax(found.peaks))
    np.testing.assert_allclose(spectra[compact], bulge[1], rtol=0.15, atol=4)
    np.testing.assert_allclose(spectra[1 - compact], disk[1], rtol=0.15, atol=4)


def test_wings_beyond_the_frame_are_no_light(device):
    """A padded operator gives a frame's profiles what the frame's own gives them."""
    b = blend()
    wide = type(b.frame)(b.frame.grid.cutout(0, 0, (48, 48)), b.frame.psf)
    found = []
    for home, extent in ((b.frame, None), (wide, SHAPE)):
        v = []
        for o in b.observations:
            op = cached_resampler(
                home, o.grid, o.psf, dtype=np.float32, device=device, extent=extent
            )
            covered = cached_resampler(
                b.frame, o.grid, o.psf, dtype=np.float32, device=device
            ).covered
            v.append(view(op, o, covered))
        positions = np.array([(28.0, 34.0), (1.0, 15.0)])
        begun = started(b.frame, b.sources, positions, v)
        found.append((profiles(begun, SHAPE), begun.spectra))
    (alone, spectra), (padded, padded_spectra) = found
    np.testing.assert_allclose(padded, alone, rtol=0, atol=1e-4)
    np.testing.assert_allclose(padded_spectra, spectra, rtol=1e-3, atol=1e-3)


def gauss(position, sigma=2.0):
    y, x = np.indices(SHAPE)
    return np.exp(-((y - position[0]) ** 2 + (x - position[1]) ** 2) / (2 * sigma**2))


@pytest.mark.parametrize("position", [(15, 18), (0, 0), (29.4, 35.4), (-0.5, 20), (14.5, 3.49)])
@pytest.mark.parametrize("brightness", [0.0, 1.0, 1e3, 1e9, np.inf])
def test_boxes_lie_in_the_frame_around_their_centre(position, brightness):
    low, size, center = box_around(gauss(position), position, brightness)
    pixel = np.floor(np.array(position) + 0.5)
    np.testing.assert_array_equal(low + center, pixel)
    assert (low >= 0).all() and (low + size <= SHAPE).all()
    assert (size >= 1).all() and (0 <= center).all() and (center < size).all()
    near = np.minimum(pixel, np.array(SHAPE) - 1 - pixel)
    reach = np.minimum(center, size - 1 - center)
    assert (reach >= np.minimum(near, SMALLEST_RADIUS_PX)).all()


def test_boxes_of_a_start_are_those_of_its_images(device):
    found, _, _ = begin(device, GALAXIES, observations=observe(noise=0.01))
    images = profiles(found, SHAPE)
    for i, image in enumerate(images):
        for brightness in (1.0, 30.0, 1e4):
            low, size, center, part = component_box(found, i, SHAPE, brightness)
            wanted = box_around(image, found.positions[i], brightness)
            np.testing.assert_array_equal((low, size, center), wanted)
            np.testing.assert_allclose(part, image[box_slices(low, size)], rtol=1e-12)
    given = point_of(images[:1], found.positions[0])
    np.testing.assert_array_equal(
        component_box(given, 0, SHAPE, 30.0)[1], box_around(images[0], found.positions[0], 30.0)[1]
    )


def test_brighter_sources_get_larger_boxes():
    image = gauss((15, 18))
    areas = [np.prod(box_around(image, (15, 18), b)[1]) for b in (1, 100, 1e4, 1e6)]
    assert areas == sorted(areas) and areas[0] < areas[-1]
    low, size, center = box_around(np.ones((1, 1)), (0, 0), 10.0)
    assert (low.tolist(), size.tolist(), center.tolist()) == ([0, 0], [1, 1], [0, 0])
    assert box_around(0 * image, (15, 18), 10.0)[1].tolist() == [11, 11]
