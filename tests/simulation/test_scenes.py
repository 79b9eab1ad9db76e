"""Surveys, drawings and blended scenes: photometry, noise, geometry and reproducibility."""

import sys
from dataclasses import fields

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.table import Table

from clresample.simulation.galaxies import draw, import_galsim, open_catalogue, random_galaxy
from clresample.simulation.scenes import (
    SMOOTHING_ARCSEC,
    observe,
    simulate_scene,
    vis_magnitude,
)
from clresample.simulation.sdr import sdr
from clresample.simulation.surveys import (
    EUCLID_VIS,
    NOTEBOOK_SURVEYS,
    PAPER_SURVEYS,
    RUBIN_UGRIZY,
    Survey,
)
from clresample.sky.psf import PSF

SIGMA_POINT_ARCSEC = 0.02  # a point-like source: a tenth of a Rubin pixel


@pytest.fixture(scope="module")
def galsim():
    return pytest.importorskip("galsim", reason="GalSim (extra `sim`) is not installed")


@pytest.fixture(scope="module")
def scene(galsim):
    return simulate_scene(7, n_sources=3, angle_deg=30, flip=True, center_deg=(150.1, 2.2))


def centroid(image):
    """(row, column) of the light."""
    rows, cols = np.indices(image.shape)
    return np.array([(image * rows).sum(), (image * cols).sum()]) / image.sum()


def assert_same(a, b):
    """Two images are the same, bit for bit, in every array."""
    for field in fields(a):
        first, second = getattr(a, field.name), getattr(b, field.name)
        if isinstance(first, np.ndarray):
            np.testing.assert_array_equal(first, second, err_msg=field.name)


# ---- surveys


def test_tables_hold_both_parameter_sets():
    assert PAPER_SURVEYS["RUBIN"].psf_sigma_arcsec == (0.7,)
    assert NOTEBOOK_SURVEYS["RUBIN"].psf_sigma_arcsec == (0.297,)
    for surveys in (PAPER_SURVEYS, NOTEBOOK_SURVEYS):
        assert list(surveys) == ["HST", "EUCLID", "ROMAN", "HSC", "RUBIN"]
        scales = [survey.pixel_scale_arcsec for survey in surveys.values()]
        assert scales == sorted(scales)


def test_photometry_follows_the_recipe():
    # magnitude 24: exposure times zero point; 2.5 magnitudes brighter: ten times as much
    np.testing.assert_allclose(EUCLID_VIS.counts([24.0]), [2260 * 6.85])
    np.testing.assert_allclose(RUBIN_UGRIZY.counts([21.5] * 6)[2], 5520 * 43.70 * 10)
    np.testing.assert_allclose(RUBIN_UGRIZY.counts(RUBIN_UGRIZY.zero_points_mag), 1)
    variance = 2260 * 6.85 * 10 ** (-0.4 * (22.9 - 24)) * 0.101**2
    np.testing.assert_allclose(EUCLID_VIS.noise_sigma**2, [variance])


def test_stamps_of_the_same_sky():
    notebook = NOTEBOOK_SURVEYS
    assert EUCLID_VIS.n_same_sky(60, RUBIN_UGRIZY) == 118
    assert notebook["RUBIN"].n_same_sky(100, notebook["HST"]) == 30
    assert notebook["HST"].n_same_sky(60, notebook["HST"]) == 60


def test_psf_widths_are_those_of_the_table():
    psf = RUBIN_UGRIZY.psf()
    assert psf.images.shape == (6, 41, 41)
    u = np.arange(41) - 20
    variance_px = (psf.images.sum(axis=2) * u**2).sum(axis=1)
    sigmas_px = np.array(RUBIN_UGRIZY.psf_sigma_arcsec) / 0.2
    pixel_variance_px = 1 / 12
    np.testing.assert_allclose(variance_px, sigmas_px**2 + pixel_variance_px, rtol=1e-9)


def test_survey_mistakes_are_refused():
    with pytest.raises(ValueError, match="psf_sigma_arcsec has 2 entries for 1 bands"):
        Survey("x", 0.1, ("a",), (0.1, 0.2))
    with pytest.raises(ValueError, match="pixel_scale_arcsec is 0"):
        Survey("x", 0, ("a",), (0.1,))
    with pytest.raises(ValueError, match="psf_sigma_arcsec is"):
        Survey("x", 0.1, ("a",), (-0.1,))
    with pytest.raises(ValueError, match="survey HST has no zero_point"):
        PAPER_SURVEYS["HST"].counts([24.0])


# ---- SDR


def test_sdr_has_no_square():
    truth = np.zeros((2, 4, 4))
    truth[:, 1, 1] = 1
    estimate = truth.copy()
    estimate[0, 1, 1], estimate[1] = 1.01, 0
    np.testing.assert_allclose(sdr(truth, estimate), [20, 0], atol=1e-9)
    assert sdr(truth[0], truth[0]) == np.inf
    # scale drops out, and a model without light stays at 0 dB
    np.testing.assert_allclose(sdr(truth[1], estimate[1], unit_sum=True), 0)
    assert sdr(truth[0], 3 * truth[0], unit_sum=True) == np.inf
    with pytest.raises(ValueError, match=r"estimate has shape \(3,\), truth has \(4,\)"):
        sdr(np.ones(4), np.ones(3))


# ---- drawing


def test_drawn_gaussian_is_the_closed_form(galsim):
    """A Gaussian under a Gaussian PSF and a pixel is a product of error functions."""
    image = draw(galsim.Gaussian(sigma=0.12), RUBIN_UGRIZY.grid(41), psf_sigma_arcsec=0.297)
    assert image.dtype == np.float64
    exact = PSF.gaussian(np.hypot(0.12, 0.297) / 0.2).images[0]
    np.testing.assert_allclose(image, exact, atol=1e-5 * image.max())  # GalSim: 3e-6 of the peak


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 137])
@pytest.mark.parametrize("flip", [False, True])
def test_point_lands_where_the_grid_says(galsim, angle_deg, flip):
    grid = RUBIN_UGRIZY.grid(60, angle_deg=angle_deg, flip=flip)
    position = np.array([1.1, -2.3])  # (y, x) arcsec
    point = galsim.Gaussian(sigma=SIGMA_POINT_ARCSEC)
    image = draw(point, grid, psf_sigma_arcsec=0.297, position_arcsec=position)
    expected = np.linalg.solve(grid.jacobian, position - grid.origin)
    np.testing.assert_allclose(centroid(image), expected, atol=1e-3)  # pixels
    distance_px = np.linalg.norm(centroid(image) - 29.5)  # from the stamp's centre
    np.testing.assert_allclose(distance_px, np.hypot(*position) / 0.2, atol=1e-3)
    assert np.sign(np.linalg.det(grid.jacobian)) == (-1 if flip else 1)


def test_quarter_turn_of_the_grid_turns_the_image(galsim):
    """An elongated source, on a grid turned by 90 degrees and on a mirrored one."""
    galaxy = galsim.Gaussian(sigma=0.6).shear(q=0.5, beta=20 * galsim.degrees)
    image, turned = (draw(galaxy, RUBIN_UGRIZY.grid(40, angle_deg=angle)) for angle in (0, 90))
    # columns of the turned grid run along +y, rows along -x
    np.testing.assert_allclose(turned, np.rot90(image), atol=1e-6 * image.max())
    flipped = draw(galaxy, RUBIN_UGRIZY.grid(40, flip=True))
    np.testing.assert_allclose(flipped, image[:, ::-1], atol=1e-6 * image.max())


def test_galaxies_are_band_limited_and_of_unit_flux(galsim):
    rng = np.random.default_rng(3)
    for _ in range(5):
        galaxy = random_galaxy(rng, smoothing_arcsec=SMOOTHING_ARCSEC)
        np.testing.assert_allclose(galaxy.flux, 1, rtol=1e-12)
        image = draw(galaxy, EUCLID_VIS.grid(201), psf_sigma_arcsec=0.16)
        assert 0.97 < image.sum() < 1.0001  # wings beyond 10 arcsec
        power = np.abs(np.fft.fft2(image)) / image.sum()
        assert power[100].max() < 1e-3 and power[:, 100].max() < 1e-3  # at Nyquist's limit


def test_real_galaxies(galsim, data):
    catalogue = open_catalogue(data / "cosmos")
    rng = np.random.default_rng(5)
    galaxy = random_galaxy(rng, catalogue=catalogue, i_galaxy=4, turn=False, smoothing_arcsec=0.2)
    twin = random_galaxy(rng, catalogue=data / "cosmos", i_galaxy=4, smoothing_arcsec=0.2)
    images = [draw(g, EUCLID_VIS.grid(80), psf_sigma_arcsec=0.16) for g in (galaxy, twin)]
    np.testing.assert_allclose([image.sum() for image in images], 1, atol=2e-3)
    assert np.abs(images[0] - images[1]).max() > 1e-3 * images[0].max()  # it was turned
    with pytest.raises(ValueError, match="i_galaxy is 60, the catalogue has 60 rows"):
        random_galaxy(rng, catalogue=catalogue, i_galaxy=60)


def test_galaxy_mistakes_are_refused(galsim, tmp_path):
    with pytest.raises(ValueError, match=r"holds no galaxy catalogue.*does not exist"):
        open_catalogue(tmp_path)
    with pytest.raises(ValueError, match="smoothing_arcsec is -1"):
        random_galaxy(np.random.default_rng(0), smoothing_arcsec=-1)


def test_missing_galsim_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "galsim", None)
    with pytest.raises(ImportError, match="pip install galsim"):
        import_galsim()


# ---- scenes


def test_same_seed_same_bits(galsim, scene):
    again = simulate_scene(7, n_sources=3, angle_deg=30, flip=True, center_deg=(150.1, 2.2))
    for first, second in zip(scene.images, again.images, strict=True):
        assert_same(first, second)
    np.testing.assert_array_equal(scene.positions_deg, again.positions_deg)
    assert np.abs(simulate_scene(8, n_sources=1).euclid.data[0] - scene.euclid.data[0]).max() > 0


def test_sources_do_not_depend_on_geometry_or_number(galsim, scene):
    straight = simulate_scene(7, n_sources=2)
    np.testing.assert_array_equal(straight.positions_arcsec, scene.positions_arcsec[:2])
    np.testing.assert_array_equal(straight.rubin.magnitudes, scene.rubin.magnitudes[:2])
    np.testing.assert_array_equal(straight.euclid.truth, scene.euclid.truth[:2])
    assert straight.positions_deg is None and straight.euclid.grid.is_flat


def test_vis_follows_from_r_i_z_where_spectra_are_smooth(galsim, scene):
    """A flat spectrum has one magnitude; light in z alone gives VIS's part ln(900/818)."""
    smooth = simulate_scene(7, n_sources=3, spectra="smooth")
    ugrizy, vis = smooth.rubin.magnitudes, smooth.euclid.magnitudes[:, 0]
    r_i_z = ugrizy[:, 2:5]
    assert ((r_i_z.min(axis=1) < vis) & (vis < r_i_z.max(axis=1))).all()
    np.testing.assert_allclose(vis_magnitude(ugrizy), vis, atol=1e-9)
    assert vis_magnitude(np.full(6, 22.5)) == pytest.approx(22.5)
    part = np.log(900 / 818) / np.log(900 / 550)
    in_z = vis_magnitude([99, 99, 99, 99, 20, 99])
    assert in_z == pytest.approx(20 - 2.5 * np.log10(part), abs=1e-4)
    np.testing.assert_array_equal(smooth.positions_arcsec, scene.positions_arcsec)
    np.testing.assert_array_equal(smooth.euclid.truth, scene.euclid.truth)


def test_shapes_and_flux_budget(scene):
    rubin, euclid = scene.images
    assert rubin.data.shape == rubin.weights.shape == (6, 60, 60)
    assert euclid.data.shape == (1, 118, 118)
    assert rubin.contributions.shape == (3, 6, 60, 60)
    assert (rubin.truth.shape, euclid.truth.shape) == ((3, 60, 60), (3, 118, 118))
    for image in scene.images:
        kept = image.contributions.sum(axis=(2, 3)) / image.counts
        # wings outside the stamp; a source lies at least a sixth of a side from the edge
        assert (kept > 0.93).all() and (kept < 1.0001).all()
        np.testing.assert_allclose(image.truth.sum(axis=(1, 2)), kept.mean(axis=1), atol=0.03)
        np.testing.assert_allclose(image.counts, image.survey.counts(image.magnitudes))
    assert ((euclid.magnitudes >= 20) & (euclid.magnitudes <= 29)).all()
    brightest = rubin.magnitudes.min(axis=1)
    assert ((brightest >= 20) & (brightest <= 29)).all()
    side = 118 * 0.101
    assert (np.abs(scene.positions_arcsec) <= side / 3).all()


def test_noise_statistics(scene):
    rng = np.random.default_rng(11)
    for image in (*scene.images, *(i.with_noise(rng) for i in scene.images)):
        chi = (image.data - image.contributions.sum(axis=0)) * np.sqrt(image.weights)
        n = chi[0].size
        # five standard errors of a mean and of a standard deviation
        assert (np.abs(chi.mean(axis=(1, 2))) < 5 / np.sqrt(n)).all()
        assert (np.abs(chi.std(axis=(1, 2)) - 1) < 5 / np.sqrt(2 * n)).all()
    assert np.abs(np.corrcoef(chi.ravel()[1:], chi.ravel()[:-1])[0, 1]) < 5 / np.sqrt(chi.size)


def test_wcs_agrees_with_the_pixels(galsim):
    """Points, put on the sky: their light is where astropy says, in both instruments."""
    positions = np.array([[2.5, -1.5], [-3.0, 3.2]])
    points = [galsim.Gaussian(sigma=SIGMA_POINT_ARCSEC)] * 2
    center = SkyCoord(150.1, 2.2, unit="deg")
    # y to the north, x to the west; angular offsets leave the tangent plane by 1e-9 arcsec here
    north, west = positions.T * units.arcsec
    sky = center.spherical_offsets_by(-west, north)
    rng = np.random.default_rng(0)
    for survey, grid in (
        (EUCLID_VIS, EUCLID_VIS.grid(118)),
        (RUBIN_UGRIZY, RUBIN_UGRIZY.grid(60, angle_deg=30, flip=True)),
    ):
        magnitudes = np.full((2, survey.n_bands), 20.0)
        where = {"center_deg": (150.1, 2.2)}
        image = observe(survey, grid, points, positions, magnitudes, rng, **where)
        seen = np.array([centroid(source[0]) for source in image.contributions])
        np.testing.assert_allclose(seen, image.positions_px, atol=1e-3)
        col, row = image.grid.wcs.world_to_pixel(sky)
        np.testing.assert_allclose(np.stack([row, col], axis=1), image.positions_px, atol=1e-6)
        # unflipped: east to the left, a left-handed WCS
        parity = np.linalg.det(image.grid.wcs.pixel_scale_matrix)
        assert np.sign(parity) == -np.sign(np.linalg.det(grid.jacobian))


def test_celestial_and_flat_grids_map_alike(galsim, scene):
    """Rubin's pixels fall on the same Euclid pixels, through two WCS or two Jacobians."""
    flat = RUBIN_UGRIZY.grid(60, angle_deg=30, flip=True).map_to(EUCLID_VIS.grid(118))
    celestial = scene.rubin.grid.map_to(scene.euclid.grid)
    np.testing.assert_allclose(celestial.matrix, flat.matrix, atol=1e-6)
    np.testing.assert_allclose(celestial.offset, flat.offset, atol=1e-4)
    back = scene.rubin.positions_px @ flat.matrix.T + flat.offset
    np.testing.assert_allclose(back, scene.euclid.positions_px, atol=1e-9)


def test_colours_from_a_table(galsim, data):
    path = data / "catsim_ugrizy.fits"
    scene = simulate_scene(1, n_sources=2, colours=path, catalogue=data / "cosmos")
    table = Table.read(path)
    rows = np.stack([table[f"{band}_ab"] for band in "ugrizy"], axis=-1)
    for magnitudes in scene.rubin.magnitudes:
        spread = (rows - magnitudes) - (rows - magnitudes)[:, :1]
        assert np.abs(spread).max(axis=1).min() < 1e-9
    assert len(scene.galaxies) == 2


def test_scene_mistakes_are_refused(galsim):
    with pytest.raises(ValueError, match="n_sources is 0"):
        simulate_scene(1, n_sources=0)
    with pytest.raises(ValueError, match="spectra is 'blue', must be .independent. or"):
        simulate_scene(1, n_sources=1, spectra="blue")
    with pytest.raises(ValueError, match="colours has no column u_ab; it has a"):
        simulate_scene(1, n_sources=1, colours=Table({"a": [1]}))
    point, rng = galsim.Gaussian(sigma=0.1), np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"magnitudes has shape \(1, 2\), must be \(1, 1\)"):
        observe(EUCLID_VIS, EUCLID_VIS.grid(8), [point], [[0, 0]], [[20, 20]], rng)
    with pytest.raises(ValueError, match=r"positions_arcsec has shape \(1, 2\), must be \(2, 2\)"):
        observe(EUCLID_VIS, EUCLID_VIS.grid(8), [point] * 2, [[0, 0]], [[20], [20]], rng)
