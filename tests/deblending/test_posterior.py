"""Errors that are the posterior's, beside dense float64 references, draws, and truth."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.posterior import capture, dense_error, full_matrix
from helpers.scenes import BRIGHT, blend
from scipy.signal import fftconvolve

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.posterior import exposure
from clresample.deblending.posterior.bumps import Bumps, uncorrelated
from clresample.deblending.posterior.moments import moments_of
from clresample.deblending.posterior.profile_modes import profile_modes
from clresample.deblending.profiles import Galaxy, Given, Star
from clresample.deblending.result import Component
from clresample.deblending.settings import Settings
from clresample.deblending.solver.learned.prior import LearnedPrior
from clresample.deblending.solver.prior import Prior
from clresample.files.results import read_result, write_result
from clresample.measurement.catalogue import catalogue
from clresample.measurement.photometry import fluxes
from clresample.measurement.shapes import moments
from clresample.sky.sources import Extended, Point

ALONE = (((14.3, 17.6), (60, 40, 80), 2.0),)
BARE = Settings(flux_floor=0)
PAIR = (((14.0, 12.0), (80, 50, 90), 2.0), ((15.5, 16.5), (60, 70, 50), 1.6))


def errors(result):
    """Of the fluxes (S, C)."""
    return np.sqrt(np.einsum("css->sc", fluxes(result)[1]))


@pytest.fixture(scope="module")
def fitted(device):
    return scenes.fit(blend(BRIGHT), device, settings=BARE)


def test_the_error_of_a_lone_source_is_the_dense_one(device, monkeypatch):
    """Over all pixels' structure: a few bumps reach 97 % of it, and never more."""
    kept = capture(monkeypatch)
    result = scenes.fit(blend(ALONE), device, settings=BARE)
    dense = dense_error(kept[0], 0)
    ratio = errors(result)[0] / dense
    assert (ratio < 1.005).all() and (ratio > 0.97).all()
    fixed = errors(replace(result, errors=None))[0]
    assert (errors(result)[0] > 1.25 * fixed).all()


def test_blended_sources_exchange_light(device, monkeypatch):
    kept = capture(monkeypatch)
    result = scenes.fit(blend(PAIR), device, settings=BARE)
    for i in (0, 1):
        ratio = errors(result)[i] / dense_error(kept[0], i)
        assert (ratio < 1.005).all() and (ratio > 0.85).all()
    correlation = result.errors.flux[0, 0, 1] / np.prod(errors(result)[:, 0])
    assert correlation < -0.5


@pytest.mark.parametrize("free", [{}, {"fit_sky": True, "fit_shifts": True}], ids=["", "free"])
@pytest.mark.parametrize("objects", [BRIGHT, PAIR], ids=["apart", "blended"])
@pytest.mark.parametrize("angle", [0, 20])
def test_the_normal_matrix_is_that_of_the_rendered_frame(device, monkeypatch, objects, free, angle):
    """By the operators, on all pixels of whole frames; turned pixels are replaced by others."""
    found, kept = [], capture(monkeypatch)
    for reach in (exposure.REACH_FWHM, 100.0):
        monkeypatch.setattr(exposure, "REACH_FWHM", reach)
        settings = Settings(flux_floor=0, **free)
        found.append(scenes.fit(blend(objects, angle=angle), device, settings=settings))
    for one, tolerance in zip(kept, (3e-2, 3e-2 if angle else 3e-3), strict=True):
        wanted = full_matrix(one)
        scale = np.sqrt(np.diag(wanted))
        scale = scale[:, None] * scale
        np.testing.assert_allclose(one.matrix / scale, wanted / scale, atol=tolerance)
    np.testing.assert_allclose(errors(found[0]), errors(found[1]), rtol=0.01)


def gaussians(origin, shape, h):
    """Every h pixels of the frame, of width h / 2, on a box (ny, nx) that starts at `origin`."""
    y, x = np.indices(shape)
    low = [o // h * h - h for o in origin]
    rows, columns = (
        np.arange(a, o + n + 2 * h, h) - o for a, o, n in zip(low, origin, shape, strict=True)
    )
    away = [((y - a) ** 2 + (x - b) ** 2) / (h / 2) ** 2 for a in rows for b in columns]
    return np.exp(-0.5 * np.array(away))


def test_bumps_are_convolutions_by_definition():
    prior, shape, origin = LearnedPrior(), (23, 27), (13, 22)
    y, x = np.indices(shape)
    profile = np.exp(-0.5 * ((y - 10) ** 2 + (x - 14) ** 2) / 3.0**2)
    shared = (np.abs(y - 11) < 4) & (x > 9) & (x < 18)
    strengths = np.array([0.02, 0.06, 0.03])
    bumps = Bumps(origin, profile, strengths, prior.kernels(), shared)
    coarse, fine = (gaussians(origin, shape, h) for h in (8, 4))
    light = [(bump * profile).max((1, 2)) > 1e-4 for bump in (coarse, fine)]
    wanted = np.concatenate(
        [coarse[light[0]], fine[light[1] & ((fine * shared).max((1, 2)) > 0.8)]]
    )
    assert len(wanted) > light[0].sum() > 9
    seen = np.zeros_like(wanted)
    for a, k in zip(strengths, prior.kernels(), strict=True):
        twice = np.convolve(k, k)
        for out, bump in zip(seen, wanted, strict=True):
            full, r = fftconvolve(bump, np.outer(twice, twice)), len(twice) // 2
            out += a**2 * full[r : r + shape[0], r : r + shape[1]]
    gram = np.tensordot(wanted, seen, ((1, 2), (1, 2)))
    scale = 1 / np.sqrt(np.diag(gram))
    np.testing.assert_allclose(
        bumps.images, np.sqrt(profile) * seen * scale[:, None, None], atol=1e-9
    )
    expected = gram * scale[:, None] * scale
    np.testing.assert_allclose(bumps.precision, expected, atol=1e-9)
    # one number each: the same covariance of the pixels
    own = uncorrelated(bumps.images, bumps.precision)
    pixels = [images.reshape(len(images), -1) for images in (bumps.images, own)]
    covariance = pixels[0].T @ np.linalg.pinv(bumps.precision, rcond=1e-8) @ pixels[0]
    largest = np.abs(covariance).max()
    np.testing.assert_allclose(pixels[1].T @ pixels[1], covariance, atol=1e-4 * largest)


@pytest.mark.parametrize("kind", ["galaxy", "given", "star"])
def test_slopes_are_finite_differences(kind):
    home, e = scenes.frame(), 1e-4
    position, box = np.array([13.3, 15.8]), (slice(3, 25), slice(4, 30))
    shape = {"galaxy": Galaxy(home), "star": Star(home, free=True)}.get(kind)
    theta = np.array([0.6, 0.2, -0.1, 1.4]) if kind == "galaxy" else np.zeros(2)
    if kind == "given":
        shape, theta = (
            Given(Galaxy(home).draw(np.array([0.6, 0.2, -0.1, 1.4]), position)[0]),
            np.zeros(0),
        )
    drawn = shape.draw(theta, position)[0]
    profile = (drawn / drawn.max())[box]
    low = np.array([part.start for part in box])
    images, scatter, far = profile_modes(shape, theta, position, profile, low)
    assert len(images) == len(scatter) == {"galaxy": 8, "given": 4, "star": 2}[kind]
    for i, d in enumerate(e * np.eye(len(theta))):
        change = shape.draw(theta + d, position)[0] - shape.draw(theta - d, position)[0]
        np.testing.assert_allclose(images[i], change[box] / (2 * e) / drawn.max(), atol=1e-6)
    if kind == "galaxy":
        for i, d in enumerate(e * np.eye(2)):
            change = shape.draw(theta, position + d)[0] - shape.draw(theta, position - d)[0]
            np.testing.assert_allclose(
                images[4 + i], change[box] / (2 * e) / drawn.max(), atol=1e-6
            )
    if kind != "galaxy":
        assert not far.sums.any()
    if kind != "star":
        np.testing.assert_allclose(images[-2:], [profile**2, profile**0.5])
        assert images[-4][5].sum() < 0 < images[-4][16].sum()  # moved to larger y: less light below


def test_slopes_of_moments_are_finite_differences():
    rng, light = np.random.default_rng(0), np.array([2.0, 3.0])
    origins = np.array([[3, 4], [5, 1]])
    morphs = [rng.random((7, 9)), rng.random((6, 8))]
    change = [rng.normal(size=m.shape) for m in morphs]

    sums = np.abs(rng.random((2, 6))) * [2, 10, 10, 100, 30, 100]
    more = rng.normal(size=(2, 6))

    def at(e):
        moved = [m + e * d for m, d in zip(morphs, change, strict=True)]
        parts = [Component(0, tuple(o), m, np.ones(1)) for o, m in zip(origins, moved, strict=True)]
        inside = [a * m.sum() for a, m in zip(light, moved, strict=True)]
        c, q = moments(parts, inside, sums + e * more)
        return np.array([*c, q[0, 0], q[1, 0], q[1, 1]])

    slopes, by_sums = moments_of(origins, morphs, light, sums)
    found = sum(a * np.tensordot(s, d, 2) for a, s, d in zip(light, slopes, change, strict=True))
    found = found + by_sums @ (light @ more)
    np.testing.assert_allclose(found, (at(1e-5) - at(-1e-5)) / 2e-5, rtol=1e-6)


def test_what_lies_beyond_a_box_is_counted(device):
    """Flux, place and size are those of the whole profile, wherever the box ends."""
    home, position = scenes.frame(), np.array([13.3, 15.8])
    shape, theta = Galaxy(home), np.array([0.9, 0.2, -0.1, 1.0])
    whole = shape.draw(theta, position + 60, (150, 156))[0]
    whole /= whole.max()
    low = np.array([4, 6])
    box = whole[64:84, 66:86]
    _, _, far = profile_modes(shape, theta, position, box, low)
    y, x = (np.arange(n) - 60.0 for n in whole.shape)
    for k, (a, b) in enumerate(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
        wanted = (y**a @ whole @ x**b) - (y[64:84] ** a @ box @ x[66:86] ** b)
        if a + b < 2:
            assert far.sums[k] == pytest.approx(wanted, rel=0.25)
    assert far.sums[0] > 0.01 * box.sum()
    result = scenes.fit(blend(BRIGHT), device)
    total = fluxes(result)[0]
    for i, c in enumerate(result.components):
        more = 1 + result.errors.beyond[i, 0] / c.morphology.sum()
        np.testing.assert_allclose(total[i], c.flux * more)


def test_draws_scatter_as_the_errors_say(fitted):
    """But for what lies beyond the boxes, where draws end."""
    rng, found, centroids, pixels = np.random.default_rng(0), [], [], []
    for components in fitted.sample(500, rng):
        found.append([c.flux for c in components])
        centroids.append([moments([c], [1.0])[0] for c in components])
        pixels.append(components[0].morphology)
    inverse = fitted.draws.factor.inverse()
    for i, (c, modes) in enumerate(zip(fitted.components, fitted.draws.modes, strict=True)):
        covariance, k = inverse.block(i, i), len(modes)
        unit = np.diag(fitted.draws.unit)
        by_unknown = [np.outer(c.spectrum, modes.sum((1, 2))), c.morphology.sum() * unit]
        rows = np.concatenate(by_unknown, axis=1)
        wanted = np.sqrt(np.diag(rows @ covariance @ rows.T))
        np.testing.assert_allclose(np.std(found, axis=0)[i], wanted, rtol=0.12)
        assert (wanted < 1.01 * errors(fitted)[i]).all() and (
            wanted > 0.8 * errors(fitted)[i]
        ).all()
        slope = moments_of(np.array([c.origin]), [c.morphology], np.ones(1))[0][0][:2]
        rows = np.tensordot(slope, modes, ((1, 2), (1, 2)))
        wanted = np.sqrt(np.diag(rows @ covariance[:k, :k] @ rows.T))
        np.testing.assert_allclose(np.std(centroids, axis=0)[i], wanted, rtol=0.15)
    bright = fitted.components[0].morphology > 0.3
    spread = np.std(pixels, axis=0)[bright]
    np.testing.assert_allclose(spread, fitted.errors.morphology[0][bright], rtol=0.2)
    assert len(fitted.sample(0, rng)) == 0


def test_errors_hold_the_truth(device):
    """68 % of what is measured on 30 scenes of other noise: a smoke test, of 180 fluxes."""
    blends = [blend(BRIGHT, seed=seed) for seed in range(30)]
    pulls = {"flux": [], "y_centroid": [], "x_centroid": []}
    for result in deblend_many(blends, device=device):
        table = catalogue(result)
        truth = np.array([flux for _, flux, _ in BRIGHT])
        pulls["flux"] += ((fluxes(result)[0] - truth) / errors(result)).ravel().tolist()
        for k, name in enumerate(("y_centroid", "x_centroid")):
            where = np.array([position[k] for position, _, _ in BRIGHT])
            pulls[name] += ((table[name].value - where) / table[f"{name}_err"].value).tolist()
    for name, values in pulls.items():
        held = (np.abs(values) < 1).mean()
        assert 0.5 < held < 0.9, (name, held)


def test_stars(device):
    """Free ones have errors of their places, others of fluxes alone."""
    objects = (((13.2, 12.1), (60, 40, 80), 0), ((16.0, 23.3), (50, 120, 100), 0), BRIGHT[0])
    objects = (*objects[:2], ((22.0, 14.0), (60, 90, 50), 1.5))
    sources = (
        Point(position_px=objects[0][0], free=True),
        Point(position_px=objects[1][0]),
        Extended(position_px=objects[2][0]),
    )
    b = replace(blend(objects), sources=sources)
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    table = catalogue(result)
    assert np.isfinite(table["y_centroid_err"]).tolist() == [True, False, True]
    assert np.isfinite(table["size_err"]).tolist() == [False, False, True]
    assert 0.003 < table["y_centroid_err"][0].value < 0.1
    assert np.isfinite(errors(result)).all()


def test_the_floor_is_added_in_quadrature_and_leaves_colours(device, fitted, monkeypatch):
    """Times the square of how unlike smooth profiles the sources are, found to be near 1."""
    kept = capture(monkeypatch)
    floored = scenes.fit(blend(BRIGHT), device, settings=Settings(flux_floor=0.01))
    flux = fluxes(fitted)[0]
    unlike = np.array([kept[0].posterior.solution.unlikeness(i) for i in (0, 1)])
    assert ((unlike > 0.5) & (unlike < 1.5)).all()
    floor = 0.01 * unlike[:, None] ** 2 * flux
    np.testing.assert_allclose(errors(floored) ** 2, errors(fitted) ** 2 + floor**2, rtol=1e-6)
    for a, b, f in zip(fitted.errors.colour, floored.errors.colour, flux, strict=True):
        slope = np.array([1 / f[0], -1 / f[1], 0])  # of ln(f_0 / f_1)
        assert slope @ b @ slope == pytest.approx(slope @ a @ slope, rel=1e-6)
    with pytest.raises(ValueError, match="flux_floor"):
        Settings(flux_floor=-0.1)


@pytest.mark.parametrize("prior", [Prior(), None], ids=["one scale", "none"])
def test_other_priors_keep_errors_of_fixed_morphologies(device, prior):
    result = scenes.fit(blend(BRIGHT), device, settings=Settings(prior=prior, max_iter=20))
    assert result.errors is None and result.draws is None
    sums = np.array([c.morphology.sum() for c in result.components])
    wanted = np.sqrt(np.einsum("css->sc", result.covariance)) * sums[:, None]
    np.testing.assert_allclose(errors(result), wanted, rtol=1e-12)
    assert np.isnan(catalogue(result)["size_err"]).all()
    with pytest.raises(ValueError, match="draw"):
        result.sample(1, np.random.default_rng(0))


def test_a_channel_that_sees_nothing(device):
    """Its fluxes have no error; the others' are finite."""
    b = blend(BRIGHT)
    dark = b.observations[1].weights.copy()
    dark[1] = 0
    o = b.observations[1]
    changed = type(o)(o.data, o.psf, o.grid, weights=dark, channels=o.channels, name=o.name)
    result = deblend((b.observations[0], changed), b.sources, frame=b.frame, device=device)
    assert np.isinf(errors(result)[:, 2]).all() and np.isfinite(errors(result)[:, :2]).all()
    assert np.isfinite(result.errors.moments).all()


def test_stored_and_read_back(fitted, tmp_path):
    write_result(tmp_path / "blend.fits", fitted)
    found = read_result(tmp_path / "blend.fits")
    for name in ("flux", "colour", "moments"):
        np.testing.assert_array_equal(getattr(found.errors, name), getattr(fitted.errors, name))
    for one, other in zip(found.errors.morphology, fitted.errors.morphology, strict=True):
        np.testing.assert_array_equal(one, other)
    assert found.draws is None
    one, other = catalogue(found), catalogue(fitted)
    for name in other.colnames:
        np.testing.assert_array_equal(one[name], other[name])
