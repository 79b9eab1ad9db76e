"""PSFs that vary from source to source of one blend: whole fits, fluxes, errors."""

import pickle

import numpy as np
import pytest
from helpers.geometries import sky_grid
from helpers.varying import FLUXES, NOISE, SHAPE, observation, stars, widening

from clresample import (
    Blend,
    ExtendedSource,
    FunctionPSF,
    Grid,
    Observation,
    PaperSettings,
    PointSource,
    Settings,
    SingleScalePrior,
    catalogue,
    deblend,
    deblend_many,
)
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.posterior import residuals
from clresample.measurement.photometry import fluxes
from clresample.resampling.resampler import Resampler
from clresample.sky.frame import Frame
from clresample.sky.psf import PSF

MODEL_PSF = PSF.gaussian(0.8, n_pixels=15)
CORNERS = np.array([(12.3, 13.1), (13.6, 82.4), (58.2, 12.7), (57.4, 81.8)])


def chi2(result):
    residual = result.residual(0)
    return np.nanmean(residual**2) / NOISE**2


def points(places):
    return [PointSource(position_px=tuple(map(float, p))) for p in places]


def test_a_star_in_each_corner_has_its_own_psf(device):
    data, exact = stars(CORNERS), Settings(psf_error=0)
    own = deblend([observation(data)], points(CORNERS), settings=exact, device=device)
    middle = widening((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
    same = deblend([observation(data, middle)], points(CORNERS), settings=exact, device=device)
    assert 0.97 < chi2(own) < 1.03
    assert chi2(same) > 1.3
    found, wrong = (_pulls(result) for result in (own, same))
    assert np.abs(found).max() < 4
    grown = residuals.misfit_error_scale(same.errors.residuals)[:, None]  # with what is left
    assert np.abs(wrong * grown).max() > 20


@pytest.mark.parametrize(
    "given",
    [{"prior": SingleScalePrior()}, {"prior": None}, {"fit_sky": True}, {"fit_shifts": True}],
    ids=["prior", "free", "sky", "shifts"],
)
def test_every_kind_of_fit_follows_the_psf(device, given):
    rng = np.random.default_rng(1)
    again = rng.normal(0, NOISE, (2, *SHAPE)) + stars(CORNERS, noise=0)
    second = observation(again, channels=("G", "R"))
    sources = [ExtendedSource(position_px=tuple(map(float, p))) for p in CORNERS[:2]]
    sources += points(CORNERS[2:])
    settings = (PaperSettings if "prior" in given else Settings)(psf_error=0, **given)
    pair = [observation(stars(CORNERS)), second]
    result = deblend(pair, sources, settings=settings, device=device)
    for i in (0, 1):
        assert 0.95 < np.nanmean(result.residual(i) ** 2) / NOISE**2 < 1.05
    table = catalogue(result)
    found = np.stack([np.array(table[f"flux_{c}"]) for c in "grGR"], axis=1)
    assert np.abs(found / np.tile(FLUXES, 2) - 1).max() < 0.05
    if result.errors is not None:
        error = np.stack([np.array(table[f"flux_err_{c}"]) for c in "grGR"], axis=1)
        assert (np.abs(found - np.tile(FLUXES, 2)) / error).max() < 4.5


@pytest.mark.parametrize("given", [{"angle_deg": 25}, {"sip": 2e-4}], ids=["turned", "distorted"])
def test_turned_and_distorted_pixels_see_each_source_s_psf(device, given):
    sharp, bent = sky_grid((90, 110), 0.15), sky_grid((70, 84), 0.2, **given)
    places = np.array([(25.0, 30.0), (27.0, 82.0), (66.0, 31.0), (64.0, 78.0)])
    frame = Frame(sharp, MODEL_PSF)
    model, fluxes = np.zeros((4, *sharp.shape)), FLUXES[:, :1] / 1e3
    for image, (y, x) in zip(model, places.astype(int), strict=True):
        image[y - 7 : y + 8, x - 7 : x + 8] = MODEL_PSF.images[0]
    there, data = sharp.positions_in(bent, *places.T), 0
    for image, flux, at in zip(model, fluxes, there, strict=True):
        op = Resampler(sharp, MODEL_PSF, bent, widening(*at)[0], device=device)
        data = data + flux * op.render(image.astype(np.float32))
    field = FunctionPSF(lambda y, x: widening(y, x)[0])
    o = Observation(data, field, bent, variance=1e-8)
    blend = Blend((o,), tuple(points(places)), frame)
    settings = Settings(psf_error=0, psf_tolerance=1e-5)
    point = Fit(blend, settings, device, np.float32, pad=1)
    assert point.views[0].op.geometry == ("distorted" if "sip" in given else "affine")
    start_fits([point])  # in boxes, which have plans of their own
    np.testing.assert_allclose(point.state.spectra * point.unit, fluxes * model.max(), rtol=3e-3)
    result = deblend([o], blend.sources, frame=frame, settings=settings, device=device)
    assert np.abs(result.residual(0)).max() < 1e-3 * data.max()


def test_errors_cover_fluxes_all_over_a_blend(device):
    n, rng = 25, np.random.default_rng(7)
    pulls = {"own": [], "middle": []}
    middle = widening((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
    data = [stars(CORNERS, seed=seed) for seed in rng.integers(1, 10**6, n)]
    for name, psf in (("own", None), ("middle", middle)):
        blends = [Blend((observation(d, psf),), tuple(points(CORNERS))) for d in data]
        settings = Settings(psf_error=0)
        for result in deblend_many(blends, settings=settings, device=device):
            pulls[name].append(_pulls(result))
    own = np.array(pulls["own"])  # (n, S, C)
    # their ripples end at the frame's edge: 0.1 % less flux, which flux_error_floor allows
    assert 0.7 < own.std() < 1.1
    assert np.abs(own.mean(axis=0)).max() < 1
    assert 0.62 < (np.abs(own) < 1).mean() < 0.86
    assert np.square(pulls["middle"]).mean() > 9


def test_stars_that_galsim_draws_with_their_local_psfs(device):
    galsim = pytest.importorskip("galsim")

    def profile(y, x):
        width = 0.65 * (1 + 0.0015 * x + 0.001 * y)
        return galsim.Moffat(beta=4, fwhm=width, trunc=3.5).shear(g1=4e-4 * x, g2=-0.02)

    def local(y, x):
        return PSF(profile(y, x).drawImage(nx=37, ny=37, scale=0.2).array)

    data = np.random.default_rng(2).normal(0, NOISE, SHAPE)
    for (y, x), flux in zip(CORNERS, (4e4, 2e4, 3e4, 5e4), strict=True):
        image = galsim.ImageD(SHAPE[1], SHAPE[0], scale=0.2)
        profile(y, x).withFlux(flux).drawImage(image, center=galsim.PositionD(x + 1, y + 1))
        data += image.array
    grid, found = Grid.flat(SHAPE, 0.2), {}
    for name, psf in (("own", FunctionPSF(local)), ("middle", local(35.5, 47.5))):
        o = Observation(data, psf, grid, variance=NOISE**2)
        found[name] = deblend([o], points(CORNERS), settings=Settings(psf_error=0), device=device)
    assert 0.95 < chi2(found["own"]) < 1.05
    assert chi2(found["middle"]) > 3
    fluxes = {k: np.array([c.flux[0] for c in r.components]) for k, r in found.items()}
    assert np.abs(fluxes["own"] / (4e4, 2e4, 3e4, 5e4) - 1).max() < 4e-3
    assert np.abs(fluxes["middle"] / (4e4, 2e4, 3e4, 5e4) - 1).max() > 2e-2


def _pulls(result):
    """Fluxes (S, C) off the truth, in their errors."""
    table = catalogue(result)
    rows = [
        (np.array(table[f"flux_{c}"]) - truth) / np.array(table[f"flux_err_{c}"])
        for c, truth in zip("gr", FLUXES.T, strict=True)
    ]
    return np.array(rows).T


@pytest.fixture(scope="module")
def varied(device):
    """Galaxies and a star fitted with a PSF that varies: the Result, and its Blend."""
    rng = np.random.default_rng(4)
    places = rng.uniform(15, 55, (5, 2)) * (1, 1.4)
    sources = [ExtendedSource(position_px=tuple(map(float, p))) for p in places[:4]]
    blend = Blend(
        (observation(stars(places, fluxes=rng.uniform(2e3, 5e3, (5, 2)))),),
        (*sources, *points(places[4:])),
    )
    return blend, deblend(blend.observations, blend.sources, device=device)


def test_a_result_holds_each_component_through_the_psf_at_its_source(varied, device):
    blend, result = varied
    (o,), frame = blend.observations, result.frame
    places = frame.positions_of(blend.sources)
    for i, c in enumerate(result.components):
        there = frame.grid.positions_in(o.grid, *places[c.source])
        op = Resampler(frame.grid, frame.psf, o.grid, widening(*there), device=device)
        image = np.zeros(frame.shape, np.float32)
        low, (n_y, n_x) = c.origin, c.morphology.shape
        image[low[0] : low[0] + n_y, low[1] : low[1] + n_x] = c.morphology
        found, wanted = np.asarray(result.rendered[0])[i], op.render(image)
        norm = np.linalg.norm(wanted, axis=(1, 2))
        off = np.linalg.norm(found - wanted, axis=(1, 2)) / norm
        assert (off < Settings().psf_tolerance).all()
        other = Resampler(frame.grid, frame.psf, o.grid, widening(36, 48), device=device)
        if abs(there[1] - 48) > 15:  # far from the middle, its PSF is another one
            assert (np.linalg.norm(found - other.render(image), axis=(1, 2)) > 3e-3 * norm).any()


def test_it_is_fitted_side_by_side_as_alone_and_travels(varied, device):
    blend, alone = varied
    flux, covariance = fluxes(alone)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)
    few = Blend(blend.observations, blend.sources[1:])
    many = deblend_many([blend, few, blend], device=device)
    for result in (many[0], many[2], pickle.loads(pickle.dumps(many[0]))):
        np.testing.assert_allclose(result.losses[-1], alone.losses[-1], rtol=1e-3)
        # what rounds differently in a batch may end a fit elsewhere, 0.25 of the loss lower
        assert (np.abs(fluxes(result)[0] - flux) < 0.5 * error).all()
    assert len(many[1].sources) == 4
    assert observation(alone.observations[0].data).psf_field.varies


def test_correlated_noise_keeps_each_source_s_psf(device):
    data, kernel = stars(CORNERS), np.outer([0.25, 1, 0.25], [0.25, 1, 0.25])
    smooth = observation(data, noise=kernel)  # data stay white: only what the model does counts
    result = deblend([smooth], points(CORNERS), settings=Settings(psf_error=0), device=device)
    fluxes = np.array([c.flux for c in result.components])
    assert np.abs(fluxes / FLUXES - 1).max() < 0.01
    plain = deblend(
        [observation(data, widening(35.5, 47.5), noise=kernel)],
        points(CORNERS),
        settings=Settings(psf_error=0),
        device=device,
    )
    assert np.abs(np.array([c.flux for c in plain.components]) / FLUXES - 1).max() > 0.02


def test_a_psf_that_hardly_varies_takes_one_term(device):
    data = stars(CORNERS)
    settings = Settings(psf_tolerance=0.5, max_iter=5)
    blend = Blend((observation(data),), tuple(points(CORNERS)))
    for tolerance, n_terms in ((0.5, 1), (2e-3, 3), (0.0, 4)):
        settings = Settings(psf_tolerance=tolerance)
        fit = Fit(blend, settings, device, np.float32, pad=1)
        assert fit.views[0].op.n_terms == n_terms
    with pytest.raises(ValueError, match="psf_tolerance is -1"):
        Settings(psf_tolerance=-1)
