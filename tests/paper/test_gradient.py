"""Loss and gradients on the device against references, on builds for CPUs and for GPUs.

Slopes are compared with finite differences.
"""

import numpy as np
import pytest
from helpers.solver import (
    PRIOR,
    changed,
    close,
    engine,
    every_type,
    posed,
    ragged,
    references,
)

from clresample.paper.solver import reference as ref
from clresample.paper.solver.amsgrad import BETA1
from clresample.paper.solver.engine import AmsgradLoss


@pytest.mark.parametrize("depth", [0, 1, 2, None])
@every_type
def test_kernels_are_their_references(build, dtype, depth):
    """Whatever the stage at which spectra are applied."""
    pairs = ragged(build, dtype)
    e, found = engine(pairs, build, dtype), references(pairs, PRIOR)
    for r in found:
        r.gradient()
    e._gradient = AmsgradLoss(e.buffers, with_prior=True, depth=depth)
    e.gradient(3)
    close(build.get(e.losses)[3], [r.loss for r in found], dtype)
    close(build.get(e.buffers.d_spectra), np.concatenate([r.d_spectra for r in found]), dtype)
    d_morph = e.buffers.host_boxes.unpack(build.get(e.buffers.d_morph))
    wanted = [d for r in found for d in r.d_morph]
    free = ~np.concatenate([scene.fixed for scene, _ in pairs])
    for i in range(len(wanted)):
        close(d_morph[i], wanted[i] if free[i] else 0 * wanted[i], dtype)
    pull = np.add.reduceat(build.get(e._gradient.rows_pull), e._gradient.rows[:-1], axis=1)
    close(pull, [r.pull for r in found], dtype)


def losses_at(device, pair, prior=PRIOR):
    return engine([pair], device, prior=prior).final_losses()[0]


def formed(pair, latent):
    """The scene at another z."""
    scene, _ = pair
    morph = [
        ref.form(p, PRIOR.strength * np.sqrt(p), z, PRIOR.taps)
        for p, z in zip(scene.profile, latent, strict=True)
    ]
    return changed(*pair, latent=latent, morph=morph)


def moved(pair, what, direction, step):
    now = getattr(pair[1], what)
    if what in ("spectra", "sky"):
        return changed(*pair, **{what: now + step * direction})
    new = [x + step * d for x, d in zip(now, direction, strict=True)]
    return formed(pair, new) if what == "latent" else changed(*pair, morph=new)


@pytest.mark.parametrize("what", ["latent", "morph", "spectra", "sky"])
def test_gradients_are_finite_differences(device, what):
    """Along random directions. The loss is quadratic in each kind: no step is too large."""
    pair = posed(device)
    prior = PRIOR if what == "latent" else None
    pair = formed(pair, pair[1].latent)
    assert min(m.min() for m in pair[1].morph) > 0
    e = engine([pair], device, prior=prior)
    e.gradient()
    pull = device.get(e._gradient.rows_pull)
    e.step()  # a first moment is (1 - BETA1) of the gradient
    memory = e.states()[0].memory
    gradient = {
        "latent": [m / (1 - BETA1) for m in memory.morph[0]],
        "morph": [m / (1 - BETA1) for m in memory.morph[0]],
        "spectra": memory.spectra[0] / (1 - BETA1) / pair[0].step_scale,
        "sky": np.add.reduceat(pull[0], e._gradient.rows[:-1]),
    }[what]
    rng = np.random.default_rng(4)
    for _ in range(3):
        direction = [rng.normal(size=np.shape(g)) for g in gradient]
        if what in ("spectra", "sky"):
            direction = np.array(direction)
        sides = [losses_at(device, moved(pair, what, direction, t), prior) for t in (0.1, -0.1)]
        slope = sum((g * d).sum() for g, d in zip(gradient, direction, strict=True))
        assert (sides[0] - sides[1]) / 0.2 == pytest.approx(slope, rel=1e-9)
