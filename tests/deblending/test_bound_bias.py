"""Bias by the bound at 0, and chi2 in light: finite differences, many noises."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import MODEL_PSF

from clresample.deblending.batch import deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.component_images import ComponentImages, local_chi2
from clresample.deblending.linear.rendered_models import RenderedModel
from clresample.deblending.posterior.bound_bias import (
    negative_chi2_gradient,
    release_factor,
    within_errors,
)
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.photometry import bounded_fluxes, fluxes
from clresample.sky.frame import Frame
from clresample.sky.sources import ExtendedSource, PointSource

N_NOISES, FLUX, NOISE = 32, 1000.0, 0.2


class Matrix:
    """A dense operator from bands (n_bands, 5, 6) to channels (2, 4, 4), float64."""

    dtype = np.float64

    def __init__(self, rng, n_bands):
        self.a = rng.normal(size=(2 * 16, n_bands * 30))
        self.n_bands = n_bands

    def forward(self, x):
        return (self.a @ x.ravel()).reshape(2, 4, 4)

    def adjoint(self, y):
        return (self.a.T @ y.ravel()).reshape(self.n_bands, 5, 6)


@pytest.mark.parametrize("n_terms", [1, 2])
def test_pulls_are_slopes_of_chi2(n_terms):
    """By central differences; with the sky, and PSFs that vary over the sources."""
    rng = np.random.default_rng(0)
    op, source = Matrix(rng, 2 * n_terms), np.array([1, 0, 1])
    origin = np.array([[0, 1], [2, 2], [1, 0]])
    morphs = [rng.normal(size=s) for s in ((3, 4), (2, 3), (4, 4))]
    spectra, sky = rng.normal(size=(3, 2)), rng.normal(size=2)
    shares = rng.normal(size=(2, 2, n_terms)) if n_terms > 1 else None
    root, data = rng.uniform(1, 2, (2, 4, 4)), rng.normal(size=(2, 4, 4))

    def image(i, morph):
        """Images of component i in the observation (2, 4, 4), each channel on its own."""
        (y, x), (n_y, n_x) = origin[i], morph.shape
        parts = np.ones((2, 1)) if shares is None else shares[source[i]]
        seen = np.zeros((2, 4, 4))
        for c in range(2):
            frame = np.zeros((2, n_terms, 5, 6))
            frame[c, :, y : y + n_y, x : x + n_x] = parts[c, :, None, None] * morph
            seen += spectra[i, c] * op.forward(frame.reshape(-1, 5, 6))
        return seen

    def loss(values):
        model = sum(image(i, m) for i, m in enumerate(values)) + sky[:, None, None]
        return 0.5 * ((root * (data - model)) ** 2).sum()

    view = SimpleNamespace(op=op, sqrt_weights=root, data=data, coefficients=shares)
    scene = SimpleNamespace(origin=origin, profile=morphs, channels=lambda: [slice(0, 2)])
    model = sum(image(i, m) for i, m in enumerate(morphs))
    found = negative_chi2_gradient(
        scene, [view], source, spectra, [data - model - sky[:, None, None]]
    )
    for i, morph in enumerate(morphs):
        for at in np.ndindex(morph.shape):
            step = [m.copy() for m in morphs]
            step[i][at] += 1e-5
            up = loss(step)
            step[i][at] -= 2e-5
            assert found[i][at] == pytest.approx((loss(step) - up) / 2e-5, rel=1e-5, abs=1e-5)


def test_fluxes_of_bright_galaxies_are_not_biased_by_noise(device):
    """The mean over many noises: by the components alone it is too high by a third of an error and
    more, since noise in the wings is followed up, but not below 0."""
    frame, middle = Frame(scenes.grids()[0], MODEL_PSF), (14.3, 17.6)
    objects = ((middle, (FLUX,) * 3, 2.2),)
    noisy = [scenes.observe(objects, noise=NOISE, seed=seed) for seed in range(N_NOISES)]
    blends = [Blend(tuple(o), (ExtendedSource(position_px=middle),), frame) for o in noisy]
    results = deblend_many(blends, device=device)
    found = np.array([fluxes(r)[0][0] for r in results])
    error = np.sqrt(np.mean([np.einsum("css->sc", fluxes(r)[1])[0] for r in results], axis=0))
    released = np.array([r.errors.flux_correction[0] for r in results])
    assert (released < 0).mean() > 0.9
    bias, before = (((f.mean(0) - FLUX) / error).mean() for f in (found, found - released))
    # each is known to 1 / sqrt(32 noises of 3 bands) = 0.1, their difference better
    assert before > 0.2 and abs(bias) < 0.7 * before, (bias, before)


def test_fluxes_without_light_are_not_biased_by_noise(device):
    """A galaxy's in a band that it drops out of, and a star's that is not there.

    Models follow positive noise alone, so that their means are too high.
    """
    frame, middle, nothing = Frame(scenes.grids()[0], MODEL_PSF), (14.3, 17.6), (22.0, 27.0)
    objects = ((middle, (FLUX, 0.0, FLUX), 2.2),)
    noisy = [scenes.observe(objects, noise=NOISE, seed=seed) for seed in range(N_NOISES)]
    listed = ExtendedSource(position_px=middle), PointSource(position_px=nothing)
    results = deblend_many([Blend(tuple(o), listed, frame) for o in noisy], device=device)
    dark = np.array([[False, True, False], [True, True, True]])
    error = np.sqrt([np.einsum("css->sc", fluxes(r)[1]) for r in results])
    pulls, before = (
        np.array([each(r) for r in results])[:, dark] / error[:, dark]
        for each in (lambda r: fluxes(r)[0], bounded_fluxes)
    )
    # each is known to 1 / sqrt(32 noises of 4 fluxes) = 0.09
    assert abs(pulls.mean()) < 0.2 < before.mean() and 0.75 < pulls.std() < 1.25
    flags = np.array([catalogue(r)["flags"] for r in results])
    none = (np.array([bounded_fluxes(r) for r in results]) == 0).any(axis=2)
    np.testing.assert_array_equal((flags & Flag.ZERO_FLUX) > 0, none)


@pytest.mark.parametrize(("sigma", "left"), [(0.0, 0.0), (2.9, 2.9), (9.0, 1.0), (300.0, 0.03)])
def test_steps_that_noise_does_not_cause_are_not_taken(sigma, left):
    assert sigma * release_factor(np.array(sigma**2)) == pytest.approx(left)


@pytest.mark.parametrize("change", [[2.0, -1.0, 0.5], [12.0, -11.0, 0.5], [-3.0, -40.0, 2.0]])
def test_light_exchanged_within_errors_is_kept(change):
    """Two sources whose sum is known to a hundredth of their fluxes, and another one."""
    sigma, known = 10.0, 0.1
    exchange = np.array([1, -1, 0]) * sigma
    covariance = np.outer(exchange, exchange) + known**2 * np.eye(3)
    error = np.sqrt(np.diag(covariance))
    changes = np.array([change, np.zeros(3)]) * error
    found = within_errors(changes, np.array([covariance] * 2))
    assert (np.abs(found / error) <= 3 + 1e-9).all() and not found[1].any()
    if (np.abs(changes) <= 3 * error).all():
        np.testing.assert_array_equal(found, changes)
    elif abs(changes[0, :2].sum()) < 2 * sigma:
        assert found[0, :2].sum() == pytest.approx(changes[0, :2].sum(), abs=3 * known)
    assert found[0, 2] == changes[0, 2]


def test_chi2_is_that_where_a_components_light_is():
    """By A^2 times its image; both of two observations count, sky included."""
    seen, views, residuals, wanted = [], [], [], np.zeros((2, 2))
    rng = np.random.default_rng(3)
    spectra, sky = rng.random((2, 3)) + 0.5, rng.random(3)
    for part in (slice(0, 1), slice(1, 3)):
        n = part.stop - part.start
        low = np.array([[1, 0], [4, 3]])
        images = [rng.random((n, 3, 4)), rng.random((n, 4, 3))]
        rendered = ComponentImages((2, n, 8, 7), low, images)
        root, data = rng.random((n, 8, 7)), rng.normal(size=(n, 8, 7))
        views.append(SimpleNamespace(sqrt_weights=root, data=data))
        seen.append(rendered)
        whole = np.asarray(rendered)
        model = np.einsum("ic,icyx->cyx", spectra[:, part], whole) + sky[part, None, None]
        residuals.append(data - model)
        chi2 = root**2 * residuals[-1] ** 2
        light = spectra[:, part, None, None] ** 2 * whole * root**2
        wanted += [(light * chi2).sum((1, 2, 3)), light.sum((1, 2, 3))]
    scene = SimpleNamespace(channels=lambda: [slice(0, 1), slice(1, 3)])
    seen = RenderedModel(spectra, sky, None, tuple(seen), ())
    found = local_chi2(
        seen.observed, views, scene.channels(), spectra, seen.residuals(scene.channels(), views)
    )
    for a, b in zip(residuals, seen.residuals(scene.channels(), views), strict=True):
        np.testing.assert_allclose(a, b)
    np.testing.assert_allclose(found, wanted[0] / wanted[1])
