"""Loss and gradients on the device: kernels as their references, slopes as finite differences, the
scene as operators under the dot test; on CPUs' builds and on GPUs'."""

import numpy as np
import pytest
from helpers.solver import (
    BOXES,
    PRIOR,
    changed,
    close,
    engine,
    every_type,
    posed,
    ragged,
    references,
)

from clresample.deblending.solver import reference as ref
from clresample.deblending.solver.amsgrad import BETA1
from clresample.deblending.solver.operators import MorphologyOperator, SpectraOperator
from clresample.deblending.solver.scene_model import compose
from clresample.testing import check_adjoint, dense


@every_type
def test_kernels_are_their_references(build, dtype):
    pairs = ragged(build, dtype)
    e, found = engine(pairs, build, dtype), references(pairs, PRIOR)
    for r in found:
        r.gradient()
    e.gradient(3)
    observed = e._gradient.observations
    close(build.get(e.losses)[3], [r.loss for r in found], dtype)
    models = [build.get(o.model) for o in observed]
    close(np.concatenate(models, axis=1), [r.g for r in found], dtype)
    close(build.get(e.buffers.d_spectra), np.concatenate([r.d_spectra for r in found]), dtype)
    d_morph = e.buffers.host_boxes.unpack(build.get(e.buffers.d_morph))
    wanted = [d for r in found for d in r.d_morph]
    free = ~np.concatenate([scene.fixed for scene, _ in pairs])
    for i in range(len(wanted)):
        close(d_morph[i], wanted[i] if free[i] else 0 * wanted[i], dtype)
    pull = np.add.reduceat(build.get(e._gradient.rows_pull), e._gradient.rows[:-1], axis=1)
    close(pull, [r.pull for r in found], dtype)


OPERATORS = pytest.mark.parametrize("kind", [MorphologyOperator, SpectraOperator])


@OPERATORS
@every_type
def test_the_scene_composes_models(build, kind, dtype):
    """Of each observation's bands, from what the buffers hold."""
    pairs = ragged(build, dtype)
    b = engine(pairs, build, dtype).buffers
    x = build.get(b.morph if kind is MorphologyOperator else b.spectra)
    for i, part in enumerate((slice(0, 1), slice(1, 3))):
        model = kind(b, i).forward(x)
        for found, (scene, state) in zip(model, pairs, strict=True):
            wanted = compose(scene.shape, scene.origin, state.morph, state.spectra)
            close(found, wanted[part], dtype)


@OPERATORS
@every_type
def test_the_scenes_adjoints_pass_the_dot_test(build, kind, dtype):
    b = engine(ragged(build, dtype), build, dtype).buffers
    for i in (0, 1):
        check_adjoint(kind(b, i), np.random.default_rng(i))


class Forgetful(MorphologyOperator):
    """Leaves out the fixed source, as the solver's own launch may: no adjoint any more."""

    def _adjoint(self, y, out):
        self.device.copy(self._zeros, out)
        self.gather(y, out, self.buffers.free)


class Doubled(MorphologyOperator):
    """Adds its answer twice."""

    def _adjoint(self, y, out):
        super()._adjoint(y, out)
        self.gather(y, out, self.buffers.boxes.everyone, add=True)


class Stale(SpectraOperator):
    """Takes morphologies of before."""

    def __init__(self, buffers, i_observation):
        super().__init__(buffers, i_observation)
        self._gather.bind(morph=buffers.profile)


class Shifted(SpectraOperator):
    """Gathers from the channel before its own."""

    def __init__(self, buffers, i_observation):
        super().__init__(buffers, i_observation)
        self._gather.bind(channel=self.channel - 1)


@pytest.mark.parametrize("kind", [Forgetful, Doubled, Stale, Shifted])
def test_the_dot_test_finds_a_broken_adjoint(device, kind):
    b = engine(ragged(device, np.float32), device, np.float32).buffers
    with pytest.raises(AssertionError, match=r"of \|Ax\|\|y\|"):
        check_adjoint(kind(b, 1), np.random.default_rng(0))


def test_operators_are_matrices_of_the_scene(device):
    """Of one small scene, column by column; a batch of items is refused."""
    scene, state = posed(device, np.float32, boxes=BOXES[3:4])
    b = engine([(scene, state)], device, np.float32).buffers
    op = SpectraOperator(b, 1)
    columns = dense(op).reshape(2, *scene.shape, 3)
    y, x = BOXES[3][:2]
    np.testing.assert_allclose(columns[:, y, x], state.morph[0][0, 0] * np.eye(3)[1:], rtol=1e-6)
    assert np.count_nonzero(columns) == 2
    with pytest.raises(ValueError, match="batch of 2 items is given; SpectraOperator takes one"):
        op.forward(np.zeros((2, 1, 3)))


def losses_at(device, pair, prior=PRIOR):
    return engine([pair], device, prior=prior).final_losses()[0]


def formed(pair, latent):
    """The scene at another z."""
    scene, _ = pair
    morph = [
        ref.form(p, PRIOR.alpha * np.sqrt(p), z, PRIOR.taps)
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
        "spectra": memory.spectra[0] / (1 - BETA1) / pair[0].scale,
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
