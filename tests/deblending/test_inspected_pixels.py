"""Noise, cosmic rays and saturated pixels are found before a fit."""

import numpy as np
import pytest
from helpers.inspection import (
    DRAWN,
    FWHM_SIGMA,
    NOISE,
    SHAPE,
    image_of,
    inspected,
    looked_at,
    observed,
    sources_of,
    with_photon_noise,
)

from clresample.deblending.inspection import levels, pixel_noise, spoilt
from clresample.deblending.inspection.psf_samples import pair_ratios, psf_at
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import PointSource


@pytest.mark.parametrize("seed", range(3))
def test_smooth_noise_and_integers_scatter_as_their_weights_say(seed):
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(2, *SHAPE)), (0, 1, 1))
    data = image_of(noise=0) + NOISE * noise / noise.std()
    assert inspected([observed(data, noise="estimate")]).messages == []
    data = np.rint(image_of(noise=0.5, seed=seed))
    weights = 1 / (0.5**2 + 1 / 12)
    assert inspected([observed(data, weights=weights)]).messages == []


@pytest.mark.parametrize("width, declared", [(0.0, None), (0.6, None), (0.6, "estimate")])
def test_correlated_noise_is_named_unless_it_is_declared(width, declared):
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(3).normal(size=(2, *SHAPE)), (0, width, width))
    data = image_of(noise=0) + NOISE * noise / noise.std()
    found = inspected([observed(data, noise=declared)]).messages
    assert len(found) == (width > 0 and declared is None)
    for message in found:
        assert 'noise="estimate"' in message and "(g)" in message and "(r)" in message
        ratio = float(message.partition("scatter ")[2].split()[0])
        assert ratio == pytest.approx(1 / noise.std(), rel=0.3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_noise_is_white_or_not_whatever_light_is_there(slope, seed):
    """Smooth light makes neighbouring pixels alike, as correlated noise does."""
    from scipy.ndimage import shift

    white = np.random.default_rng(seed).normal(size=(48, 48))
    y, x = np.indices((40, 40))
    light, pixels = slope * np.hypot(y - 20, x - 20), np.ones((40, 40), bool)
    pixels[15:25, 15:25] = False
    noise = white[4:-4, 4:-4]
    assert pixel_noise._is_white(noise + light, pixels)
    for order in (1, 3):
        moved = shift(white, (0.3, 0.2), order=order)[4:-4, 4:-4]
        assert not pixel_noise._is_white(moved / moved.std() + light, pixels)


@pytest.mark.parametrize("brightness", [100, 300, 3000])
def test_light_that_fills_the_image_is_not_taken_for_noise(brightness):
    y, x = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2
    light = brightness * NOISE * ((np.hypot(y, x) + 3) / 10) ** -2
    messages = " ".join(inspected([observed(image_of() + light)]).messages)
    assert messages and "noise of" not in messages and "weights say" not in messages


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_wrong_weights_are_named(factor):
    (message,) = inspected([observed(image_of(), weights=(factor * NOISE) ** -2)]).messages
    stated = float(message.partition("weights say: by ")[2].split()[0])
    assert stated == pytest.approx(1 / factor, rel=0.1) and "scale weights" in message


def test_levels_allow_for_correlated_noise():
    from scipy.ndimage import gaussian_filter

    white = np.random.default_rng(3).normal(0, 1, (2, 96, 96))
    data = gaussian_filter(white, (0, 2, 2))
    data *= NOISE / data.std()
    level = levels.sky_level(looked_at(observed(data)))
    alone = levels.sky_level(looked_at(observed(NOISE * white)))
    assert (level.error > 3 * alone.error).all()


@pytest.mark.parametrize("at", [(8, 50), (33, 8)])
def test_cosmic_rays_are_masked(at):
    data = image_of()
    for k in range(6):  # a slanted track
        data[1, at[0] + k // 2, at[1] + k] += 60 * NOISE
    o = observed(data)
    found = inspected([o])
    (message,) = found.messages
    assert (
        "channel r has pixels sharper than its PSF" in message
        and ": 6, the" in message
        and str(at) in message
    )
    weights = found.blend.observations[0].weights
    assert (weights[1, at[0] : at[0] + 2, at[1] : at[1] + 3] == 0).all()
    assert (weights == 0).sum() < 40 and (weights[0] > 0).all()
    assert (o.weights > 0).all()  # the user's own stays


@pytest.mark.parametrize("beside, sigmas", [(0, 18), (2, 20), (3, 15)])
def test_rays_on_light_are_found_above_its_photon_noise(beside, sigmas):
    star, at = (((33.2, 30.3), (1e5, 1e5), 0.0),), (0, 33, 30 + beside)
    o = with_photon_noise(star)
    assert not spoilt.sharper_than_psf(looked_at(o, sources_of(star))).any()
    data = o.data.copy()
    data[at] += sigmas * o.weights[at] ** -0.5
    image = looked_at(observed(data, weights=o.weights), sources_of(star))
    assert np.argwhere(spoilt.sharper_than_psf(image)).tolist() == [[*at]]


@pytest.mark.parametrize("given_sigma", [FWHM_SIGMA, 1.3 * FWHM_SIGMA])
def test_stars_are_never_masked(given_sigma):
    """Nor where the PSF is too wide, nor where nobody listed them."""
    stars = tuple((p, (1e5, 1e5), 0.0) for p, _, _ in DRAWN)
    found = inspected(
        [observed(image_of(stars), sigma=given_sigma)], sources_of(stars[:1], PointSource)
    )
    assert all((o.weights > 0).all() for o in found.blend.observations)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.8, 1.5])
def test_no_point_behind_a_psf_has_less_contrast(sigma):
    psf = PSF.gaussian(sigma)
    kappa = pair_ratios(psf)[0]
    rng = np.random.default_rng(0)
    for y, x in rng.uniform(-0.5, 0.5, (20, 2)):
        p = psf_at(psf, 0, np.arange(-1.0, 2) - y, np.arange(-1.0, 2) - x)
        assert p[0, 1] + p[2, 1] >= kappa[0] * p[1, 1] and p[1, 0] + p[1, 2] >= kappa[1] * p[1, 1]


def test_hot_pixels_on_a_source_are_said_and_stay():
    data = image_of()
    data[0, 20, 19] += 300 * NOISE
    found = inspected([observed(data)])
    assert any(
        "light sharper than its PSF: at (y, x) = (20, 19), on a source" in m for m in found.messages
    )
    assert (found.blend.observations[0].weights > 0).all()


def test_light_sharp_in_two_channels_stays():
    data = image_of()
    data[:, 8, 50] += 60 * NOISE
    found = inspected([observed(data)])
    assert any("(y, x) = (8, 50), in other channels too" in m for m in found.messages)
    assert (found.blend.observations[0].weights > 0).all()


def test_noise_above_that_of_the_weights_is_no_ray():
    seen = looked_at(observed(image_of(noise=4 * NOISE)))
    assert (seen.significance < -spoilt.SHARP_SIGMAS).any()
    assert not spoilt.sharper_than_psf(seen).any()


def test_equal_pixels_around_a_brighter_one_are_no_flat_top():
    data = image_of()
    data[0, 7:10, 49:52], data[0, 8, 50] = 900.5, 2000.5
    assert not spoilt.saturated(looked_at(observed(data))).any()


@pytest.mark.parametrize("slope", [0.0, 0.4, 1.0])
def test_a_ray_across_a_source_is_masked_along_its_track(slope):
    data, (y0, x0) = image_of(), DRAWN[0][0]
    x = np.arange(int(x0) - 6, int(x0) + 7)
    y = np.rint(y0 + slope * (x - x0)).astype(int)
    data[0, y, x] += 60 * NOISE
    found = inspected([observed(data)])
    weights = found.blend.observations[0].weights
    assert (weights[0, y, x] == 0).all() and (weights[1] > 0).all()
    assert (weights[0] == 0).sum() <= 7 * len(x)
    (message,) = found.messages
    assert "cosmic rays" in message and "masked" in message


def test_a_track_that_leaves_the_image_ends_at_its_edge():
    sharp, cores = np.zeros((1, 40, 40), bool), np.zeros((40, 40), bool)
    x = np.arange(10, 38)
    for flip in (1, -1):
        sharp[:] = False
        sharp[0, x, x] = sharp[0, 38, 39] = True
        found = spoilt.tracks(sharp[:, ::flip, ::flip], cores)[0, ::flip, ::flip]
        assert found[x, x].all() and np.abs(np.subtract(*np.nonzero(found))).max() <= 1
    block = np.zeros((1, 40, 40), bool)
    block[0, 20:22, 20:22] = True
    assert not spoilt.tracks(block, cores).any()


def test_the_core_of_a_star_with_a_psf_too_wide_is_no_track():
    o = observed(image_of(((DRAWN[0][0], (2e4, 2e4), 0.0),)))
    wide = Observation(
        o.data[:1],
        PSF(o.psf.images[:1] @ gaussian_of(3.0, o.psf.images.shape[-1])),  # along x
        o.grid,
        weights=o.weights[:1],
        channels=["g"],
    )
    found = inspected([wide], sources_of(DRAWN[:1], PointSource))
    assert (found.blend.observations[0].weights > 0).all()
    assert any("sharper than its PSF" in m for m in found.messages)


def gaussian_of(sigma, n):
    """Matrix (n, n) of a convolution with a Gaussian."""
    away = np.arange(n) - np.arange(n)[:, None]
    return np.exp(-(away**2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi))


def test_flat_tops_are_masked_as_saturated():
    data = image_of(((DRAWN[0][0], (9e4, 9e4), 0.0), *DRAWN[1:]))
    data[1] = np.minimum(data[1], 0.6 * data[1].max())
    found = inspected([observed(data)])
    assert [m for m in found.messages if "channel r is saturated" in m]
    weights = found.blend.observations[0].weights
    assert (weights[1, 19:22, 17:21] == 0).all() and (weights[0] > 0).all()


@pytest.mark.parametrize("scatter, is_found", [(0.3, True), (3.0, False)])
def test_flat_tops_are_flat_within_the_noise(scatter, is_found):
    """Flat-fielded ones are; a top that scatters more than the noise may be a galaxy's."""
    data = image_of(((DRAWN[0][0], (9e4, 9e4), 0.0), *DRAWN[1:]))
    full = data[1] > 0.4 * data[1].max()
    rest = scatter * NOISE * np.random.default_rng(1).normal(size=full.sum())
    data[1, full] = 0.4 * data[1].max() + rest
    found = spoilt.saturated(looked_at(observed(data)))
    assert found[1][full].all() == is_found and found[1].any() == is_found
    assert not found[0].any()


def test_whole_numbers_are_not_flat_by_chance():
    assert not spoilt.saturated(looked_at(observed(np.rint(image_of())))).any()


def test_values_at_the_saturation_are_masked():
    o = observed(image_of())
    object.__setattr__(o, "saturation", np.array([np.nan, 100.0]))
    full = spoilt.saturated(looked_at(o))
    assert not full[0].any() and full[1][o.data[1] >= 100].all()


@pytest.mark.parametrize("value", [0.0, -100.0])
def test_pixels_filled_with_a_value_are_masked(value):
    """In one channel without data in half of the frame, or in four columns through a galaxy."""
    for region in (np.s_[1, :32], np.s_[1, :, 17:21]):
        data = image_of()
        data[region] = value
        filled = np.zeros(data.shape, bool)
        filled[region] = True
        found = inspected([observed(data)])
        (message,) = found.messages
        at = tuple(np.argwhere(filled)[0, 1:].tolist())
        assert "channel r has pixels of exactly one value" in message
        assert f"{filled.sum()} of {value:g}, the first at (y, x) = {at}" in message
        np.testing.assert_array_equal(found.blend.observations[0].weights == 0, filled)


def test_a_channel_of_one_value_beside_noise_is_masked():
    data = image_of()
    empty = observed(np.zeros((1, *SHAPE)), channels=("i",), name="other")
    found = inspected([observed(data), empty])
    assert "other: channel i has pixels of exactly one value" in found.messages[0]
    assert "3840 of 0, the first" in found.messages[0]
    assert (found.blend.observations[1].weights == 0).all()
    assert (found.blend.observations[0].weights > 0).all()
    light = observed(image_of(noise=0))
    same = inspected([light, empty]).blend.observations
    assert same == (light, empty)  # no noise


def test_flat_tops_are_saturated_not_filled():
    data = np.minimum(image_of(), 60.0)
    alone = inspected([observed(data)]).blend.observations[0].weights
    data[:, :, 50:] = 0
    found = inspected([observed(data)])
    assert sum("is saturated" in m for m in found.messages) == 2
    assert sum("640 of 0, the first" in m for m in found.messages) == 2
    weights = found.blend.observations[0].weights
    np.testing.assert_array_equal(weights[:, :, :50], alone[:, :, :50])
    assert not weights[:, :, 50:].any()
