"""Single formulas of the fit against their values: slips in them hardly change where a fit ends."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import blend, fit, frame, observe
from helpers.solver import BOXES, changed, posed

from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.profiles import SIZE_ARCSEC, components_of
from clresample.deblending.view import SceneGeometry, whitened_view
from clresample.paper import run as paper_run
from clresample.paper.settings import PaperSettings
from clresample.paper.solver import curvature as curvature_module
from clresample.paper.solver.amsgrad import AMSGrad
from clresample.paper.solver.curvature import damping
from clresample.paper.solver.prior import SingleScalePrior
from clresample.paper.solver.scene import SPECTRUM_PART, begin_steps
from clresample.sky.sources import ExtendedSource


def seen(device, dtype=np.float32):
    home = SceneGeometry(frame(), frame(), np.zeros((0, 2)), 0.0)
    return [whitened_view(home, o, 1, device, dtype, private=True) for o in observe()]


def test_noise_of_a_model_pixel(device):
    """Of an observed pixel with four times the area: half of its noise, at the same exposure."""
    sharp, coarse = seen(device)
    np.testing.assert_allclose(sharp.pixel_noise, [1.0])
    np.testing.assert_allclose(coarse.pixel_noise, [0.5, 0.5])


def test_the_prior_bounds_the_curvature_of_faint_spectra(device):
    scene, state = posed(device, boxes=BOXES[:1])
    faint = replace(state, spectra=1e-12 * state.spectra)
    assert damping(scene, faint, SingleScalePrior())[0] == pytest.approx(1.0)


def test_damping_falls_with_the_square_of_the_slope(device, monkeypatch):
    """Twice as far from the data, so far that only this counts: a quarter."""
    scene, state = posed(device, boxes=BOXES[:1])
    found = []
    for level in (1e4, 2e4):
        far = changed(scene, state, data=[d + level for d in scene.data])
        found.append(damping(*far, SingleScalePrior())[0])
    assert found[0] / found[1] == pytest.approx(4, rel=0.01)
    assert curvature_module.NOISE_GRADIENT == 0.7
    monkeypatch.setattr(curvature_module, "NOISE_GRADIENT", 1.4)
    assert damping(*far, SingleScalePrior())[0] == pytest.approx(4 * found[1])


def test_the_sky_is_part_of_the_model_that_damps(device):
    scene, state = posed(device, boxes=BOXES[:1])
    level = 1e4 * np.ones_like(state.sky)
    bright = [d + level[part, None, None] for part, d in zip(scene.channels(), scene.data)]
    with_sky = damping(
        replace(scene, data=bright), replace(state, sky=state.sky + level), SingleScalePrior()
    )
    np.testing.assert_allclose(with_sky, damping(scene, state, SingleScalePrior()), rtol=1e-3)


def test_scale_of_the_spectra_steps(device):
    """A flux's error, and 2 % of the flux."""
    f = Fit(blend(), PaperSettings(), device, np.float32, pad=1)
    start_fits([f])
    scene, _ = begin_steps(f.scene, f.state, None)
    error = 1 / np.sqrt(f.scene.spectrum_curvature)
    assert SPECTRUM_PART == 0.02 and (f.state.spectra > 20 * error).any()
    np.testing.assert_allclose(scene.step_scale, error + 0.02 * f.state.spectra, rtol=1e-12)


def test_sizes_of_several_components_lie_about_that_of_one():
    (one,) = components_of(ExtendedSource(position_px=(3, 3)), frame())
    two = components_of(ExtendedSource(position_px=(3, 3), n_components=2), frame())
    three = components_of(ExtendedSource(position_px=(3, 3), n_components=3), frame())
    sizes = [[c.mean[0] - one.mean[0] for c in several] for several in (two, three)]
    assert one.mean[0] == pytest.approx(np.log(SIZE_ARCSEC / 0.1))
    np.testing.assert_allclose(sorted(sizes[0]), (-0.5, 0.5), atol=1e-12)
    np.testing.assert_allclose(sorted(sizes[1]), (-1, 0, 1), atol=1e-12)


def test_a_fit_that_worsens_after_a_new_batch_ends_at_its_best(device, monkeypatch):
    """The best state before its boxes were resized, which makes a new batch, is remembered."""
    step, made = AMSGrad.step, []

    def worse(self, *given):
        step(self, *given)
        if self.n_steps > 5:  # ever further from the data
            spectra = self.buffers.spectra
            values = self.buffers.device.get(spectra) * np.float32(1.03)
            self.buffers.device.upload(values, spectra)

    def resized(scene, state, *_):
        made.append(scene)
        return replace(scene), state

    monkeypatch.setattr(AMSGrad, "step", worse)
    monkeypatch.setattr(paper_run, "RESIZE_ITERATIONS", 10)
    monkeypatch.setattr(paper_run, "resize_boxes", resized)
    settings = PaperSettings(prior=SingleScalePrior(), max_iter=20, rel_tol=0)
    result = fit(blend(), device, settings=settings)
    best = result.losses[:7].min()
    assert made and result.losses[10] > 1.05 * best
    assert result.losses[-1] <= best * (1 + 1e-6)
