"""Where a fit starts: slopes as finite differences, spectra as scipy's, shapes and places found."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import GALAXIES, SHAPE, blend, frame, observe, sources, truth
from scipy.optimize import lsq_linear

from clresample.deblending import spectra as spectra_module, start as start_module
from clresample.deblending.resize import SMALLEST_RADIUS_PX, box_around
from clresample.deblending.spectra import solve_spectra
from clresample.deblending.start import _ProfileFit, start
from clresample.deblending.view import WhitenedView
from clresample.resampling.cache import cached_resampler
from clresample.sky.sources import Extended, Point

FLUX = (100.0, 80.0, 90.0)


def views(device, observations, dtype=np.float64):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    found = []
    for o in observations:
        op = cached_resampler(frame(), o.grid, o.psf, dtype=dtype, device=device)
        found.append(view(op, o))
    return found


def view(op, o, covered=None):
    """An observation in its own units, with no weight where it is not covered."""
    covered = op.covered if covered is None else covered
    mapping = op.mapping
    root = np.sqrt(o.weights) * covered
    return WhitenedView(op, mapping, covered, np.ones(len(o.data)), root, o.data)


def spectra_of(found, v, fit_sky=False):
    """Spectra and sky of what a fit starts from, as the fit solves for them."""
    spectra, sky, _ = solve_spectra([w.render(found.profiles) for w in v], v, fit_sky)
    return spectra, sky


def begin(device, objects, catalogue=None, *, observations=None, **given):
    catalogue = catalogue or sources(objects)
    positions = np.array([s.position_px for s in catalogue])
    v = views(device, observations or observe(objects))
    found = start(frame(), catalogue, positions, v, **given)
    return found, *spectra_of(found, v, **given)


def test_slopes_of_chi2(device, monkeypatch):
    """By shapes and a star's place, the spectra and the sky following: half of chi2 falls by what
    `right` says."""
    for module in (start_module, spectra_module):
        monkeypatch.setattr(module, "MODEL_ERROR", 0.0)  # weights that stay
    catalogue = (*sources(), Point(position_px=(8, 28), free=True))
    objects = (*GALAXIES, ((8.3, 27.8), FLUX, 0))
    v = views(device, observe(objects))
    positions = np.array([s.position_px for s in catalogue])
    fit = _ProfileFit(frame(), catalogue, positions, v, fit_sky=True)
    theta = fit.mean + 0.1 * np.random.default_rng(0).normal(size=len(fit.mean))
    assert len(theta) == 4 + 4 + 2
    state = fit.linearise(theta)
    assert (state.spectra > 0).all()  # no spectrum is held at zero
    step = 1e-4
    for i, unit in enumerate(step * np.eye(len(theta))):
        sides = [fit.linearise(theta + sign * unit).chi2 for sign in (1, -1)]
        slope = (sides[0] - sides[1]) / (2 * step)
        assert slope == pytest.approx(-2 * state.right[i], rel=1e-5), i


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
    units = [w.render(images) for w in v]
    spectra, levels, covariance = solve_spectra(units, v, sky)
    assert (spectra >= 0).all() and (spectra == 0).any()
    channel = 0
    for w, unit in zip(v, units, strict=True):
        for c in range(unit.shape[1]):
            rows, target = unit[:, c], (w.data[c] * w.root[c]).ravel()
            if sky:
                rows = np.concatenate([rows, [w.root[c].ravel()]])
            low = np.where(np.arange(len(rows)) < len(images), 0, -np.inf)
            best = lsq_linear(rows.T, target, (low, np.inf), tol=1e-14).x
            found = np.append(spectra[:, channel], levels[channel : channel + sky])
            np.testing.assert_allclose(found, best, rtol=1e-4, atol=1e-4)
            wanted = np.linalg.inv(rows @ rows.T)[: len(images), : len(images)]
            np.testing.assert_allclose(covariance[channel], wanted, rtol=1e-5, atol=1e-12)
            channel += 1
    assert sky == bool(levels.any())


def test_components_that_nothing_sees(device):
    """Spectrum 0 of infinite variance in channels without weight; the others as without it."""
    (first, second) = views(device, observe())
    blind = replace(second, root=second.root * np.array([0, 1])[:, None, None])
    images = np.array([truth([g])[0] / g[1][0] for g in GALAXIES])
    found = []
    for v in ([first, second], [first, blind]):
        found.append(solve_spectra([w.render(images) for w in v], v))
    (spectra, _, covariance), (less, _, unseen) = found
    assert not less[:, 1].any() and np.isinf(np.diag(unseen[1])).all()
    assert unseen[1, 0, 1] == 0
    np.testing.assert_array_equal(less[:, [0, 2]], spectra[:, [0, 2]])
    np.testing.assert_array_equal(unseen[[0, 2]], covariance[[0, 2]])


def test_shapes_are_found(device):
    """Of bright galaxies: size, ellipticity and spectra as they were drawn."""
    objects = tuple((p, tuple(10 * np.array(f)), s) for p, f, s in GALAXIES)
    found, spectra, _ = begin(device, objects, observations=observe(objects, noise=0.01))
    for image, spectrum, drawn in zip(found.profiles, spectra, objects, strict=True):
        np.testing.assert_allclose(spectrum, drawn[1], rtol=0.03)
        want = truth([drawn])[0]
        assert np.abs(image * spectrum[0] - want).max() < 0.03 * want.max()


def test_a_free_star_is_found(device):
    drawn = (((15.3, 18.2), FLUX, 0),)
    held, wrong, _ = begin(device, drawn, [Point(position_px=(15, 18.5))])
    np.testing.assert_array_equal(held.positions, [(15, 18.5)])
    found, spectra, _ = begin(device, drawn, [Point(position_px=(15, 18.5), free=True)])
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
    assert np.abs(found.profiles[0] - want).max() < 0.1 * want.max()


@pytest.mark.parametrize("kind", [Point, Extended])
def test_sources_on_top_of_each_other_share_the_light(device, kind):
    drawn = ((15.0, 18.0), FLUX, 0 if kind is Point else 2.0)
    twins = [kind(position_px=(15, 18)), kind(position_px=(15, 18))]
    found, spectra, _ = begin(device, (drawn,), twins)
    np.testing.assert_allclose(spectra.sum(axis=0), FLUX, rtol=0.05)
    assert (spectra >= 0).all() and np.isfinite(found.profiles).all()
    if kind is Point:  # galaxies may share it as a compact and a wide one
        np.testing.assert_allclose(spectra[0], spectra[1], rtol=0.05)


def test_components_of_a_source(device):
    """Two about one centre, a compact and a wide one, each with its spectrum."""
    disk, bulge = ((15.0, 18.0), (50, 100, 20), 3.0), ((15.0, 18.0), (60, 10, 90), 1.0)
    catalogue = [Extended(position_px=(15, 18), n_components=2)]
    seen = observe((disk, bulge), noise=0.01)
    found, spectra, _ = begin(device, (disk, bulge), catalogue, observations=seen)
    assert found.source.tolist() == [0, 0]
    compact = int(np.argmax(found.profiles.max(axis=(1, 2))))
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
        begun = start(b.frame, b.sources, positions, v)
        found.append((begun.profiles, spectra_of(begun, v)[0]))
    (profiles, spectra), (padded, padded_spectra) = found
    np.testing.assert_allclose(padded, profiles, rtol=0, atol=1e-6)
    np.testing.assert_allclose(padded_spectra, spectra, rtol=1e-4, atol=1e-3)


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


def test_brighter_sources_get_larger_boxes():
    image = gauss((15, 18))
    areas = [np.prod(box_around(image, (15, 18), b)[1]) for b in (1, 100, 1e4, 1e6)]
    assert areas == sorted(areas) and areas[0] < areas[-1]
    low, size, center = box_around(np.ones((1, 1)), (0, 0), 10.0)
    assert (low.tolist(), size.tolist(), center.tolist()) == ([0, 0], [1, 1], [0, 0])
    assert box_around(0 * image, (15, 18), 10.0)[1].tolist() == [11, 11]
