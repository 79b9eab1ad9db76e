"""Problems of observations are reported before a fit, and mended where that is safe."""

import re

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
    stars,
    with_photon_noise,
)

from clresample.deblending.inspection import disagreement, levels, listing, shifted
from clresample.deblending.inspection.centroids import centroids
from clresample.deblending.inspection.disagreement import shifts_at
from clresample.deblending.inspection.image import InspectedImage
from clresample.deblending.inspection.inspect import (
    HELD_PART,
    SMALL_PART,
    _level_lines,
    wrong_levels,
)
from clresample.sky.frame import model_frame
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource


def sky_of(*numbers):
    blocks = levels.BlockGrid.of(SHAPE)
    return levels.SkyLevel(*numbers, blocks, np.zeros((2, len(blocks.centers)), bool), np.ones(2))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", [ExtendedSource, PointSource])
def test_of_a_clean_image_nothing_is_said(seed, kind):
    drawn = DRAWN if kind is ExtendedSource else tuple((p, f, 0.0) for p, f, _ in DRAWN)
    found = inspected([observed(image_of(drawn, seed=seed))], sources_of(drawn, kind))
    assert found.messages == [] and found.settings.fit_shifts is False
    assert not found.shifts.any()


@pytest.mark.parametrize(
    "sky, words", [(0.3, "sky is left in"), (-0.3, "too much sky"), (1e4, "in")]
)
def test_sky_is_named_with_its_level(sky, words):
    o = observed(image_of(sky=sky * NOISE))
    for fit_sky, cure in (("auto", "a constant is fitted"), (False, "fit_sky=True")):
        found = inspected([o], fit_sky=fit_sky)
        (message,) = found.messages
        assert words in message and "g " in message and cure in message
        assert found.settings.fit_sky is bool(fit_sky)
    level = levels.sky_level(looked_at(o))
    assert np.abs(level.level - sky * NOISE).max() < 4 * level.error.max() < 0.4 * NOISE
    assert inspected([o], fit_sky=True).messages == []


@pytest.mark.parametrize("seed", range(4))
def test_of_stars_in_all_of_an_image_no_level_is_found(seed):
    """Their wings fall faster than those of galaxies."""
    drawn, shape = stars(40, seed, shape=(128, 128), apart=2.5), (128, 128)
    data, (y, x) = image_of((), seed=seed, shape=shape), np.indices(shape)
    for (a, b), flux, _ in drawn:
        light = (1 + ((y - a) ** 2 + (x - b) ** 2) / 3.8**2) ** -3.5 * 2.5 / (np.pi * 3.8**2)
        data += np.array(flux)[:, None, None] * light
    level = levels.sky_level(looked_at(observed(data, sigma=1.6), sources_of(drawn, PointSource)))
    assert (np.abs(level.level) < np.maximum(3 * level.error, 0.2 * NOISE)).all()


def test_a_rim_below_zero_is_no_light():
    """A galaxy whose wings hide the sky's level everywhere but at the rim."""
    y, x = np.indices((48, 48)) - 23.5
    wings = 8e4 * (40 + y**2 + x**2) ** -1.5
    o = observed(image_of((), shape=(48, 48)) + wings - wings[0, 24] - 0.6 * NOISE)
    source = (ExtendedSource(position_px=(23.5, 23.5)),)
    level = levels.sky_level(looked_at(o, source))
    assert (level.rim < -0.3 * NOISE).all() and (np.abs(level.level) < 4 * level.error).all()
    found = inspected([o], source)
    (message,), expected = found.messages, found.levels[0].level[0]
    assert "too much sky was subtracted" in message and f"{expected:+.4g} counts" in message
    assert expected <= level.rim[0]
    (message,) = inspected([o], source, fit_sky=True).messages
    assert "hardly tell its level" in message and "g +- " in message


def test_a_wrong_sky_frees_those_of_all_observations():
    """Levels of other observations are held at 0; of nearly subtracted skies, all are near 0."""
    good, small = observed(image_of()), observed(image_of(shape=(5, 5)), channels=("i", "z"))
    assert inspected([good, small]).settings.fit_sky is False
    found = inspected([observed(image_of(sky=0.3 * NOISE)), small])
    assert found.settings.fit_sky is True and not found.levels[1].level.any()
    np.testing.assert_allclose(found.levels[0].level, 0.3 * NOISE, rtol=0.2)
    np.testing.assert_allclose(found.levels[1].error, HELD_PART * NOISE, rtol=0.3)
    found = inspected([good, small], fit_sky="small")
    assert found.settings.fit_sky is True and not found.messages
    np.testing.assert_allclose(found.levels[1].error, SMALL_PART * NOISE, rtol=0.3)
    assert (np.abs(found.levels[0].level) < SMALL_PART * NOISE).all()


@pytest.mark.parametrize("unit", [1.0, 1e-20, 1e20])
def test_other_levels_are_near_zero_and_wrong_ones_as_measured_or_as_the_rim(unit):
    level = np.array([0.7, 0.7, 0.0, 0.0, -0.7, 0.02])
    error = np.array([1, 1, np.inf, np.inf, 1, 0.03])
    rim, rim_error, zeros = (
        np.array([0.9, 0.9, -0.3, -0.3, -0.3, -0.13]),
        np.full(6, 0.02),
        np.zeros(6),
    )
    given = (unit * one for one in (level, error, zeros, rim, rim_error))
    wrong, dark = np.arange(6) == 0, np.isin(np.arange(6), (2, 4, 5))
    sky = levels.SkyLevel(*given, None, None, zeros).expected(wrong, dark, np.full(6, 0.1 * unit))
    np.testing.assert_allclose(sky.level / unit, [0.7, 0.7 / 101, -0.3, 0, -0.7, -0.13])
    np.testing.assert_allclose(sky.error / unit, [1, np.sqrt(1 / 101), 0.02, 0.1, 1, 0.02])


def test_a_level_under_wings_may_be_wrong():
    """Two errors below zero, where the rim is not above it; a rim that is dark shows no sky."""
    o, found = observed(image_of()), []
    for part, rim in ((-0.6, -0.1), (-0.35, -0.1), (-0.6, 0.0)):
        level, error = np.full(2, part * NOISE), np.full(2, 0.3 * NOISE)
        sky = sky_of(level, error, error, np.full(2, rim * NOISE), 0.1 * error)
        wrong, dark = wrong_levels(looked_at(o), sky)
        assert not (wrong | dark).any()
        found.append(_level_lines(looked_at(o), sky, wrong, sky, False))
    (line,), *others = found
    assert "level is unsure" in line and "g -0.6 sigma" in line and "+- 0.3 sigma" in line
    assert others == [[], []]


def test_wings_are_no_sky():
    """A galaxy whose light falls by r^-2.5 to the image's edge."""
    y, x = np.indices((80, 80)) - 39.5
    wings = 12000 * (4 + y**2 + x**2) ** -1.25
    o = observed(image_of((), shape=(80, 80)) + wings)
    source = (ExtendedSource(position_px=(39.5, 39.5)),)
    level = levels.sky_level(looked_at(o, source))
    assert (np.abs(level.level) < 3 * level.error).all() and (level.rim > 0.4 * NOISE).all()
    (message,) = inspected([o], source).messages
    assert "the pixels furthest from the sources are not dark" in message
    assert inspected([o], source, fit_sky="small").messages == [message]


def test_light_without_a_source_is_named():
    o = observed(image_of())
    (message,) = inspected([o], sources_of(DRAWN[1:])).messages
    assert "no source is listed for" in message and "(20, 19)" in message
    assert listing.unlisted(looked_at(o)) == []


def test_light_of_masked_pixels_and_beyond_the_edge_is_not_unlisted():
    """Wings of a galaxy whose body is masked, cut off, or outside of the frame."""
    masked = np.zeros(SHAPE, bool)
    y, x = np.indices(SHAPE)
    masked[np.hypot(y - DRAWN[0][0][0], x - DRAWN[0][0][1]) < 4] = True
    o = observed(image_of(), weights=np.where(masked, 0, NOISE**-2) * np.ones((2, 1, 1)))
    rest = sources_of(DRAWN[1:])
    assert looked_at(o, rest).smooth.max() > 5 * listing.UNLISTED_SIGMAS
    assert listing.unlisted(looked_at(o, rest)) == []
    masked = (y == 20) & (x == 19)  # a pixel hides no galaxy
    o = observed(image_of(), weights=np.where(masked, 0, NOISE**-2) * np.ones((2, 1, 1)))
    assert listing.unlisted(looked_at(o, rest))
    beside = ((0.2, 18.7), *DRAWN[0][1:])
    o = observed(image_of((beside, *DRAWN[1:])))
    assert listing.unlisted(looked_at(o, rest)) == []
    o = observed(image_of())
    (found,) = listing.unlisted(looked_at(o, rest))
    assert found[1:] == (20, 19)
    frame = model_frame([o], grid=o.grid.cutout(22, 0, (42, 60)))
    places = frame.positions_of(
        tuple(ExtendedSource(position_px=(a - 22, b)) for (a, b), *_ in DRAWN[1:])
    )
    assert listing.unlisted(InspectedImage.of(o, frame, places, np.zeros(2))) == []


def test_doubles_are_named_unless_of_two_kinds():
    o, near = observed(image_of()), DRAWN[0][0][0] + 0.6
    twin = ExtendedSource(position_px=(near, DRAWN[0][0][1]))
    (message,) = inspected([o], (*sources_of(), twin)).messages
    assert message.startswith("sources lie within 1 model pixel of each other: 0 and 3;")
    core = PointSource(position_px=DRAWN[0][0])
    assert inspected([o], (*sources_of(), core)).messages == []


def test_positions_that_are_all_off_are_named():
    moved = tuple(ExtendedSource(position_px=(y + 1, x + 1)) for (y, x), _, _ in DRAWN)
    messages = inspected([observed(image_of())], moved).messages
    assert any(
        "light lies away from their positions: by (-1." in m and "FITS counts from 1" in m
        for m in messages
    )


@pytest.mark.parametrize("factor, word", [(1.25, "too wide"), (0.8, "too narrow")])
def test_stars_of_another_width_than_the_psf_are_named(factor, word):
    star = ((DRAWN[0][0], (2e4, 2e4), 0.0),)
    o = observed(image_of(star), sigma=factor * FWHM_SIGMA)
    assert any(word in m for m in inspected([o], sources_of(star, PointSource)).messages)
    near = PointSource(position_px=(DRAWN[0][0][0] + 10, DRAWN[0][0][1]))
    beside = (*sources_of(star, PointSource), near)
    assert not any(word in m for m in inspected([o], beside).messages)


@pytest.mark.parametrize("factor, word", [(1.0, ""), (1.2, "narrower"), (0.8, "wider")])
@pytest.mark.parametrize("flux", [2e4, 1e6])
def test_photon_noise_in_the_variance_is_no_width(factor, word, flux):
    star = ((DRAWN[0][0], (flux, flux), 0.0),)
    o = with_photon_noise(star, psf_sigma=factor * FWHM_SIGMA)
    messages = inspected([o], sources_of(star, PointSource)).messages
    assert [f"a source is {word} than the PSF" in m for m in messages] == [True] * (factor != 1)


@pytest.mark.parametrize("sigma, off", [(1.0, 1.0), (1.0, 0.7), (3.0, 2.0)])
def test_a_star_away_from_its_place_is_no_wider(sigma, off):
    (y, x), flux = DRAWN[0][0], (1e5, 1e5)
    o = observed(
        image_of((((y + off, x), flux, 0.0),), sigma=sigma), sigma=np.hypot(sigma, 12**-0.5)
    )
    messages = inspected([o], (PointSource(position_px=(y, x)),)).messages
    assert not any("wider" in m or "narrower" in m for m in messages)


@pytest.mark.parametrize("place, is_named", [((20, 24), True), ((22, 20), False)])
def test_masked_pixels_beside_a_stars_core_hide_no_width(place, is_named):
    star = (((20.2, 18.7), (1e5, 1e5), 0.0),)
    weights = np.full((2, *SHAPE), NOISE**-2)
    weights[:, *place] = 0
    o = observed(image_of(star), sigma=0.8 * FWHM_SIGMA, weights=weights)
    messages = inspected([o], sources_of(star, PointSource)).messages
    assert any("wider than the PSF" in m for m in messages) == is_named


def test_photon_noise_in_the_variance_moves_no_centroid_and_hides_no_light():
    place, faint = np.array(DRAWN[0][0]), (3e4, 3e4)
    stars = (place, (1e5, 1e5), 0.0), (place + (0, 9.5), faint, 0.0)
    listed = (ExtendedSource(position_px=place - (0, 1.0)),)
    images = [looked_at(o, listed) for o in (observed(image_of(stars)), with_photon_noise(stars))]
    uniform, photons = (centroids(image).offsets for image in images)
    np.testing.assert_allclose(photons, uniform, atol=0.03)
    for image in images:
        ((_, y, x),) = listing.unlisted(image)
        assert (y, x) == (20, 28)


def test_channels_that_lie_apart_are_named():
    data = image_of()
    data[1] = image_of(tuple(((y + 0.4, x), f, s) for (y, x), f, s in DRAWN))[1]
    messages = inspected([observed(data)]).messages
    assert any("light in channel" in m and "fit_shifts" in m for m in messages)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, -0.4)])
def test_observations_that_disagree_are_moved(shift):
    there = tuple(((y + shift[0], x + shift[1]), f, s) for (y, x), f, s in DRAWN)
    both = [
        observed(image_of()),
        observed(image_of(there, seed=1, sigma=2), sigma=2, name="b", channels=("i", "z")),
    ]
    found = inspected(both)
    assert found.settings.fit_shifts == any(shift)
    assert not found.shifts[0].any()
    np.testing.assert_allclose(found.shifts[1], -np.array(shift), atol=0.1)
    said = inspected(both, fit_shifts=False)
    assert said.settings.fit_shifts is False and not said.shifts.any()
    assert len(said.messages) == any(shift)


@pytest.mark.parametrize("shift", [(1.6, -1.2), (-0.8, 1.4)])
def test_a_sharp_observation_is_moved_by_more_than_its_psf(shift):
    """Its light has no centroid about the listed places."""
    there = tuple(((y + shift[0], x + shift[1]), f, s) for (y, x), f, s in DRAWN)
    sharp = observed(image_of(there, sigma=0.8), sigma=0.8, name="sharp")
    found = inspected([sharp, observed(image_of(seed=1, sigma=3), sigma=3, channels=("i", "z"))])
    moved = found.shifts[0] - found.shifts[1]
    np.testing.assert_allclose(moved, -np.array(shift), atol=0.2 * np.hypot(*shift))


@pytest.mark.parametrize("odd, others, n_dark", [(0, 2, 0), (0, 3, 1), (2, 3, 0), (1, 1, 0)])
def test_of_several_observations_the_one_that_disagrees_is_named(odd, others, n_dark):
    """The sharpest is the first; one without light is neither."""
    there = tuple(((y + 0.5, x), f, s) for (y, x), f, s in DRAWN)
    all_of = []
    for i in range(others + 1):
        sigma, drawn = (1.5 if i == 0 else 1.8), there if i == odd else DRAWN
        drawn = () if i > others - n_dark else drawn
        data = image_of(drawn, seed=i, sigma=sigma)
        all_of.append(observed(data, sigma=sigma, name=f"E{i}", channels=(f"g{i}", f"r{i}")))
    found = inspected(all_of)
    (message,) = (m for m in found.messages if "lies away from that" in m)
    assert message.startswith(f"light in E{odd} ") and re.search(r"by \(\+0\.[456]", message)
    moved = [-0.5 * (i == odd) for i in range(others + 1)]
    np.testing.assert_allclose(found.shifts[:, 0], np.subtract(moved, moved[0]), atol=0.15)


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("odd, factor", [(0, 1.1), (1, 0.9), (1, 1.0)])
def test_an_exposure_with_other_counts_than_its_band_is_named(n, odd, factor):
    """Of several seeings and zero points; of two exposures the sharper one is right."""
    exposures = []
    for i in range(n):
        sigma, points = 1.2 + 0.3 * ((i + 1) % 4), np.array([25, 25.5]) + 0.3 * i
        scale = 10 ** (0.4 * (points - 25)) * (factor if i == odd else 1)
        drawn = tuple((place, scale * flux, size) for place, flux, size in DRAWN)
        given = {"channels": (f"g{i}", f"r{i}"), "bands": ("g", "r"), "zero_points": points}
        image = image_of(drawn, seed=i, sigma=sigma, noise=0.5)
        exposures.append(observed(image, sigma=sigma, name=f"E{i}", weights=4.0, **given))
    messages = [m for m in inspected(exposures).messages if "counts in channel" in m]
    assert len(messages) == 2 * (factor != 1)
    if n > 2:
        assert all(m.startswith(f"E{odd}: ") and f" {factor:.1f}" in m for m in messages)


@pytest.mark.parametrize("shift, n_channels", [((0.0, 0.0), 1), ((0.5, -0.4), 2)])
def test_a_second_channel_confirms_the_shift_of_the_first(shift, n_channels, monkeypatch):
    there = tuple(((y + shift[0], x + shift[1]), f, s) for (y, x), f, s in DRAWN)
    images, compared = [looked_at(observed(image_of(d))) for d in (DRAWN, there)], []

    def noted(one, other, places):
        compared.append(other)
        return shifts_at(one, other, places)

    monkeypatch.setattr(shifted, "shifts_at", noted)
    found, error = shifted._closer(*images)
    assert len(compared) == n_channels and shifted.significant(found, error) == any(shift)


def test_light_at_an_edge_shifts_nothing():
    """Splines there are of light that goes on beyond the edge."""
    drawn = (*DRAWN, ((3.0, 30.0), (9000, 9000), 0.0))
    there = tuple(((y + 0.3, x - 0.2), f, s) for (y, x), f, s in drawn)
    one, other = looked_at(observed(image_of(drawn))), looked_at(observed(image_of(there)))
    places = np.array([(3.0, 30.0)])
    planes = (disagreement.ImagePlane.of(image, 0) for image in (one, other))
    (found,), (error,) = shifts_at(*planes, places)
    assert np.abs(found - (0.3, -0.2)).max() < 3 * error < 0.1


def test_images_without_light_have_no_brightness_and_no_error():
    light = np.random.default_rng(0).random((2, 9))
    assert np.isfinite(disagreement._brightness(light, np.zeros(9))).all()


def test_coarse_psfs_are_named():
    o = observed(image_of())
    with pytest.warns(match="sampled too coarsely"):
        psf = PSF.gaussian(0.4)
    (message,) = inspected([replace_psf(o, psf)]).messages
    assert "is sampled too coarsely" in message and "spacing" in message


def replace_psf(o, psf):
    return Observation(o.data, psf, o.grid, weights=o.weights, channels=o.channels, name=o.name)
