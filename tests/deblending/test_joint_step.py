"""Newton's step along what overlapping sources exchange: transposes, the fall of the loss, ends."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.learned import Source
from helpers.scenes import GALAXIES, blend

from clresample.deblending import iterate as loop
from clresample.deblending.blend import Blend
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.posterior.joint_step import JointNewtonStep, make_joint_step
from clresample.deblending.settings import Settings
from clresample.deblending.solver.multiscale import lbfgs_control
from clresample.sky.observation import Observation

# Two galaxies of alike colours, each in the other's light, that L-BFGS tells apart slowly.
CLOSE = (((14.0, 14.5), (60, 50, 80), 2.4), ((16.0, 19.0), (50, 42, 70), 2.0))


def started(device, *objects, **given):
    """Fits of a blend for each of `objects`, or of Blends, float64 where the device has it."""
    dtype = np.float64 if device.has_fp64 else np.float32
    settings = Settings(**given)
    blends = [some if isinstance(some, Blend) else blend(some) for some in objects]
    fits = [Fit(b, settings, device, np.dtype(dtype), pad=1) for b in blends]
    start_fits(fits)
    return loop.LbfgsRun(fits, fits[0].settings, device, dtype)


def ended(running):
    """The same, once all fits have stopped."""
    while running.live.any() and running.n_steps < running.settings.max_iter:
        running.run()
        running = running.repacked() if running.live.any() else running
    return running


@pytest.fixture(scope="module")
def near(device):
    """Two close galaxies after a few rounds of L-BFGS alone, and their JointNewtonStep."""
    running = started(device, CLOSE)
    for _ in range(6):
        running.engine.round()
    return running, joint_step(running)


def joint_step(running, i=0):
    engine, which = running.engine, np.arange(len(running.fits)) == i
    given = engine.scenes[i], engine.states()[i], engine.findings(which)[i]
    return make_joint_step(running.fits[i], *given)


def test_slopes_are_the_transpose_of_changes(near):
    rng = np.random.default_rng(0)
    for moves in near[1].moves:
        x = rng.normal(size=len(moves.weights))
        changes = moves.structure(x)
        slopes = [rng.normal(size=part.shape) for part in changes]
        wanted = sum((a * b).sum() for a, b in zip(changes, slopes, strict=True))
        assert x @ moves.slopes(slopes) == pytest.approx(wanted, rel=1e-9)


def test_changes_scatter_by_1_under_the_prior(near):
    """1/2 sum dz^2 / alpha^2 is 1/2 |x|^2, but for what edges of boxes and coarse grids take."""
    rng = np.random.default_rng(1)
    for moves in near[1].moves:
        x = rng.normal(size=len(moves.weights))
        parts = zip(moves.structure(x), moves.variance, strict=True)
        assert sum((z**2).sum() / v for z, v in parts) == pytest.approx(x @ x, rel=0.1)


def test_the_matrix_holds_what_changes_do_to_the_data(near, device):
    """Its part of one galaxy beside products of images rendered whole, changes formed in NumPy."""
    running, found = near
    scene, fit = running.engine.scenes[0], running.fits[0]
    moves, (y, x) = found.moves[0], scene.origin[0]
    source, state = Source(scene.profile[0], fit.settings.prior), running.engine.states()[0]
    rng, pair = np.random.default_rng(2), []
    for _ in range(2):
        c = rng.normal(size=len(moves.weights))
        z = [1e-4 * part for part in moves.structure(c)]
        image = np.zeros((1, *scene.shape))
        box = slice(y, y + source.profile.shape[0]), slice(x, x + source.profile.shape[1])
        # nothing changes where the morphology is held at 0
        change = 1e4 * (source.morph(z) - source.profile)
        image[0, *box] = np.where(state.morph[0] > 0, change, 0)
        seen = []
        for view, part in zip(fit.views, scene.channels(), strict=True):
            bands = np.repeat(image, view.op.shape_in[0], 0).astype(view.op.dtype)
            light = view.op.forward(bands) * view.sqrt_weights
            seen.append((state.spectra[0][part][:, None, None] * light).ravel())
        pair.append((c, np.concatenate(seen)))
    k = len(moves.weights)
    block = found._matrix.block(0, 0)[:k, :k] - np.eye(k)
    (c, u), (d, v) = pair
    size = np.linalg.norm(u) * np.linalg.norm(v)
    assert c @ block @ d == pytest.approx(u @ v, abs=0.03 * size)
    assert c @ block @ c == pytest.approx(u @ u, rel=0.03)


def test_the_loss_falls_by_what_is_expected(near):
    running, found = near
    engine = running.engine
    (slopes,) = engine.slopes(np.ones(1, bool))
    *step, gain = found.step(slopes)
    before = float(engine.progress.loss[0])
    engine.step({0: step})
    assert engine.round()[0]
    assert gain > 0.1
    assert before - engine.progress.loss[0] == pytest.approx(gain, rel=0.2)


def test_spectra_at_their_bound_stay(near):
    running, found = near
    (slopes,) = running.engine.slopes(np.ones(1, bool))
    slopes.at_bound[1, 2] = True
    _, spectra, _, gain = found.step(slopes)
    assert spectra[1, 2] == 0 and np.abs(spectra).max() > 0
    slopes.at_bound[1, 2] = False
    assert found.step(slopes)[-1] >= gain


def test_what_the_data_do_not_see_stays(device):
    """The second observation has no weight in its first channel."""
    sharp, o = blend(CLOSE).observations
    weights = np.broadcast_to(o.weights, o.data.shape) * np.array([0, 1])[:, None, None]
    o = Observation(o.data, o.psf, o.grid, weights=weights, channels=o.channels, name=o.name)
    running = started(device, replace(blend(CLOSE), observations=(sharp, o)), loss_tol=2.0)
    for _ in range(30):
        running.engine.round()
    (slopes,) = running.engine.slopes(np.ones(1, bool))
    slopes.spectra[:, 1] = 1e-3  # what rounding may leave
    _, spectra, _, gain = joint_step(running).step(slopes)
    assert not spectra[:, 1].any() and gain < 10


def test_fits_end_nearer_to_their_minimum(device, monkeypatch):
    """Without directions of exchange, which do the same after 40 rounds."""
    monkeypatch.setattr(lbfgs_control, "FIRST_EXCHANGE_ROUND", 10**6)
    end = ended(started(device, CLOSE, loss_tol=0.001, max_iter=400)).fits[0].losses[-1]
    with_steps = ended(started(device, CLOSE, loss_tol=0.2)).fits[0].losses[-1]
    monkeypatch.setattr(loop, "make_joint_step", lambda *given: None)
    without = ended(started(device, CLOSE, loss_tol=0.2)).fits[0].losses[-1]
    assert with_steps - end < 0.1
    assert without - end > with_steps - end


def test_fits_go_on_without_a_matrix_that_is_not_positive_definite(device, monkeypatch):
    def broken(self, slopes):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(JointNewtonStep, "step", broken)
    running = ended(started(device, CLOSE))
    assert running.fits[0].status == "converged" and running.joint_steps == [None]


def test_galaxies_apart_exchange_nothing(device):
    far = [(p, f, 1.0) for p, f in (((8.0, 8.0), (60, 50, 80)), ((22.0, 28.0), (50, 42, 70)))]
    assert joint_step(started(device, far)) is None


def test_a_step_of_one_scene_leaves_the_others(device):
    """Their next trials are what they were."""
    running = started(device, CLOSE, GALAXIES)
    engine = running.engine
    for _ in range(6):
        engine.round()
    low, high = engine.vectors.parts()[1, 0]
    before = device.get(engine.vectors.d)[low:high]
    (slopes, _) = engine.slopes(np.array([True, False]))
    *step, _ = joint_step(running).step(slopes)
    engine.step({0: step})
    np.testing.assert_array_equal(device.get(engine.vectors.d)[low:high], before)
    own = device.get(engine.vectors.x_new) - device.get(engine.vectors.x)
    split = engine.vectors.latents.unpack(own)
    for s, scales in enumerate(step[0]):
        for j, part in enumerate(scales):
            size = np.abs(part).max()
            np.testing.assert_allclose(split[s][j], part, atol=1e-5 * size)
