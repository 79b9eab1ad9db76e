"""Damping of the solver's steps: a bound on the Hessian, and bright sources that stay fitted."""

import numpy as np
import pytest
from helpers.scenes import GALAXIES, blend, fit
from helpers.solver import BOXES, changed, posed

from clresample import get_device
from clresample.deblending.settings import Settings
from clresample.paper.solver import curvature as module
from clresample.paper.solver.curvature import damping
from clresample.paper.solver.prior import SingleScalePrior


@pytest.mark.parametrize("prior", [SingleScalePrior(), None])
def test_damping_bounds_the_hessian_and_is_no_larger_than_it_must_be(prior, monkeypatch):
    monkeypatch.setattr(module, "NOISE_GRADIENT", np.inf)  # the bound alone
    scene, state = posed(get_device(), boxes=BOXES[:1])
    profile = scene.profile[0]
    columns = []
    for unit in np.eye(profile.size):
        image = module._spread(unit.reshape(profile.shape), profile, prior)
        (pull,) = module._pull(scene, state, [image], prior, rest=False)
        columns.append(pull.ravel())
    hessian = np.array(columns) + (prior is not None) * np.eye(profile.size)
    largest = np.linalg.eigvalsh((hessian + hessian.T) / 2)[-1]
    bound = damping(scene, state, prior)[0]
    assert largest <= bound <= 3 * largest


def test_damping_falls_where_the_start_is_far_from_the_data():
    scene, state = posed(get_device(), boxes=BOXES[:1])
    near = damping(scene, state, SingleScalePrior())[0]
    far = changed(scene, state, data=[d + 1e4 for d in scene.data])
    assert damping(*far, SingleScalePrior())[0] < 1e-3 * near


@pytest.mark.parametrize("flux", [10, 100])
def test_a_bright_source_that_the_start_fits_is_not_thrown_away(flux, device):
    """Undamped steps, 0.1 of the prior's scatter, take these to 40 and 2000 times their loss."""
    objects = [(p, flux * np.array(f), s) for p, f, s in GALAXIES]
    result = fit(blend(objects), device, settings=Settings(max_iter=60))
    assert result.status != "diverged"
    assert result.losses.max() < 3 * result.losses[0]
    assert result.losses[-1] <= result.losses[0]
