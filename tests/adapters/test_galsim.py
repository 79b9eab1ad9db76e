"""Bridges to GalSim, checked by GalSim's own drawing."""

import numpy as np
import pytest
from astropy.wcs import WCS
from helpers.headers import header

from clresample import PSF, ExtendedSource, Grid, Observation, Resampler, deblend
from clresample.adapters.galsim import as_galsim, grid_of, image_of, profile_of, psf_of

galsim = pytest.importorskip("galsim", reason="GalSim is missing: pip install galsim")

FLAT = Grid.flat((41, 37), 0.2, angle_deg=25, flip=True, center_arcsec=(0.3, -0.4))
SKY = Grid.from_wcs(FLAT.to_wcs(ra_deg=359.9999, dec_deg=-41), FLAT.shape)


@pytest.fixture(params=[FLAT, SKY], ids=["flat", "sky"])
def grid(request):
    return request.param


def test_a_grid_comes_back_from_its_image(grid):
    other = grid_of(image_of(np.zeros(grid.shape, np.float32), grid))
    assert other.is_flat == grid.is_flat
    n, m = np.array([0.0, 3.5, 40]), np.array([0.0, 30, 36])
    np.testing.assert_allclose(other.positions_in(grid, n, m), np.stack([n, m], -1), atol=1e-6)


def test_a_grid_of_a_plain_image_is_flat():
    grid = grid_of(galsim.Image(np.zeros((4, 6)), scale=0.3))
    assert grid.shape == (4, 6)
    assert grid.pixel_scale_arcsec == pytest.approx(0.3)


@pytest.mark.parametrize("given", ["wcs", "header"])
@pytest.mark.parametrize("bounds", [(1, 30, 1, 20), (-4, 25, 8, 27)])
def test_a_grid_of_a_wcs_of_astropy(given, bounds):
    """Pixels that galsim has at the same places, wherever the image begins."""
    wcs = WCS(header((20, 30), CROTA2=25.0))
    own = {"wcs": wcs} if given == "wcs" else {"header": wcs.to_header()}
    image = galsim.Image(galsim.BoundsI(*bounds), wcs=galsim.AstropyWCS(**own))
    found = grid_of(image)
    assert found.shape == image.array.shape
    for y, x in ((0, 0), (3, 17)):
        place = image.wcs.toWorld(galsim.PositionD(image.xmin + x, image.ymin + y))
        ra, dec = place.ra / galsim.degrees, place.dec / galsim.degrees
        np.testing.assert_allclose(found.pixel(ra % 360, dec), (y, x), atol=1e-6)


def test_refuses_a_wcs_that_varies_on_a_plane():
    wcs = galsim.UVFunction("0.2 * x + 1e-3 * x * y", "0.2 * y")
    with pytest.raises(ValueError, match="UVFunction"):
        grid_of(galsim.Image(np.zeros((4, 6)), wcs=wcs))


def test_a_psf_is_galsims_own_drawing(grid):
    """A sheared Moffat on turned pixels: the orientation counts, and the pixel is in it."""
    profile = galsim.Moffat(beta=3.5, fwhm=0.8).shear(g1=0.2, g2=0.1)
    psf = psf_of(profile, grid, n_pixels=21)
    stamp = image_of(np.zeros(grid.shape), grid)
    centre = stamp.true_center
    local = stamp.wcs.local(centre)
    drawn = profile.drawImage(nx=21, ny=21, wcs=local, dtype=float).array
    np.testing.assert_allclose(psf.images[0], drawn / drawn.sum(), atol=3e-4 * drawn.max())


def test_an_oversampled_psf_renders_as_the_plain_one():
    profile = galsim.Gaussian(fwhm=0.9).shear(g1=0.1)
    plain, fine = (psf_of(profile, FLAT, n_pixels=25, oversampling=k) for k in (1, 3))
    nu = np.linspace(-0.3, 0.3, 7)
    np.testing.assert_allclose(fine.otf(nu, nu), plain.otf(nu, nu), atol=2e-4)


def test_an_operator_takes_galsims_images():
    rubin = Grid.flat((15, 14), 0.4)
    op = Resampler(Grid.flat((40, 40), 0.1), PSF.gaussian(1.6), rubin, PSF.gaussian(1.5))
    source = galsim.Gaussian(sigma=0.5).shift(0.1, 0.2)
    image = source.drawImage(nx=40, ny=40, scale=0.1)
    seen = as_galsim(op, rubin)(image)
    np.testing.assert_array_equal(seen.array, op(image.array))
    centroid = galsim.hsm.FindAdaptiveMom(seen).moments_centroid
    where = seen.wcs.toWorld(centroid)
    assert (where.x, where.y) == pytest.approx((0.1, 0.2), abs=2e-3)


def test_a_profile_draws_its_image_again(grid):
    image = np.zeros(grid.shape)
    y, x = np.indices(grid.shape)
    image = np.exp(-0.5 * ((y - 21) ** 2 + 0.5 * (x - 17) ** 2 - 0.4 * (y - 21) * (x - 17)) / 4)
    profile = profile_of(image, grid, (21.0, 17.0))
    assert profile.flux == pytest.approx(image.sum(), rel=1e-3)
    local = image_of(image, grid).wcs.local(galsim.PositionD(18, 22))
    drawn = profile.drawImage(nx=21, ny=21, wcs=local, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(drawn, image[11:32, 7:28], atol=2e-3)


def test_a_fitted_source_draws_as_it_was_fitted():
    """Drawn by GalSim on the frame's pixels, it is the fit's own model of that source."""
    grid, psf = Grid.flat((32, 32), 0.2), PSF.gaussian(1.5)
    source = galsim.Gaussian(sigma=0.5, flux=100).shift(0.1, -0.1)
    data = source.drawImage(nx=32, ny=32, scale=0.2, dtype=float).array
    data += np.random.default_rng(1).normal(0, 0.05, data.shape)
    o = Observation(data, psf, grid, variance=0.05**2, channels=["r"])
    result = deblend([o], [ExtendedSource(sky_deg=(-0.1, 0.1))])
    model, frame = result.source_model(0)[0], result.frame
    profile = result.as_galsim(0, "r")
    assert profile.flux == pytest.approx(model.sum(), rel=1e-3)
    stamp = image_of(np.zeros(frame.shape), frame.grid)
    placed = profile.shift(0.1, -0.1)  # from the source's position to the sky's origin
    drawn = placed.drawImage(image=stamp, method="no_pixel", center=stamp.wcs.toImage(
        galsim.PositionD(0, 0))).array  # fmt: skip
    np.testing.assert_allclose(drawn, model, atol=2e-3 * model.max())
    with pytest.raises(ValueError, match="'z'"):
        result.as_galsim(0, "z")


@pytest.mark.parametrize("name", ["n_pixels", "oversampling"])
def test_even_numbers_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 4"):
        psf_of(galsim.Gaussian(sigma=1), FLAT, **{name: 4})
