"""Mosaics as linear maps: areas, flux, noise and PSF are what drawn and drizzled images have."""

import numpy as np
import pytest

from clresample.deblending.profiles import draw_psf, psf_second_moment
from clresample.simulation.mosaics import drizzle, lanczos, overlap_area
from clresample.sky.correlation import NoiseCorrelation
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

SIGMA_ARCSEC = 0.3
TURNED = Grid.flat((70, 70), 0.2, angle_deg=20)
UPRIGHT = Grid.flat((50, 50), 0.14)


def dithered(n=4, shape=(70, 70)):
    centers = [(0, 0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1)][:n]
    return [Grid.flat(shape, 0.2, angle_deg=20, center_arcsec=at) for at in centers]


def star(grid, position=(0.03, -0.05)):
    """A Gaussian star of flux 1 under the pixel of a flat grid, by sums over 9 x 9 points of it."""
    steps = (np.arange(9) - 4) / 9
    n, m = np.indices(grid.shape)
    image = np.zeros(grid.shape)
    for i in steps:
        for j in steps:
            y, x = grid.sky(n + i, m + j)
            r2 = (y - position[0]) ** 2 + (x - position[1]) ** 2
            image += np.exp(-r2 / (2 * SIGMA_ARCSEC**2))
    area = abs(np.linalg.det(grid.jacobian))
    return image / 81 * area / (2 * np.pi * SIGMA_ARCSEC**2)


MOSAICS = {
    "lanczos": ([TURNED], lanczos(TURNED, UPRIGHT)),
    "lanczos of equal pixels": ([TURNED], lanczos(TURNED, Grid.flat((40, 40), 0.2))),
    "drizzle": (dithered(), drizzle(dithered(), UPRIGHT, 0.8)),
    "drizzle of one exposure": (dithered(1), drizzle(dithered(1), Grid.flat((40, 40), 0.2), 1.0)),
}


@pytest.mark.parametrize("k", [3, 4, 6])
def test_overlaps_are_those_counted_point_by_point(k):
    rng = np.random.default_rng(k)
    angle = np.sort(rng.uniform(0, 2 * np.pi, (20, k)), axis=1)
    polygons = np.stack([np.sin(angle), np.cos(angle)], axis=2) * rng.uniform(0.3, 1.2, (20, 1, 1))
    polygons += rng.uniform(-0.5, 1.5, (20, 1, 2))
    found = overlap_area(polygons)
    fine = (np.arange(400) + 0.5) / 400
    y, x = np.meshgrid(fine, fine, indexing="ij")
    for polygon, area in zip(polygons, found, strict=True):
        inside = np.zeros(y.shape, bool)
        for (y0, x0), (y1, x1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            crossed = (y0 > y) != (y1 > y)
            inside ^= crossed & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0 + 1e-300))
        assert area == pytest.approx(inside.mean(), abs=4e-3)


def test_overlaps_of_upright_squares_are_exact():
    square = np.array([(0, 0), (0, 1), (1, 1), (1, 0)], float)
    moved = [square, square + (0.25, -0.5), square + (1, 0), 3 * square - 1, square[::-1] * 0.5]
    assert overlap_area(np.array(moved)) == pytest.approx([1, 0.375, 0, 1, 0.25], abs=1e-15)


def test_all_of_a_drop_lands_on_the_mosaic():
    grids = dithered(2, (20, 20))
    wide = drizzle(grids, Grid.flat((60, 60), 0.14), 0.8)
    # the weights before they are divided by what a pixel received: undone by one's own areas
    area = np.array(wide.matrix.sum(axis=1)).ravel()
    assert area[wide.has_data.ravel()] == pytest.approx((0.14 / 0.2) ** 2, rel=1e-9)
    assert set(np.diff(wide.matrix.tocsc().indptr)) <= set(range(1, 17))


@pytest.mark.parametrize("name", MOSAICS)
def test_light_is_kept(name):
    grids, mosaicking = MOSAICS[name]
    flat = mosaicking.images([np.ones((1, *g.shape)) for g in grids])[0]
    per_pixel = mosaicking.grid.pixel_scale_arcsec**2 / 0.2**2
    assert flat[mosaicking.has_data] == pytest.approx(per_pixel, rel=1e-9)
    assert mosaicking.has_data.all()
    seen = mosaicking.images([star(g)[None] for g in grids])[0]
    assert seen.sum() == pytest.approx(1, rel=2e-3)


@pytest.mark.parametrize("name", MOSAICS)
def test_stars_have_the_stated_psf(name):
    grids, mosaicking = MOSAICS[name]
    grid, at = mosaicking.grid, (0.03, -0.05)
    psf = mosaicking.psf(PSF.gaussian(SIGMA_ARCSEC / 0.2))
    expected = draw_psf(psf, grid.pixel(*at), grid.shape, slopes=False)[0]
    data = mosaicking.images([star(g, at)[None] for g in grids])[0]
    # what is left changes with the sub-pixel phase, and is no PSF
    assert (
        np.abs(data - expected).max()
        < (0.06 if name.endswith("one exposure") else 0.03) * data.max()
    )
    assert abs((data * expected).sum() / (expected**2).sum() - 1) < 0.01
    native = (SIGMA_ARCSEC**2 + 0.2**2 / 12) / grid.pixel_scale_arcsec**2
    drop = 0.8 if len(grids) == 4 else 1.0
    squares = (drop * 0.2 / grid.pixel_scale_arcsec) ** 2 / 12 + 1 / 12  # drop, pixel
    wider = psf_second_moment(psf)[0, 0] - native
    assert wider == pytest.approx(squares if name.startswith("drizzle") else 0, rel=0.1, abs=0.05)


@pytest.mark.parametrize("name", MOSAICS)
def test_noise_has_the_stated_variance_and_correlation(name):
    grids, mosaicking = MOSAICS[name]
    rng = np.random.default_rng(1)
    images = np.concatenate(
        [mosaicking.images([rng.normal(size=(60, *g.shape)) for g in grids]) for _ in range(2)]
    )
    variance = mosaicking.variance()
    assert (images.var(axis=0) / variance).mean() == pytest.approx(1, abs=0.02)
    stated = mosaicking.correlation()
    found = NoiseCorrelation.from_realisations(images, weights=1 / variance)
    assert found.error_factor(2.0) == pytest.approx(stated.error_factor(2.0), rel=0.03)
    reach = min(len(a) // 2 for a in (stated.autocorrelation, found.autocorrelation))
    middle = [
        a[len(a) // 2 - 2 : len(a) // 2 + 3, len(a) // 2 - 2 : len(a) // 2 + 3]
        for a in (stated.autocorrelation, found.autocorrelation)
    ]
    assert reach > 2
    assert np.abs(middle[0] - middle[1]).max() < 0.02
    assert stated.error_factor(2.0) > 1.08


def test_lanczos_is_galsims():
    galsim = pytest.importorskip("galsim")
    rng = np.random.default_rng(2)
    image = rng.normal(size=(40, 40))
    grid_in, grid = Grid.flat((40, 40), 1.0), Grid.flat((20, 20), 1.0, center_arcsec=(0.3, -0.2))
    found = lanczos(grid_in, grid).images([image[None]])[0]
    interpolated = galsim.InterpolatedImage(
        galsim.Image(image, scale=1.0), x_interpolant=galsim.Lanczos(3), normalization="sb"
    )
    out = galsim.ImageD(20, 20, scale=1.0)
    interpolated.drawImage(out, method="sb", offset=(0.2, -0.3))
    assert np.abs(found - out.array).max() < 0.02 * np.abs(image).max()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: lanczos(TURNED, UPRIGHT, 0), "order is 0"),
        (lambda: drizzle([TURNED], UPRIGHT, 1.5), "pixfrac is 1.5"),
        (lambda: drizzle([TURNED, UPRIGHT], UPRIGHT), "several Jacobians"),
        (
            lambda: lanczos(Grid.flat((5, 5), 1.0), Grid.flat((5, 5), 1.0)).psf(PSF.gaussian(1.0)),
            "reach no pixel",
        ),
    ],
)
def test_what_cannot_be_a_mosaic_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()
