"""Stars on the pixels of an observation whose PSF has waves shorter than two of them."""

import numpy as np
import pytest
from scipy.special import erf

from clresample.deblending.assessment.cores import core_errors
from clresample.deblending.batch import deblend
from clresample.deblending.inspection.star_psfs import StarPSFs
from clresample.deblending.profiles import ALIAS_PX, StarProfile, draw_psf
from clresample.deblending.sampled_psf import MAX_REACH_PX, reach_px, sampled_psfs
from clresample.measurement.photometry import fluxes
from clresample.resampling.resampler import Resampler
from clresample.sky.frame import Frame, model_frame, model_psf
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation, with_psf_field
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

SHAPE, SIGMA = (41, 45), 0.45  # of the light before the pixel [px]
GRID = Grid.flat(SHAPE, 0.1)
PLACES = [(20.0, 22.0), (20.5, 22.5), (19.7, 21.2)]


def pixel_psf(*sigmas):
    """The effective PSF, of Gaussians behind square pixels, four samples a pixel."""
    return PSF.gaussian(sigmas or SIGMA, n_pixels=81, spacing=0.25)


def exact_light(place, sigma=SIGMA):
    """Light in the pixels of a star of unit flux at a place (2,) [px]."""
    sides = []
    for n, c in zip(SHAPE, place, strict=True):
        edges = erf((np.arange(n + 1) - 0.5 - c) / (np.sqrt(2) * sigma))
        sides.append(np.diff(edges) / 2)
    return np.outer(*sides)


def observation(psf=None, grid=GRID):
    psf = pixel_psf() if psf is None else psf
    return Observation(np.zeros(grid.shape), psf, grid, weights=1.0, channels=("r",), name="cam")


@pytest.mark.parametrize("place", PLACES)
def test_stars_are_exact_on_the_pixels_that_alias_their_light(device, place):
    psf, model = pixel_psf(), model_psf(0.8)
    op = Resampler(GRID, model, GRID, psf, device=device, dtype=np.float64)
    wanted = exact_light(place)
    own, smooth = (
        op(draw_psf(model, place, SHAPE, slopes=False, sampled=sampled)) - wanted
        for sampled in ((psf,), ())
    )
    assert np.abs(own).max() < 1e-3 * wanted.max()
    assert np.abs(smooth).max() > 0.02 * wanted.max()


@pytest.mark.parametrize("ratio", [None, 1.0, 1 + 1e-5])
def test_bands_whose_light_the_pixels_alias_differently_need_finer_ones(device, ratio):
    """As two bands of Roman: on their own pixels no image of a star has the waves of both.

    ratio: of their pixels, in two observations
    """
    widths, flux = (0.4, 0.55), 3000.0
    light = flux * np.array([exact_light(PLACES[2], sigma) for sigma in widths])
    data = light + np.random.default_rng(0).normal(size=light.shape)
    psf, bands = pixel_psf(*widths), ([0], [1]) if ratio else ([0, 1],)
    observations = [
        Observation(data[k], psf[k], grid, weights=1.0, channels=tuple("ab"[i] for i in k))
        for k, grid in zip(bands, (GRID, Grid.flat(SHAPE, 0.1 * (ratio or 1))), strict=False)
    ]
    star, off = [PointSource(position_px=PLACES[2], observation=observations[0].label)], []
    for grid in (None, GRID):
        frame = model_frame(observations, grid=grid)
        found = deblend(observations, star, frame=frame, device=device)
        off.append(np.abs(fluxes(found)[0] / flux - 1).max())
        assert (frame.shape == SHAPE) == (grid is GRID)
    assert off[0] < 0.01 and off[1] > 0.03
    same = pixel_psf(0.3, 0.3)
    assert model_frame([observation(same[0])]).shape == SHAPE
    once, again = (
        Observation(np.zeros(SHAPE), same[k], GRID, weights=1.0, channels=("ab"[k],))
        for k in (0, 1)
    )
    assert model_frame([once, again]).shape == SHAPE


def test_slopes_are_those_by_the_position():
    psf, place, h = (pixel_psf(),), np.array([19.7, 21.2]), 1e-4
    drawn = draw_psf(model_psf(0.8), place, SHAPE, sampled=psf)
    for axis, unit in enumerate(np.eye(2) * h):
        ends = [draw_psf(model_psf(0.8), place + s * unit, SHAPE, sampled=psf)[0] for s in (1, -1)]
        np.testing.assert_allclose(drawn[1 + axis], (ends[0] - ends[1]) / (2 * h), atol=1e-6)


def test_a_psf_without_short_waves_changes_nothing():
    smooth, model = PSF.gaussian(1.8, n_pixels=81, spacing=0.5), model_psf(0.8)
    old, new = (draw_psf(model, (20.5, 22.25), SHAPE, sampled=some) for some in ((), (smooth,)))
    middle = np.s_[:, 17:25, 19:27]
    np.testing.assert_allclose(new[middle], old[middle], atol=0.02 * old[0].max())


def test_boxes_hold_the_waves_of_bright_stars():
    home = Frame(GRID, model_psf(0.8))
    star, plain = (StarProfile(home, free=True, sampled=s) for s in ((pixel_psf(),), ()))
    place = np.array([20.0, 22.0])
    reach = [star.bounding_box(np.zeros(2), place, t)[1][0] for t in (1e-2, 1e-5, 1e-7)]
    assert reach[0] == plain.bounding_box(np.zeros(2), place, 1e-7)[1][0]
    assert reach[0] < reach[1] < reach[2] <= ALIAS_PX[1] + 1
    assert reach_px([pixel_psf()]) == 11
    assert reach_px([PSF.gaussian(3.0, n_pixels=2 * MAX_REACH_PX + 9)]) == MAX_REACH_PX


@pytest.mark.parametrize(
    "psf, grid, n",
    [
        (None, GRID, 1),
        (None, GRID.cutout(-3, 5, (50, 51)), 1),
        (PSF.gaussian(1.0), GRID, 0),  # no sample between pixels
        (PSF.gaussian(2.0, n_pixels=81, spacing=0.25), GRID, 0),  # no wave below two pixels
        (None, Grid.flat(SHAPE, 0.1, center_arcsec=(0.03, 0)), 0),  # between the frame's pixels
        (None, Grid.flat(SHAPE, 0.2), 0),
    ],
)
def test_psfs_are_of_observations_on_the_frames_pixels(psf, grid, n):
    found = sampled_psfs(Frame(GRID, model_psf(0.8)), [observation(psf, grid)], (20.3, 22.4))
    assert len(found) == n


@pytest.mark.parametrize("keeps_core", [False, True])
def test_stars_with_psfs_of_their_own_are_left_out_unless_they_keep_the_core(keeps_core):
    psf, place = pixel_psf(), np.array([20.3, 22.4])
    own = (PSF.gaussian(2.0),)
    errors = np.zeros((1, 1)), np.full((1, 1), np.inf)
    field = StarPSFs(psf, None, place[None], own, *errors, np.array([keeps_core]))
    home, one = Frame(GRID, model_psf(0.8)), with_psf_field(observation(), field)
    assert sampled_psfs(home, [one], place) == ((psf,) if keeps_core else ())
    assert sampled_psfs(home, [one], place + 5) == (psf,)


def test_a_galaxy_beside_a_star_has_its_flux_however_finely_the_psf_is_sampled():
    """Without waves that pixels alias the star's model is exact for its neighbours.

    Their errors hold that of the PSF beside a star of any brightness.
    """
    star, at, fwhm_px, shape = np.array([24.3, 27.6]), np.array([18.3, 29.6]), 4.0, (49, 53)
    y, x = np.indices(shape)

    def moffat(y, x):
        radius = fwhm_px / 2 / np.sqrt(2**0.4 - 1)
        return (1 + (y**2 + x**2) / radius**2) ** -2.5 * 1.5 / (np.pi * radius**2)

    sigma2 = 3.0**2 + (fwhm_px / 2.355) ** 2
    flux = 20 * 5 * np.sqrt(4 * np.pi * sigma2)
    light = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * sigma2)) / (2 * np.pi * sigma2)
    data = 3e4 * moffat(y - star[0], x - star[1]) + flux * light
    data += np.random.default_rng(1).normal(0, 5, shape)
    found = []
    for spacing in (1.0, 0.5):
        sides = np.arange(-20, 20 + spacing / 2, spacing)
        psf = PSF(moffat(sides[:, None], sides), spacing=spacing)
        one = Observation(data, psf, Grid.flat(shape, 0.26), weights=1 / 25, channels=("r",))
        result = deblend([one], [PointSource(position_px=star), ExtendedSource(position_px=at)])
        found.append((result.components[1].flux[0], result.errors.flux[0, 1, 1] ** 0.5))
        by_star = core_errors(result)[:, 0]
        assert by_star[0] == 0 < 0.03 * flux < by_star[1] < found[-1][1]
    for galaxy, error in found:
        assert abs(galaxy - flux) < max(2 * error, 0.1 * flux)
    assert abs(found[0][0] - found[1][0]) < 0.5 * found[0][1]


@pytest.mark.parametrize("away", [(0.0, 0.0), (1.4, -0.9)])
def test_a_star_on_a_galaxy_leaves_its_light_where_pixels_alias_the_star(away):
    """A sharp image and a wide one, of a disk of 8 pixels and a star five times as bright."""
    galsim = pytest.importorskip("galsim")
    rng, fluxes, found = np.random.default_rng(4), (4000.0, 20000.0), []
    disk = galsim.Exponential(half_light_radius=0.8).shear(g1=0.2)
    for scale, n, psf, spacing in (
        (0.1, 128, galsim.Moffat(3, fwhm=0.16, trunc=1.5), 0.25),
        (0.2, 64, galsim.Moffat(3.5, fwhm=0.7, trunc=4.0), 1.0),
    ):
        psf = galsim.Convolve(psf, galsim.Pixel(scale))
        star = psf.shift(0.1 * away[1], 0.1 * away[0])
        light = fluxes[0] * galsim.Convolve(disk, psf) + fluxes[1] * star
        data = light.drawImage(nx=n, ny=n, scale=scale, method="no_pixel", dtype=float).array
        side = 4 * round(3.2 / (scale * spacing * 8)) + 1
        image = psf.drawImage(nx=8 * side + 1, ny=8 * side + 1, scale=scale * spacing,
                              method="no_pixel", dtype=float).array  # fmt: skip
        variance = 1 + data / 5
        data = data + rng.normal(size=data.shape) * variance**0.5
        given = PSF(image, spacing=spacing), Grid.flat((n, n), scale)
        found.append(Observation(data, *given, variance=variance, name=f"{scale}"))
    middle = np.array([63.5, 63.5])
    sources = [ExtendedSource(position_px=middle), PointSource(position_px=middle + away)]
    result = deblend(found, sources)
    for component, flux in zip(result.components, fluxes, strict=True):
        np.testing.assert_allclose(component.flux, flux, rtol=0.06)
