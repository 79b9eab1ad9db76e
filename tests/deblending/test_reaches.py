"""The light of each source is rendered as far as its flux and its own PSF need."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.geometries import sky_grid

from clresample.deblending.linear.component_batch import StartComponent
from clresample.deblending.linear.linearised_scenes import linearise
from clresample.deblending.linear.placing import wing_light
from clresample.deblending.linear.render_planner import MISSED_SIGMAS
from clresample.deblending.profiles import GalaxyProfile
from clresample.deblending.start.profile_start import PRECISION, TOLERANCE
from clresample.deblending.view import WhitenedView
from clresample.resampling.cache import cached_resampler
from clresample.sky.frame import Frame
from clresample.sky.psf import PSF, cut_psf

SHAPE = 96, 96


def with_halo(part):
    """PSF samples (161, 161): a Gaussian's, and a part of the light in a halo of slope -2."""
    core = PSF.gaussian(1.5, n_pixels=161).images[0]
    y, x = np.indices(core.shape) - 80.0
    halo = 1 / (25 + y**2 + x**2)
    return (1 - part) * core + part * halo / halo.sum()


@pytest.mark.parametrize("matrix", [np.eye(2), 2.0 * np.array([[0.8, 0.6], [-0.6, 0.8]])])
def test_light_beyond_a_distance_is_that_of_a_gaussian(matrix):
    psf, stretch = PSF.gaussian(2.0, n_pixels=161, spacing=0.25, pixel=False), np.hypot(*matrix[0])
    plan = SimpleNamespace(psfs=(None, psf), mapping=SimpleNamespace(matrix=matrix))
    radius = np.array([5.0, 3.0, 1.0])
    found = wing_light(plan, stretch * radius)
    # integral of p^2 beyond r is exp(-(r / sigma)^2) / (4 pi sigma^2)
    wanted = np.exp(-((radius / 2.0) ** 2) / 2) / np.sqrt(4 * np.pi) / (2.0 * stretch)
    np.testing.assert_allclose(found, wanted[None], rtol=0.03)


def test_a_psf_is_cut_about_the_centre_of_each_band():
    """Bands whose light lies within the radius keep their transforms."""
    images = np.zeros((2, 41, 45))
    images[0, 4:11, 6:13] = images[1, 30:37, 20:27] = PSF.gaussian(1.0, n_pixels=7).images[0]
    center = np.array([(7.0, 9.0), (33.0, 23.0)])
    psf = PSF.restore(images, spacing=0.5, center=center)
    cut = cut_psf(psf, np.array([2.0, 3.0]))
    assert cut.images.shape == (2, 9, 13)
    nu = np.linspace(-0.7, 0.7, 9)
    np.testing.assert_allclose(cut.otf(nu, nu), psf.otf(nu, nu), atol=1e-14)
    assert cut_psf(psf, np.array([10.0, 11.0])) is psf  # 41 and 45 samples
    assert cut_psf(psf, np.array([2.0, 30.0])).images.shape == (2, 9, 45)


@pytest.mark.parametrize("flux", [300.0, 3e4])
@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_faint_galaxies_beside_a_star_with_a_halo_are_rendered_near_them_alone(device, angle, flux):
    """Whose PSF has the halo, and how bright a galaxy is, decides; what is left out is not seen."""
    psf = PSF.restore(
        np.stack([with_halo(0.0), with_halo(0.05)]), spacing=1.0, center=np.full((2, 2), 80.0)
    )
    home = Frame(sky_grid(SHAPE, 0.1), PSF.gaussian(0.8, n_pixels=15))
    grid = sky_grid(SHAPE, 0.1, angle)
    op = cached_resampler(home, grid, psf, dtype=np.float32, device=device, n_terms=2)
    shares = np.array([[[1.0, 0.0]], [[0.0, 1.0]]])
    data = np.zeros(op.shape_out)
    view = WhitenedView(op, op.mapping, op.covered, np.ones(1), data + 1, data, shares)
    places = np.array([(48.0, 40.0), (48.0, 56.0)])
    components = [
        StartComponent(0, i, i, GalaxyProfile(home), place, home.shape)
        for i, place in enumerate(places)
    ]
    looking = linearise([[view]], components, PRECISION, TOLERANCE, fit_sky=False)
    (sight,) = looking.sights
    level = sight.aim.levels(components, np.full(2, flux))
    assert level[0] > level[1]
    thetas = [c.shape.mean for c in components]
    each = zip(components, thetas, places, strict=True)
    peaks = np.array([c.shape.draw(theta, place)[0].max() for c, theta, place in each])
    looking.render([0], thetas, flux * peaks, slopes=False, whiten=False)
    images = dict(zip(looking.at.tolist(), sight.lit_images(), strict=True))
    for i, (window, found) in images.items():
        own = PSF.restore(psf.images[i : i + 1], spacing=1.0, center=psf.center[:1])
        whole = cached_resampler(home, grid, own, dtype=np.float32, device=device)
        drawn = components[i].shape.draw(thetas[i], places[i])[:1]
        missed = whole.render(drawn.astype(np.float32))[0]
        missed[:, *window] -= found[0]
        # the start's own precision, and light that is left out
        assert flux * np.linalg.norm(missed) < 2 * MISSED_SIGMAS + flux * TOLERANCE
    sides = {i: max(found.shape[2:]) for i, (_, found) in images.items()}
    assert sides[0] < (60 if flux < 1e3 else 80) and sides[0] < sides[1]
