"""Detection: signal to noise in the model frame, close neighbours, what a fit leaves over."""

import sys

import numpy as np
import pytest
from helpers.blends import gaussian

from clresample.deblending.batch import deblend
from clresample.deblending.posterior.residuals import convolved
from clresample.deblending.profiles import draw_psf
from clresample.deblending.settings import Settings
from clresample.measurement.detection import detect, detect_more
from clresample.measurement.signal_to_noise import signal_of
from clresample.resampling.cache import cached_resampler
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation, with_data
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

pytest.importorskip("sep")
SHARP, BLURRED = Grid.flat((80, 90), 0.1), Grid.flat((44, 50), 0.2, angle_deg=20)


def instruments(sources, *, seed=3, size=1.2, sharp_noise=1.0, blurred_noise=1.0):
    """A sharp image of one channel, a blurred one of two; sources (y, x, flux, blurred flux)."""
    rng = np.random.default_rng(seed)
    blank = [
        Observation(
            np.zeros((n, *grid.shape)),
            PSF.gaussian(sigma, n_pixels=31),
            grid,
            weights=1.0,
            channels=names,
            name=name,
        )
        for n, grid, sigma, names, name in (
            (1, SHARP, 1.5, ("V",), "sharp"),
            (2, BLURRED, 1.7, ("g", "r"), "blurred"),
        )
    ]
    frame = model_frame(blank, grid=SHARP)
    scenes = np.zeros((2, *frame.shape))
    for y, x, *fluxes in sources:
        if size:
            image = gaussian(frame.shape, (y, x), np.eye(2) * size**2)
            image /= image.sum()
        else:
            image = draw_psf(frame.psf, (y, x), frame.shape)[0]
        scenes += np.array(fluxes)[:, None, None] * image
    made = []
    for o, scene, noise in zip(blank, scenes, (sharp_noise, blurred_noise), strict=True):
        op = cached_resampler(frame, o.grid, o.psf, dtype=np.float32)
        data = op.render(scene.astype(np.float32)) + rng.normal(0, noise, o.data.shape)
        made.append(
            Observation(data, o.psf, o.grid, weights=noise**-2, channels=o.channels, name=o.name)
        )
    return made, frame


def nearest(found, y, x):
    return min(np.hypot(s.position_px[0] - y, s.position_px[1] - x) for s in found.sources)


def test_peak_is_the_matched_filters_signal_to_noise():
    flux = 300.0
    (sharp, _), frame = instruments([(40, 45, flux, 0)], size=0, sharp_noise=1)
    found = detect([sharp], frame)
    assert [s.position_px for s in found.sources] == [(40, 45)]
    expected = flux * np.sqrt((sharp.psf.images[0] ** 2).sum())
    assert abs(found.peaks[0] - expected) < 3  # sigma of its own noise


@pytest.mark.parametrize("size", [0, 1.2])
@pytest.mark.parametrize("place", [(40.4, 45.2), (30.5, 50.6), (41.0, 44.8)])
def test_positions_are_between_pixels(place, size):
    observations, frame = instruments([(*place, 2000, 4000)], size=size)
    found = detect(observations, frame)
    assert len(found.sources) == 1 and nearest(found, *place) < 0.1


def test_noise_alone_has_unit_scatter_and_holds_no_source():
    for seed in range(4):
        observations, frame = instruments([], seed=seed)
        found = detect(observations, frame)
        assert not found.sources
        assert abs(found.image[10:-10, 10:-10].std() - 1) < 0.12


def test_correlated_noise_holds_no_source_either():
    from scipy.ndimage import gaussian_filter

    (sharp, _), frame = instruments([])
    data = gaussian_filter(sharp.data, (0, 1.5, 1.5))
    data /= data.std()
    found = detect([Observation(data, sharp.psf, sharp.grid, weights=1.0)], frame)
    assert not found.sources


def test_sources_of_either_instrument_and_close_pairs():
    sources = [(40, 30, 400, 0), (40, 37, 400, 800), (20, 70, 0, 500), (62, 60, 60, 120)]
    observations, frame = instruments(sources)
    found = detect(observations, frame)
    assert len(found.sources) == 4
    assert all(nearest(found, y, x) < 2.5 for y, x, *_ in sources)
    assert set(found.found_in) >= {"sharp", "blurred"}
    assert list(found.peaks) == sorted(found.peaks, reverse=True)


def test_the_combination_reaches_fainter_than_each():
    sources = [(40, 45, 27, 22)]
    observations, frame = instruments(sources)
    alone = [detect([o], frame).sources for o in observations]
    both = detect(observations, frame)
    assert not any(alone) and both.found_in == ("all",)
    assert nearest(both, 40, 45) < 3


@pytest.mark.parametrize("first", [30, 38, 42, 48, 54])
def test_masked_columns_beside_a_bright_source_are_no_sources(first):
    """Nor where its centre is masked; there its place is that of the light about it."""
    (sharp, blurred), frame = instruments([(40, 45, 2e4, 2e4)], size=3)
    weights = np.ones(sharp.data.shape)
    weights[..., first : first + 4] = 0
    holed = Observation(sharp.data, sharp.psf, sharp.grid, weights=weights, name="sharp")
    for observations in ([holed], [holed, blurred]):
        found = detect(observations, frame)
        assert len(found.sources) == 1 and nearest(found, 40, 45) < 5


def test_noise_beside_masked_columns_has_unit_scatter():
    (sharp, _), frame = instruments([])
    weights = np.ones(sharp.data.shape)
    weights[..., 3::9] = weights[..., 4::9] = weights[..., 5::9] = 0
    holed = Observation(sharp.data, sharp.psf, sharp.grid, weights=weights, name="sharp")
    signal = signal_of(holed, frame)
    assert abs(signal.flat()[signal.n_seen > 0].std() - 1) < 0.1


def test_unseen_sky_and_bad_pixels_are_no_sources():
    (sharp, blurred), frame = instruments([(40, 45, 300, 300)])
    data, weights = sharp.data.copy(), sharp.weights.copy()
    data[:, 10:20, 10:20] = 1e6
    weights[:, 10:20, 10:20] = 0
    sharp = Observation(data, sharp.psf, sharp.grid, weights=weights, name="sharp")
    found = detect([sharp, blurred], frame)
    assert len(found.sources) == 1 and nearest(found, 40, 45) < 2


def test_what_a_fit_leaves_over_is_found(device):
    sources = [(40, 40, 20000, 20000), (40, 52, 120, 120)]
    observations, frame = instruments(sources)
    first = [ExtendedSource(position_px=(40, 40))]
    result = deblend(
        observations, first, frame=frame, device=device, settings=Settings(max_iter=20)
    )
    more = detect_more(result)
    assert nearest(more, 40, 52) < 3
    assert all(np.hypot(s.position_px[0] - 40, s.position_px[1] - 40) > 2 for s in more.sources)


@pytest.mark.parametrize("shape", [(50, 52), (17, 40), (9, 3), (64, 81)])
@pytest.mark.parametrize("psf", [(17, 17), (8, 5)])
def test_the_convolution_is_scipys_up_to_rounding(shape, psf):
    from scipy.signal import fftconvolve

    rng = np.random.default_rng(4)
    image, kernel = rng.normal(size=shape), rng.random(psf)
    expected = fftconvolve(image, kernel, mode="same")
    np.testing.assert_allclose(
        convolved(image, kernel), expected, rtol=0, atol=1e-13 * kernel.sum()
    )


@pytest.mark.parametrize("threshold", [0, -1, float("nan"), float("inf")])
def test_threshold_must_be_positive(threshold):
    observations, frame = instruments([])
    with pytest.raises(ValueError, match="threshold"):
        detect(observations, frame, threshold=threshold)


def test_without_sep_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sep", None)
    observations, frame = instruments([])
    with pytest.raises(ImportError, match="pip install sep"):
        detect(observations, frame)


def test_sources_of_a_crowd_do_not_hide_one_another():
    """All are connected; one of a thousandth of their light, clear of others, is a source."""
    rng = np.random.default_rng(1)
    bright = [(y, x, 6e4) for y in (12, 28) for x in (10, 26, 42, 58, 74)]
    faint = [(52, x, 700.0) for x in (10, 26, 42, 58, 74)]
    data, grid = rng.normal(size=SHARP.shape), SHARP
    y, x = np.indices(data.shape)
    for y0, x0, flux in bright + faint:
        light = (1 + ((y - y0) ** 2 + (x - x0) ** 2) / 9) ** -2.5
        data += flux * light / light.sum()
    n = np.arange(41) - 20.0
    psf = PSF((1 + (n[:, None] ** 2 + n**2) / 9) ** -2.5)
    found = detect([Observation(data, psf, grid, weights=1.0)])
    assert (found.image > 5).all(axis=1)[10:50].any()
    places = np.array([source.position_px for source in found.sources])
    away = [np.hypot(*(places - [y0, x0]).T).min() for y0, x0, _ in bright + faint]
    assert max(away) < 2 and len(places) == 15


@pytest.mark.parametrize("size", [0, 1.5, 4])
@pytest.mark.parametrize("counts", [5, 50, 500, 2000])
def test_a_source_whose_photons_are_noise_is_one(counts, size):
    """In units of the sky's variance: the brighter a core is, the smaller are its weights."""
    light = counts * gaussian(SHARP.shape, (38, 45), np.eye(2) * (1.5**2 + size**2))
    noise = np.random.default_rng(8).normal(size=light.shape)
    variance, psf = 1 + light, PSF.gaussian(1.5, n_pixels=31)
    seen = Observation(light + noise * np.sqrt(variance), psf, SHARP, variance=variance)
    (source,) = detect([seen]).sources
    np.testing.assert_allclose(source.position_px, (38, 45), atol=2)


def test_sources_in_the_shallow_part_of_a_mosaic_are_found():
    """A sixteenth of the exposure has a sixteenth of the weight."""
    places = [(y, x) for y in (20, 60) for x in (20, 45, 70)]
    light = 100 * sum(gaussian(SHARP.shape, place, np.eye(2) * 4) for place in places)
    variance = np.where(np.arange(SHARP.shape[1]) < 45, 1.0, 16.0) + 0 * light
    noise = np.random.default_rng(9).normal(size=light.shape) * np.sqrt(variance)
    seen = Observation(light + noise, PSF.gaussian(1.5, n_pixels=31), SHARP, variance=variance)
    found = np.array([source.position_px for source in detect([seen]).sources])
    assert len(found) == len(places)
    assert all(np.hypot(*(found - place).T).min() < 1.5 for place in places)


@pytest.mark.parametrize("level", [0.3, 1.0, -1.0, -10.0, 1000.0])
def test_a_constant_sky_changes_no_sources(level):
    """At 1 sigma a pixel hundreds of peaks of the sky are over 5 sigma under the widest filter."""
    observations, frame = instruments([(30, 30, 300, 600), (50, 60, 100, 200)])
    expected = [source.position_px for source in detect(observations, frame).sources]
    over = [with_data(o, o.data + level) for o in observations]
    assert [source.position_px for source in detect(over, frame).sources] == expected


@pytest.mark.parametrize("place", [(46.6, 42.8), (46.9, 40.1), (33.2, 47.7)])
def test_companions_keep_their_places_between_pixels(place):
    """Those of the residual that found them, not of the flank they lie on."""
    observations, frame = instruments([(40, 45, 20000, 20000), (*place, 1500, 1500)], size=0.5)
    found = detect(observations[:1], frame)
    assert len(found.sources) == 2 and nearest(found, *place) < 0.3
