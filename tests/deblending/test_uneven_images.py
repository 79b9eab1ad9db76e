"""Variances that follow the data, skies that vary and noise that differs are named before a fit."""

import numpy as np
import pytest
from helpers.inspection import DRAWN, NOISE, image_of, inspected, observed, sources_of, stars

from clresample.deblending.inspection import noisy_variance

WIDE = (128, 120)
GALAXY = (((64.3, 60.1), (3000, 5000), 8.0),)


def counts_of(sky, seed=0, shape=WIDE):
    """Expected counts (2, Ny, Nx), sky included, and a draw of them."""
    expected = image_of(GALAXY, noise=0, shape=shape) + sky
    return expected, np.random.default_rng(seed).poisson(expected).astype(float)


@pytest.mark.parametrize("sky", [2, 10, 50])
def test_a_variance_of_the_datas_own_counts_is_smoothed_and_fluxes_are_right(sky):
    expected, counts = counts_of(sky)
    given = observed(counts - sky, weights=None, variance=np.maximum(counts, 1))
    (made,), (lines,) = noisy_variance.with_smooth_variances([given])
    assert len(lines) == 1 and "own counts" in lines[0] and "(g)" in lines[0] and "(r)" in lines[0]
    light = expected - sky
    for weights, low in ((given.weights, True), (made.weights, False)):
        error = (weights * light**2).sum(axis=(1, 2)) ** -0.5
        flux = (weights * light * given.data).sum(axis=(1, 2)) * error**2
        assert (flux < 1 - 1.5 * error).all() if low else (np.abs(flux - 1) < 3 * error).all()
    exact = ((light**2 / expected).sum(axis=(1, 2))) ** -0.5
    assert error == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize("sky", [0.1, 0.5, 2.0])
def test_counts_of_0_have_a_variance_too(sky):
    """Without a weight, as their variance is 0, they are missing, and fluxes are far too high."""
    expected, counts = counts_of(sky)
    given = observed(counts - sky, weights=None, variance=counts)
    (made,), (lines,) = noisy_variance.with_smooth_variances([given])
    assert len(lines) == 1 and "own counts" in lines[0]
    assert (given.weights[counts == 0] == 0).all() and (made.weights > 0).mean() > 0.99
    light = expected - sky
    error = (made.weights * light**2).sum(axis=(1, 2)) ** -0.5
    flux = (made.weights * light * made.data).sum(axis=(1, 2)) * error**2
    assert (np.abs(flux - 1) < 3 * error).all()
    assert error == pytest.approx((light**2 / expected).sum(axis=(1, 2)) ** -0.5, rel=0.25)


def test_a_gap_of_no_counts_stays_without_a_weight():
    _, counts = counts_of(0.5)
    counts[:, 40:47] = 0
    given = observed(counts - 0.5, weights=None, variance=counts)
    (made,), (lines,) = noisy_variance.with_smooth_variances([given])
    assert "own counts" in lines[0] and not made.weights[:, 40:47].any()
    assert (made.weights > 0).mean() > 0.85


def test_a_mask_stays_beside_counts_of_0_which_are_named():
    """Nothing tells masked pixels of 0 counts from others."""
    _, counts = counts_of(0.5)
    mask = np.zeros(WIDE, bool)
    mask[:, [20, 71, 90]] = mask[40:60] = True
    given = observed(counts - 0.5, weights=None, variance=counts, mask=mask)
    (made,), (lines,) = noisy_variance.with_smooth_variances([given])
    assert not made.weights[:, mask].any() and "a variance of 0: 4" in lines[-1]


@pytest.mark.parametrize("how", ["a gap", "bad pixels", "dead columns"])
def test_dark_pixels_without_a_weight_are_no_counts(how):
    """Their other pixels have counts of 50."""
    expected, counts = counts_of(50)
    missing = np.zeros(WIDE, bool)
    if how == "a gap":
        missing[:, 40:60] = True
    elif how == "dead columns":
        missing[:, [20, 31, 40, 56, 77, 90]] = True
    else:
        missing[np.random.default_rng(1).random(WIDE) < 0.1] = True
    data = np.where(missing, -100.0 if how != "bad pixels" else 100.0, counts - 50)
    given = observed(data, weights=None, variance=np.where(missing, 0, expected))
    made, lines = noisy_variance.with_smooth_variances([given])
    assert made[0] is given and lines == [[]]


@pytest.mark.parametrize("seed", range(4))
def test_the_variance_of_a_crowded_image_is_left(seed):
    """There both rise with the stars' light between all pixels, not with noise."""
    light = image_of(stars(60, seed), noise=0)
    variance = NOISE**2 + light / 2
    data = light + np.random.default_rng(seed).normal(size=light.shape) * variance**0.5
    given = (observed(data, weights=1 / variance),)
    assert noisy_variance.with_smooth_variances(given) == (given, [[]])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["of the model", "of the sky", "of a faint read noise"])
def test_other_variances_are_left(kind, seed):
    expected, counts = counts_of(50, seed)
    # own counts over a sky of many
    variance = {"of the model": expected, "of the sky": np.full(WIDE, 50.0)}.get(kind)
    variance = counts + 5000 if variance is None else variance
    given = observed(counts - 50, weights=None, variance=variance)
    made, lines = noisy_variance.with_smooth_variances([given])
    assert made[0] is given and lines == [[]]


def varied(image, **given):
    return inspected([observed(image, **given)]).messages


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("side, axis", [("larger x", 1), ("smaller y", 0)])
@pytest.mark.parametrize("step", [False, True])
def test_a_sky_that_rises_is_named_by_its_side(step, side, axis, seed):
    along = np.indices(WIDE)[axis] / WIDE[axis] - 0.5
    along = (np.sign(along) / 2 if step else along) * (1 if "larger" in side else -1)
    (message,) = varied(image_of(seed=seed, shape=WIDE) + 0.5 * NOISE * along)
    assert "sky level varies" in message and f"towards {side};" in message


@pytest.mark.parametrize("size", [4.0, 12.0, 30.0])
@pytest.mark.parametrize("place", [(20.0, 20.0), (64.0, 110.0)])
def test_wings_of_a_wide_galaxy_are_no_varying_sky(place, size):
    drawn = (*DRAWN, (place, (2e4, 3e4), size))
    found = inspected([observed(image_of(drawn, shape=WIDE))], sources_of(drawn)).messages
    assert not any("varies" in line for line in found)


@pytest.mark.parametrize("factor", [1.0, 2.0, 3.0])
def test_noise_that_differs_between_parts_is_named(factor):
    image = image_of(shape=WIDE)
    noise = np.random.default_rng(5).normal(0, NOISE, image.shape)
    image[..., 60:] += np.sqrt(factor**2 - 1) * noise[..., 60:]
    variance = np.full(image.shape, NOISE**2)
    variance[..., 60:] *= factor**2
    named = ["noise differs between parts" in line for line in varied(image)]
    assert any(named) == (factor > 1)
    assert varied(image, weights=None, variance=variance) == []
