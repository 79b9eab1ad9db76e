"""Components of several scenes rendered in observations, and their spectra.

Each scene is compared with itself alone, in whole frames of float64.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import BRIGHT, SHAPE, frame, observe, sources
from helpers.start import least_squares, profiles, rendered, views

from clresample.deblending.linear.linearised_scenes import linearise
from clresample.deblending.linear.render_planner import SIZE_PX
from clresample.deblending.linear.slot_observation import smoothed_light
from clresample.deblending.settings import Settings
from clresample.deblending.start import profile_start as start_module
from clresample.deblending.start.profile_start import StartInput
from clresample.resampling.plan import Precision

SKY = (0.3, -0.2, 0.1)
# Boxes end where profiles have fallen to 1e-6 of their peaks.
CLOSE = 2e-3


class Scenes:
    """Three scenes of two, one and two galaxies, seen with their expected profiles; the last one's
    second observation is turned by another angle, so that windows in it have other sizes."""

    def __init__(self, device, fit_sky):
        objects = BRIGHT, BRIGHT[1:], BRIGHT[::-1]
        self.views = [
            views(device, observe(some, seed=i, angle=angle, sky=SKY if fit_sky else (0, 0, 0)))
            for i, (some, angle) in enumerate(zip(objects, (25, 25, 10), strict=True))
        ]
        if fit_sky:
            for i, error in enumerate((0.03, np.inf, np.inf)):
                self.views[i] = [
                    v.expecting_sky(np.full(len(v.data), 0.2), error) for v in self.views[i]
                ]
        self.fit_sky, found = fit_sky, []
        for some, own in zip(objects, self.views, strict=True):
            catalogue = sources(some)
            places = np.array([s.position_px for s in catalogue], float)
            found.append(StartInput(frame(), list(catalogue), places, own))
        self.patches = found
        self.sources, components = start_module._components(found)
        precision = Precision.of(np.float64)
        self.looking = linearise(self.views, components, precision, 0.0, fit_sky=fit_sky)
        self.thetas = [c.shape.mean for c in components]

    def look(self, scenes, brightness=1e6):
        """In boxes that reach as far as sources of this brightness are seen."""
        n = len(self.looking.components)
        self.looking.render(scenes, self.thetas, np.full(n, brightness), slopes=False)

    def units(self, b):
        """Whitened images of scene b's components over the whole frame, one array a view."""
        pairs = zip(self.looking.components, self.thetas, strict=True)
        images = [c.shape.draw(t, c.position)[0] for c, t in pairs if c.scene == b]
        return [rendered(view, np.array(images)) for view in self.views[b]]

    def model(self, b, spectra, sky):
        """Whitened model and data (C pixels) of scene b, each an array a view."""
        found, channel = [], 0
        for unit, view in zip(self.units(b), self.views[b], strict=True):
            for c in range(unit.shape[1]):
                root = view.sqrt_weights[c].ravel()
                model = spectra[:, channel] @ unit[:, c] + sky[channel] * root
                found.append((unit[:, c], model, view.data[c].ravel() * root))
                channel += 1
        return found


@pytest.mark.parametrize("fit_sky", [False, True])
def test_each_scene_has_its_own_least_squares(device, fit_sky):
    """Of those that are looked at: the others keep what they had."""
    s = Scenes(device, fit_sky)
    looking = s.looking
    for scenes in ([0, 1, 2], [2, 1]):
        looking.spectra[:], looking.sky[:] = 0, 0
        looking.spectra[looking.scene == 0] = 7.0
        s.look(scenes)
        looking.solve(0.0)
        for row, b in enumerate(scenes):
            spectra, sky, covariance = least_squares(s.units(b), s.views[b], sky=fit_sky)
            error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
            own = looking.scene == b
            assert np.abs((looking.spectra[own] - spectra) / error).max() < 0.1
            np.testing.assert_allclose(looking.sky[b], sky, atol=2e-3)
            scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            found = looking.covariance(row) / scale[:, :, None] / scale[:, None]
            wanted = covariance / scale[:, :, None] / scale[:, None]
            np.testing.assert_allclose(found, wanted, atol=10 * CLOSE)
    assert (looking.spectra[looking.scene == 0] == 7).all()


@pytest.mark.parametrize("fit_sky", [False, True])
def test_what_is_compared_and_how_clearly_each_is_seen(device, fit_sky):
    """chi2 of any solution, weights with a part of the light in the noise; and u . d / |u|."""
    s = Scenes(device, fit_sky)
    looking, scenes = s.looking, np.array([2, 0])
    s.look(scenes)
    rng = np.random.default_rng(0)
    looking.spectra[:] = rng.uniform(10, 60, looking.spectra.shape)
    looking.sky[:] = rng.uniform(-1, 1, looking.sky.shape) * fit_sky
    for error in (0.0, 0.05):
        found = looking.compute_residuals(error)
        for row, b in enumerate(scenes):
            wanted = 0.0
            lights = [np.array(smoothed_light(v)) for v in s.views[b]]
            roots = [root.ravel() for v in s.views[b] for root in v.sqrt_weights]
            lights = [light.ravel() for one in lights for light in one]
            of_all = s.model(b, looking.spectra[looking.scene == b], looking.sky[b])
            levels = looking.sky[b]
            for (_, model, data), light, root, level in zip(
                of_all, lights, roots, levels, strict=True
            ):
                part = error * (light - level * root)
                wanted += ((data - model) ** 2 / (1 + part**2)).sum()
            if fit_sky and not b:
                wanted += (levels**2 / 0.03**2).sum()
            assert found[row] == pytest.approx(wanted, rel=CLOSE)
    seen = looking.signal_to_noise(looking.sky)
    assert not seen[looking.scene == 1].any()
    for b in scenes:
        own = np.flatnonzero(looking.scene == b)
        nothing = np.zeros((len(own), 3))
        for c, (unit, model, data) in enumerate(s.model(b, nothing, looking.sky[b])):
            wanted = unit @ (data - model) / np.linalg.norm(unit, axis=1)
            np.testing.assert_allclose(seen[own, c], wanted, rtol=CLOSE, atol=0.05)


def test_the_present_solution_is_listed_by_scene(device):
    s = Scenes(device, True)
    s.look([2, 1])
    looking = s.looking
    looking.spectra[:] = np.arange(15).reshape(5, 3)
    looking.sky[:] = -np.arange(9).reshape(3, 3)
    found = looking.solution()
    assert found.shape == (2, 3, 3)
    np.testing.assert_array_equal(found[0, :, :2], looking.spectra[3:5].T)
    np.testing.assert_array_equal(found[1, :, 0], looking.spectra[2])
    assert not found[1, :, 1].any()
    np.testing.assert_array_equal(found[..., 2], looking.sky[[2, 1]])


def test_the_same_observations_can_show_other_components(device):
    s = Scenes(device, True)
    chosen = s.looking.components[2:3]
    other = s.looking.with_components(chosen)
    assert other.sights is s.looking.sights and other.fit_sky and other.n_scenes == 3
    assert other.spectra.shape == (1, 3) and other.components is chosen


@pytest.mark.parametrize("fit_sky", [False, True])
def test_spectra_and_power_of_a_start_follow_the_weights(device, fit_sky):
    """Those of profiles with maximum 1; under other weights the profiles stay."""
    s = Scenes(device, fit_sky)
    points = start_module.fit_start_profiles(s.patches[:2], fit_sky=fit_sky)
    patch, point = s.patches[0], points[0]
    assert start_module.with_psf_error_weights(patch, point, Settings()) == (
        patch.views,
        point,
    )  # no stars
    rng = np.random.default_rng(1)
    half = [replace(view, sqrt_weights=w * (0.2 + rng.random(w.shape)))
            for view in patch.views for w in [view.sqrt_weights]]  # fmt: skip
    again = start_module._solved_again(replace(patch, views=half), point, fit_sky)
    assert again.shapes is point.shapes and again.thetas is point.thetas
    alone = points[1]
    for found, own in ((point, patch.views), (again, half), (alone, s.views[1])):
        units = [rendered(view, profiles(found, SHAPE)) for view in own]
        spectra, sky, covariance = least_squares(units, own, sky=fit_sky)
        error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
        assert np.abs((found.spectra - spectra) / error).max() < 0.2
        np.testing.assert_allclose(found.sky, sky, atol=5e-3)
        power = np.concatenate([np.square(unit).sum(2) for unit in units], axis=1)
        np.testing.assert_allclose(found.spectrum_curvature, power, rtol=5 * CLOSE)
        assert [len(found), len(found.peaks)] == [len(found.spectra)] * 2
    assert np.abs(again.spectra / point.spectra - 1).max() > 1e-3


def test_windows_of_scenes_seen_at_other_angles_are_of_one_size(device):
    """That of the largest, rounded up; each holds what its own light reaches."""
    s = Scenes(device, False)
    s.look([0, 1, 2], brightness=1.0)
    found = s.looking.sights[1].aim._renderers.values()
    assert found
    for windows in found:
        (size,) = {tuple(plan.mapping.shape_out) for plan in windows.renderer.plans}
        assert len(windows.renderer.plans) == 2
        for n, own in zip(size, windows.own.max(0), strict=True):
            assert n % SIZE_PX == 0 and n - SIZE_PX < own <= n
    images = [s.looking.device.get(sight.seen) for sight in s.looking.sights]
    s.look([2], brightness=1.0)
    for sight, before in zip(s.looking.sights, images, strict=True):
        alone = s.looking.device.get(sight.seen)
        assert np.isclose(alone.sum(), before[-len(alone) :].sum(), rtol=1e-6)
