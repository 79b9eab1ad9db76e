"""Fitted morphologies as observations see them, beside whole frames; weights about bright stars."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import BRIGHT, SHAPE, frame, observe
from helpers.start import least_squares, rendered, view, views

from clresample.deblending.linear import rendered_models
from clresample.deblending.linear.rendered_models import (
    MorphologyModel,
    render_models,
    solve_models,
)
from clresample.deblending.linear.slot_observation import SlotObservation
from clresample.deblending.profiles import StarProfile
from clresample.deblending.start.star_weights import MIN_PSF_ERROR_SIGMA, allow_for_psf_error
from clresample.resampling.cache import cached_resampler
from clresample.sky.psf import PSF

BOXES = (((4, 2), (15, 14)), ((10, 14), (14, 17)), ((3, 5), (24, 26)))


def spot(shape):
    """An image with maximum 1, brightest beside its middle."""
    y, x = (np.arange(n) - 0.45 * n for n in shape)
    return np.exp(-0.5 * (y[:, None] ** 2 / 2.5**2 + x**2 / 2.0**2))


def whole(origin, image):
    out = np.zeros(SHAPE)
    out[origin[0] : origin[0] + image.shape[0], origin[1] : origin[1] + image.shape[1]] = image
    return out


@pytest.mark.parametrize("fit_sky", [False, True])
@pytest.mark.parametrize("whole_px", [rendered_models.WHOLE_PX, 0])
def test_models_are_seen_side_by_side_each_with_its_own_spectra(
    device, fit_sky, whole_px, monkeypatch
):
    """Whole frames and boxes; the second observation was taken with another PSF than it is fitted
    with."""
    monkeypatch.setattr(rendered_models, "WHOLE_PX", whole_px)
    sky = (0.4, -0.3, 0.2) if fit_sky else (0, 0, 0)
    own = [views(device, observe(BRIGHT, seed=i, sky=sky)) for i in range(2)]
    if fit_sky:
        level = np.full(2, 0.1)
        own = [
            [v.expecting_sky(level[: len(v.data)], 0.03 + i) for v in some]
            for i, some in enumerate(own)
        ]
    wider = PSF.gaussian(1.5, n_pixels=19, n_bands=2)
    o = observe(BRIGHT)[1]
    op = cached_resampler(frame(), o.grid, wider, dtype=np.float64, device=device)
    bare = view(op, o)
    images = [spot(shape) for _, shape in BOXES]
    models, close = [], 1e-6 if whole_px else 2e-3
    for of, part, other in zip(own, (BOXES[:2], BOXES[2:]), ([None, bare], [None, None])):
        low = np.array([origin for origin, _ in part])
        shown = images[: len(part)] if len(part) == 2 else images[2:]
        known = 100 + 10 * np.arange(3 * len(part)).reshape(-1, 3), np.array([0.2, -0.1, 0.3])
        source = np.zeros(len(part), int)
        models.append(MorphologyModel(SHAPE, of, other, source, low, shown, *known))
    found = render_models(models, fit_sky=fit_sky)
    for model, seen in zip(models, found, strict=True):
        pairs = zip(model.origin, model.morphs, strict=True)
        frames = np.array([whole(*pair) for pair in pairs])
        units = [rendered(v, frames) for v in model.views]
        spectra, level, covariance = least_squares(units, model.views, sky=fit_sky)
        np.testing.assert_allclose(seen.spectra, spectra, rtol=10 * close)
        np.testing.assert_allclose(seen.sky, level, atol=10 * close)
        scale = np.abs(covariance).max()
        np.testing.assert_allclose(seen.covariance, covariance, atol=10 * close * scale)
        parts, left, power = (slice(0, 1), slice(1, 3)), [], []
        for unit, v, own_channels in zip(units, model.views, parts, strict=True):
            root, data = (x.reshape(len(v.data), -1) for x in (v.sqrt_weights, v.data))
            rest = root * (data - model.sky[own_channels, None])
            rest -= np.einsum("ic,icp->cp", model.spectra[:, own_channels], unit)
            left.append(np.einsum("icp,cp->ic", unit, rest))
            power.append(np.square(unit).sum(2))
        left, power = np.concatenate(left, 1), np.concatenate(power, 1)
        np.testing.assert_allclose(seen.slope, left, atol=10 * close * np.abs(left).max())
        np.testing.assert_allclose(seen.power, power, rtol=10 * close)
        for v, other, shown, taken in zip(
            model.views, model.unfiltered_views, seen.observed, seen.unfiltered_views, strict=True
        ):
            wanted = v.op.render(frames)
            shown, taken = (np.asarray(images) * v.covered for images in (shown, taken))
            np.testing.assert_allclose(shown, wanted, atol=close * wanted.max())
            wanted = (other or v).op.render(frames)  # where one is asked for, all are seen
            np.testing.assert_allclose(taken, wanted, atol=close * wanted.max())
    for model in models:
        model.unfiltered_views[:] = [None, None]
    assert all(
        seen.unfiltered_views == (None, None) for seen in render_models(models, fit_sky=fit_sky)
    )
    solved = solve_models(models, fit_sky=fit_sky)
    for model, seen, (spectra, level, chi2) in zip(models, found, solved, strict=True):
        np.testing.assert_array_equal(spectra, seen.spectra)
        np.testing.assert_array_equal(level, seen.sky)
        pairs = zip(seen.residuals((slice(0, 1), slice(1, 3)), model.views), model.views)
        wanted = sum((np.square(left) * v.weights).sum() for left, v in pairs)
        if fit_sky:
            known = np.concatenate([v.sky_precision for v in model.views])
            wanted += known @ np.square(level)
        assert chi2 == pytest.approx(wanted, rel=close)


def star(flux):
    home = frame()
    place = np.array([14.3, 17.6])
    return StarProfile(home, free=True), 0, place, np.asarray(flux, float)


def wrong_light(one, v, spectrum):
    """L and r . grad L of a star, whitened views' units, by finite differences of its place."""
    shape, _, place, _ = one
    n, m = np.indices(v.mapping.shape_out)
    away = v.mapping.at(n, m) - place

    def at(offset):
        image = shape.draw(np.zeros(2), place + offset)[:1]
        return spectrum[:, None, None] * v.op.render(image)[0]

    h = 1e-3
    slopes = [(at(h * unit) - at(-h * unit)) / (2 * h) for unit in np.eye(2)]
    return at(np.zeros(2)), -(away[..., 0] * slopes[0] + away[..., 1] * slopes[1])


def test_weights_hold_the_psfs_error_in_all_stars(device):
    """1/w = sigma^2 + psf_error^2 sum (L^2 + (r . grad L)^2), of each star its own."""
    own = views(device, observe(BRIGHT))
    stars = [star([3e3, 2e3, 4e3]), star([1e3, 5e3, 2e3])]
    stars[1][2][:] = 9.2, 25.1
    found = allow_for_psf_error(frame(), own, stars, 0.02)
    for old, new, part in zip(own, found, (slice(0, 1), slice(1, 3)), strict=True):
        error = 0.0
        for one in stars:
            light, change = wrong_light(one, old, one[3][part])
            error = error + light**2 + change**2
        seen = old.sqrt_weights > 0
        assert (new.sqrt_weights[~seen] == 0).all()
        added = np.maximum(new.sqrt_weights[seen] ** -2.0 - old.sqrt_weights[seen] ** -2.0, 0)
        wanted = 0.02 * np.sqrt(error[seen])
        # boxes have an operator of their own, whose error is a part of the brightest pixel
        np.testing.assert_allclose(np.sqrt(added), wanted, rtol=1e-3, atol=3e-3 * wanted.max())
        assert (new.sqrt_weights < 0.5 * old.sqrt_weights).any()
        assert new.data is old.data


@pytest.mark.parametrize("brightness, changes", [(1.3, True), (0.7, False)])
def test_stars_count_where_their_error_shows_in_a_pixel(device, brightness, changes):
    """Above MIN_PSF_ERROR_SIGMA of a pixel's noise in an observation; the others keep their
    weights."""
    own = views(device, observe(BRIGHT))
    one = star([1.0, 1e-9, 1e-9])
    light, change = wrong_light(one, own[0], one[3][:1])
    largest = (np.sqrt(light**2 + change**2) * own[0].sqrt_weights).max()
    one[3][:] *= brightness * MIN_PSF_ERROR_SIGMA / (0.03 * largest)
    found = allow_for_psf_error(frame(), own, [one], 0.03)
    assert (found[0] is not own[0]) == changes and found[1] is own[1]
    assert allow_for_psf_error(frame(), own, [one], 0.0) == own


def test_what_is_seen_is_listed_by_scene_and_component():
    """Slots come in another order; of each the part of its window that is lit, where that lies on
    the observation."""
    rng, n_bands, shape = np.random.default_rng(0), 2, (9, 11)
    at, scene = np.array([3, 0, 2, 1]), np.array([1, 0, 1, 0])
    windows = np.array([(2, 3, 5, 4), (-2, 6, 6, 7), (0, 0, 3, 3), (6, -1, 4, 5)])
    lit = np.array([(3, 3, 2, 4), (-1, 6, 4, 6), (0, 0, 3, 3), (7, 1, 3, 2)])
    sizes = n_bands * windows[:, 2:].prod(axis=1)
    begin = np.cumsum(sizes) - sizes + 5
    flat = rng.random(sizes.sum() + 9).astype(np.float32)
    wanted = np.zeros((4, n_bands, *shape))
    for row, (y, x, wy, wx) in enumerate(windows):
        whole = np.zeros((n_bands, 40, 40))
        part = flat[begin[row] : begin[row] + sizes[row]].reshape(n_bands, wy, wx)
        whole[:, y + 10 : y + 10 + wy, x + 10 : x + 10 + wx] = part
        low, high = lit[row, :2] + 10, lit[row, :2] + lit[row, 2:] + 10
        inside = np.zeros((40, 40), bool)
        inside[low[0] : high[0], low[1] : high[1]] = True
        wanted[at[row]] = (whole * inside)[:, 10:19, 10:21]
    place = np.column_stack([scene, windows, np.ones(4, int), begin])
    sight = object.__new__(SlotObservation)
    vars(sight).update(seen=flat, n_bands=n_bands, my=9, mx=11, place=place, lit=lit)
    sight.device, slots = SimpleNamespace(get=lambda array: array), SimpleNamespace(scene=scene)
    looking = SimpleNamespace(n_scenes=3, sights=[sight, sight], at=at, slots=slots)
    found = rendered_models._taken(looking)
    for b, own in enumerate(([0, 1], [2, 3], [])):
        for shown in found[b]:
            assert shown.shape == (len(own), n_bands, *shape)
            np.testing.assert_array_equal(np.asarray(shown), wanted[own])
        assert len(found[b]) == 2
