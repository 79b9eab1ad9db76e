"""Stars that saturate: one point in detection, with wings and spikes of its own in the fit."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from scipy.signal import fftconvolve
from scipy.special import j1

from clresample.deblending.batch import deblend
from clresample.deblending.inspection import star_cores as star_cores_module
from clresample.deblending.inspection.star_cores import StarCore, star_cores
from clresample.deblending.inspection.star_profile import RadialProfile
from clresample.deblending.inspection.star_psfs import _lasting
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.detection import detect
from clresample.measurement.quality import summary
from clresample.measurement.star_light import StarPlace, _without_stars, saturated_stars
from clresample.simulation.spoilers import saturate
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

SHAPE, NOISE, FWHM, BETA, LEVEL = (90, 96), 5.0, 4.0, 2.5, 3e4
STAR, FLUX = (44.3, 47.6), 4e6
GALAXY, GALAXY_FLUX, GALAXY_SIGMA = (23.0, 52.0), 8000.0, 2.0


def moffat(y, x):
    radius = FWHM / 2 / np.sqrt(2 ** (1 / BETA) - 1)
    value = (1 + (y**2 + x**2) / radius**2) ** -BETA
    return value * (BETA - 1) / (np.pi * radius**2)


PSF_IMAGE = moffat(np.arange(-12.0, 13.0)[:, None], np.arange(-12.0, 13.0))


def starry(
    *,
    spikes=True,
    galaxy=GALAXY_FLUX,
    seed=1,
    place=GALAXY,
    sigma_px=GALAXY_SIGMA,
    flux=FLUX,
):
    """An Observation of a saturated star with bleeds, masked, whose PSF image is a small one."""
    y, x = np.indices(SHAPE)
    dy, dx = y - STAR[0], x - STAR[1]
    data = flux * moffat(dy, dx)
    if spikes:
        along, across = (dy + dx) / np.sqrt(2), (dy - dx) / np.sqrt(2)
        for a, b in ((along, across), (across, along)):
            data += 150 * np.exp(-np.abs(a) / 20 - 0.5 * (b / 1.7) ** 2)
    if galaxy:
        away = (y - place[0]) ** 2 + (x - place[1]) ** 2
        light = galaxy * np.exp(-away / (2 * sigma_px**2)) / (2 * np.pi * sigma_px**2)
        data += fftconvolve(light, PSF_IMAGE / PSF_IMAGE.sum(), mode="same")
    full = saturate(data, LEVEL)
    data += np.random.default_rng(seed).normal(0, NOISE, SHAPE)
    return Observation(
        data,
        PSF(PSF_IMAGE),
        Grid.flat(SHAPE, 0.26),
        weights=np.where(binary_dilation(full, np.ones((3, 3))), 0, NOISE**-2),
        channels=("r",),
        name="cam",
    )


def cores_of(observation):
    usable = observation.weights[0] > 0
    light = np.where(usable, observation.data[0] / NOISE, 0)
    return star_cores(light, usable, observation.psf, 0)


@pytest.fixture(scope="module")
def fits():
    observation = starry()
    found = detect([observation])
    listed = ExtendedSource(position_px=STAR), ExtendedSource(position_px=GALAXY)
    results = [deblend([observation], sources) for sources in (found.sources, listed)]
    return SimpleNamespace(found=found, results=results)


def test_a_masked_core_is_found_by_the_light_around_it():
    (core,) = cores_of(starry())
    assert np.hypot(*(core.place - STAR)) < 0.5
    assert 2 < core.radius < 8
    assert core.masked[44, 47] and core.masked[:, 47].sum() > 20  # with its bleeds


@pytest.mark.parametrize("gain", [np.inf, 1.0, 0.1])
@pytest.mark.parametrize("flux", [2e6, 2e8])
def test_photon_noise_in_the_variance_hides_no_core(gain, flux):
    y, x = np.indices(SHAPE)
    light = flux * moffat(y - STAR[0], x - STAR[1])
    weights = np.where(light < LEVEL, 1 / (NOISE**2 + light / gain), 0)
    sides = np.arange(-25.0, 26.0)
    psf, grid = PSF(moffat(sides[:, None], sides)), Grid.flat(SHAPE, 0.26)
    o = Observation(light, psf, grid, weights=weights, channels=("r",))
    (star,) = saturated_stars([o], model_frame([o]))
    assert np.hypot(*(star.place - STAR)) < 0.2


@pytest.mark.parametrize("bright_px, grown_px", [(9.0, 3), (4.0, 1), (2.0, 0)])
def test_a_core_grows_while_its_star_is_bright_beside_it(bright_px, grown_px):
    y, x = np.indices((31, 31)) - 15
    masked, light = (np.maximum(abs(y), abs(x)) < n for n in (3, 3 + bright_px - 2))
    core = StarCore(np.array([15.0, 15.0]), 3.0, 1e3, masked)
    grown = core.grown(np.where(light, 1e3, 5.0), ~masked, 3)
    np.testing.assert_array_equal(grown, np.maximum(abs(y), abs(x)) < 3 + grown_px)


def airy(radius):
    x = np.maximum(radius, 1e-3) * 2.2
    return (2 * j1(x) / x) ** 2 + 1 / (20 + x**3)


@pytest.mark.parametrize("more_px", [0, 2])
@pytest.mark.parametrize("core_px", [2.5, 3.6, 4.6])
def test_cores_on_diffraction_rings_and_under_masks_of_one_side_are_found(core_px, more_px):
    sub = np.arange(-60, 61) / 2
    psf = PSF(airy(np.hypot(sub[:, None], sub)), spacing=0.5)
    y, x = np.indices(SHAPE)
    away = np.hypot(y - STAR[0], x - STAR[1])
    masked = (away < core_px) | ((away < core_px + more_px) & (x > STAR[1]))
    light = np.where(masked, 0, 1e6 * airy(away))
    (core,) = star_cores(light, ~masked, psf, 0)
    assert np.hypot(*(core.place - STAR)) < 0.5


def test_a_core_wider_than_the_psfs_image_is_found():
    (core,) = cores_of(starry(flux=8e7))
    assert core.radius > 8
    assert np.hypot(*(core.place - STAR)) < 0.2


@pytest.mark.parametrize("half_px, n", [(6, 0), (12, 1)])
def test_galaxies_with_masked_centres_are_no_cores_of_stars_with_a_small_psf_image(half_px, n):
    """An exponential one; a star's core beyond a large image is one."""
    away = np.hypot(*(np.indices((101, 101)) - np.array([50.2, 49.7])[:, None, None]))
    sides = np.arange(-half_px, half_px + 1.0)
    masked, psf = away < 4, PSF(moffat(sides[:, None], sides))
    light = {6: 1e4 * np.exp(-away / 3), 12: 1e7 * moffat(away, 0.0)}[half_px]
    assert len(star_cores(np.where(masked, 0, light), ~masked, psf, 0)) == n


def test_light_behind_a_listed_source_is_that_of_the_opposite_side():
    spikes = np.zeros((40, 200))
    spikes[:, [40, 140]] = 9.0
    known = np.ones(spikes.shape, bool)
    known[15:25, 20:60] = False
    rays = np.where(known, spikes, 50.0)
    found = _lasting(rays, known, ~known, np.full(40, 200.0), 3, 2.0)
    np.testing.assert_array_equal(found[5:, :-1], spikes[5:])
    # masked pixels alone are like those next to them
    found = _lasting(rays, known, known & False, np.full(40, 200.0), 3, 2.0)
    assert (found[15:25, 40] == 9).all() and found.max() == 9


def test_what_lasts_along_rays_is_no_noise_and_no_light_of_all_rays_but_a_mean_too_bright():
    rng, known = np.random.default_rng(3), np.ones((80, 200), bool)
    noise, spike = rng.normal(0, 1, known.shape), np.zeros(known.shape)
    spike[:, 40] = 4.0
    for level in (0.0, 0.2, -0.5):  # of wings of galaxies, and of a mean that falls too slowly
        found = _lasting(noise + spike + level, known, ~known, np.zeros(80), 3, 3.0)[5:, :-1]
        np.testing.assert_allclose(found[:, 40], 4 + level, atol=1.0)
        others = np.delete(found, 40, axis=1)
        np.testing.assert_allclose(others.mean(), min(level, 0), atol=0.05)
        assert others.std() < 0.1


def test_a_halo_is_a_power_of_the_distance_through_rings_that_rise_and_fall():
    y, x = np.indices((121, 121)) - 60
    away = np.hypot(y, x)
    light = 40 * (np.maximum(away, 1) / 20) ** -3.0 * (1 + 0.5 * np.sin(away * 4))
    data = light + np.random.default_rng(1).normal(0, 1, away.shape)
    halo = RadialProfile.measure_halo(data, away > 20, away, 1.0, 20.0)
    np.testing.assert_allclose(halo.at(np.array([20.0, 40.0, 80.0])), [40, 5, 0.625], rtol=0.2)
    assert RadialProfile.measure_halo(data - light, away > 20, away, 1.0, 20.0) is None


def test_bad_columns_and_masked_galaxies_are_no_stars():
    y, x = np.indices(SHAPE)
    clean = starry(galaxy=0)
    masked = np.zeros(SHAPE, bool)
    masked[:, 25:27] = True  # through the star's wings
    galaxy = 3e4 * np.exp(-np.hypot(y - 60, x - 20) / 6)
    masked |= np.hypot(y - 60, x - 20) < 5
    weights = np.where(masked, 0, clean.weights[0])
    data = clean.data[0] + galaxy
    cores = star_cores(np.where(weights > 0, data / NOISE, 0), weights > 0, clean.psf, 0)
    assert [np.hypot(*(core.place - STAR)) < 1 for core in cores] == [True]


def test_a_centre_far_from_the_masked_pixels_is_no_star(monkeypatch):
    """As that of light which falls to one side of a gap: it took all of a field's tiles with it."""
    assert len(cores_of(starry())) == 1
    places = itertools.cycle([0.0, 3e9])  # the ring is that of the first of two steps
    monkeypatch.setattr(
        star_cores_module, "_centred", lambda light, ring, guess: (guess + next(places), 0.1)
    )
    assert cores_of(starry()) == []


@pytest.mark.parametrize("width, height, n", [(2, 4, 1), (1, 9, 0), (2, 0, 0)])
def test_a_bright_core_of_two_pixels_is_one_and_neither_a_column_nor_a_faint_one(width, height, n):
    clean = starry(spikes=False, galaxy=0)
    flux = FLUX if height else 40 * NOISE / moffat(0, 0)
    y, x = np.indices(SHAPE)
    light = flux * moffat(y - STAR[0], x - STAR[1]) / NOISE
    usable = np.ones(SHAPE, bool)
    usable[44 - height // 2 : 44 + max(height, 4) // 2, 47 : 47 + width] = False
    cores = star_cores(np.where(usable, light, 0), usable, clean.psf, 0)
    assert len(cores) == n
    assert all(np.hypot(*(core.place - STAR)) < 0.3 for core in cores)


def test_a_ray_that_alternates_has_no_peaks_and_a_source_on_it_stays():
    y, x = np.indices((81, 81)) - 40.0
    away = np.hypot(y, x)
    image = 300 * np.exp(-away / 6) + np.random.default_rng(1).normal(0, 1, away.shape)
    image[40] += np.where(away[40] % 2 < 1, 1, -1) * 200 * np.exp(-away[40] / 12)
    image += 400 * np.exp(-((y - 20) ** 2 + x**2) / 4)
    rest, own = _without_stars(image, image > -1e9, [StarPlace(np.array([40.0, 40.0]), 2.0)], 2.5)
    assert own[40].all() and rest[60, 40] > 20
    rest[56:65, 36:45] = 0
    assert rest.max() < 5


def test_a_galaxy_wider_than_any_source_beyond_a_darker_stretch_stays():
    y, x = np.indices((151, 151)) - 40.0
    away = np.hypot(y, x)
    image = 3000 * np.exp(-away / 11) + np.random.default_rng(1).normal(0, 1, away.shape)
    galaxy = 30 * np.exp(-((y - 80) ** 2 + (x - 20) ** 2) / (2 * 10**2))
    star = StarPlace(np.array([40.0, 40.0]), 2.0)
    rest, own = _without_stars(image + galaxy, image > -1e9, [star], 2.5)
    bright = own & (galaxy > 15)
    assert bright.sum() > 400
    assert np.median(rest[bright] / galaxy[bright]) > 0.5


def test_flat_tops_that_nobody_masked_are_cores_too():
    observation = starry()
    unmasked = Observation(
        np.minimum(observation.data, LEVEL),
        observation.psf,
        observation.grid,
        weights=NOISE**-2,
        channels=("r",),
    )
    (star,) = saturated_stars([unmasked], model_frame([unmasked]))
    frame = model_frame([unmasked])
    place = unmasked.grid.positions_in(frame.grid, *STAR)
    assert np.hypot(*(star.place - place)) < 0.7


def test_detection_finds_a_point_and_the_galaxy_and_no_spikes(fits):
    kinds = [type(source) for source in fits.found.sources]
    assert kinds == [PointSource, ExtendedSource]
    grid = starry().grid
    at = [fits.found.frame.grid.positions_in(grid, *s.position_px) for s in fits.found.sources]
    assert np.hypot(*(at[0] - STAR)) < 0.7
    assert np.hypot(*(at[1] - GALAXY)) < 3.5


@pytest.mark.parametrize("which", [0, 1], ids=["detected", "listed as a galaxy"])
def test_its_wings_and_spikes_are_its_own(fits, which):
    result = fits.results[which]
    assert isinstance(result.sources[0], PointSource)
    assert result.status == "converged"
    assert summary(result)["chi2"]["r"] < 1.6
    table = catalogue(result)
    assert table["flags"][0] & Flag.SATURATED
    flux, error = (float(getattr(v, "value", v)) for v in table["flux_r", "flux_err_r"][1])
    assert abs(flux - GALAXY_FLUX) < max(4 * error, 0.05 * GALAXY_FLUX)
    flux = float(getattr(table["flux_r"][0], "value", table["flux_r"][0]))
    error = float(getattr(table["flux_err_r"][0], "value", table["flux_err_r"][0]))
    assert abs(flux - FLUX) < 2 * error  # of the PSF's width, by which the core follows from wings
    assert error < 0.2 * FLUX


@pytest.mark.parametrize(
    "away, star_flux, galaxy",
    [
        (24.0, FLUX, 8000),
        (16.0, FLUX, 8000),
        (14.0, FLUX, 4000),
        (24.0, 8e7, 2500),
        (16.0, 2e6, 5000),
    ],
    ids=[
        "far",
        "near",
        "nearer",
        "faint, with a core wider than the PSF",
        "with a core of few pixels",
    ],
)
def test_the_wings_of_a_wide_galaxy_are_not_the_stars(away, star_flux, galaxy):
    place = STAR[0] - 0.6 * away, STAR[1] + 0.8 * away
    observation = starry(spikes=False, place=place, sigma_px=3.0, galaxy=galaxy, flux=star_flux)
    listed = [PointSource(position_px=STAR), ExtendedSource(position_px=place)]
    table = catalogue(deblend([observation], listed))
    flux, error = (float(getattr(v, "value", v)) for v in table["flux_r", "flux_err_r"][1])
    assert abs(flux - galaxy) < max(2 * error, 0.06 * galaxy)
    assert error < 0.6 * galaxy


def test_a_ray_of_one_band_is_no_source_and_a_star_of_both_is():
    """Also where the light of the other band is that of a star's wings."""
    rng, psf = (
        np.random.default_rng(2),
        PSF(moffat(np.arange(-12.0, 13.0)[:, None], np.arange(-12.0, 13))),
    )
    y, x = np.indices(SHAPE)
    light = 3e4 * moffat(y - 40, x - 40)
    data = light + rng.normal(0, NOISE, (2, *SHAPE))
    data[0, 70, 20] += 600
    data[0, 40, 52] += 600  # beside the star
    given = {"psf": psf, "grid": Grid.flat(SHAPE, 0.26), "weights": NOISE**-2}
    bands = [Observation(data, channels=("g", "r"), **given)]
    alone = [
        Observation(data[k : k + 1], channels=("gr"[k],), name="gr"[k], **given) for k in (0, 1)
    ]
    for some in (bands, alone):
        assert [s.position_px for s in detect(some).sources] == [pytest.approx((40, 40), abs=1)]
    assert len(detect(alone[:1]).sources) > 1  # nothing tells it from a source
