"""Runs of a batch: the best state kept, other updates, nothing through the host, nothing left."""

import gc

import numpy as np
import pytest
from helpers.buffers import Guards
from helpers.solver import BOXES, PRIOR, PSFS, changed, engine, posed, ragged

from clresample.deblending.solver.scene import signature_of
from clresample.device.device import Device
from clresample.device.tuning import Tuning
from clresample.paper.solver.constraints import Positivity, ProxChain
from clresample.paper.solver.engine import MAX_STEPS, Engine


def test_the_best_state_is_kept(build):
    """Of each scene by itself, at the start of a run; never one whose loss is no number."""
    pairs = ragged(build, np.float64)
    e = engine(pairs, build)
    assert np.isinf(e.best_losses()).all()
    e.run(5)
    for (_, state), kept in zip(pairs, e.states(kept=True), strict=True):
        np.testing.assert_array_equal(kept.spectra, state.spectra)  # that before the first step
    good, losses = e.states(), e.run(1)[0]
    np.testing.assert_array_equal(e.best_losses(), losses)
    spectra = np.concatenate([state.spectra for state in good])
    spectra[0] += 100  # of scene 0, whose loss rises
    spectra[3] = np.nan  # scene 1
    build.upload(spectra, e.buffers.spectra)
    with np.errstate(invalid="ignore"):
        e.run(2)
    kept = e.states(kept=True)
    for i in (0, 1):
        np.testing.assert_array_equal(kept[i].spectra, good[i].spectra)
        np.testing.assert_array_equal(kept[i].sky, good[i].sky)
        both = kept[i].morph + kept[i].latent, good[i].morph + good[i].latent
        for a, b in zip(*both, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(e.best_losses()[:2], losses[:2])
    assert np.isfinite(e.run(1)[0, 2])  # the others go on
    assert not np.array_equal(kept[2].morph[0], good[2].morph[0])
    best = e.best_losses()
    e.run(3)
    assert e.final_losses()[2] < e.best_losses()[2]  # which is that of a state that is kept
    assert best[2] < losses[2]


def test_a_worse_state_between_better_ones_is_not_kept(build):
    """Of the scene in the middle: no spectrum or sky level comes from beside it."""
    e = engine(ragged(build, np.float64), build)
    e.run(6)
    good, losses = e.states(), e.run(1)[0]
    spectra = np.concatenate([state.spectra for state in e.states()])
    spectra[3] += 100
    build.upload(spectra, e.buffers.spectra)
    e.run(2)
    best, kept = e.best_losses(), e.states(kept=True)
    assert best[1] == losses[1] and best[0] < losses[0] and best[2] < losses[2]
    np.testing.assert_array_equal(kept[1].spectra, good[1].spectra)
    np.testing.assert_array_equal(kept[1].sky, good[1].sky)


def test_nothing_is_written_beyond_the_buffers(build, monkeypatch):
    """Of boxes that fill their part of a buffer to its last element, as the last one does."""
    guards = Guards(monkeypatch)
    pairs = [posed(build, np.float32, boxes=((2, 3, 11, 14), (0, 0, 8, 6), (10, 7, 16, 16)))]
    for prior in (PRIOR, None):
        e = engine(pairs, build, np.float32, prior=prior)
        assert np.isfinite(e.run(3)).all()
    assert guards.overwritten() == []


def test_only_losses_come_back(device, monkeypatch):
    e = engine(ragged(device, np.float32), device, np.float32)
    e.run(1)

    def forbidden(*arguments, **options):
        raise AssertionError("a copy through the host")

    with monkeypatch.context() as patch:
        for name in ("upload", "download", "put", "get"):
            patch.setattr(Device, name, forbidden)
        for i in range(3):
            e.gradient(i)
            e.step()
    with pytest.raises(ValueError, match=f"n_steps is {MAX_STEPS + 1}"):
        e.run(MAX_STEPS + 1)


def test_a_new_box_size_builds_no_kernel(device, monkeypatch):
    """CPU runtimes build for each size of a group: the engine never lets them choose."""
    if not Tuning.of(device).row_loops:
        pytest.skip("kernels as for CPUs alone")
    sizes, launch = [], Device.launch

    def watched(self, kernel, size, local=None):
        sizes.append(local)
        launch(self, kernel, size, local)

    monkeypatch.setattr(Device, "launch", watched)
    for prior in (PRIOR, None):
        engine([posed(device, np.float32)], device, np.float32, prior=prior).run(2)
    assert sizes and None not in sizes


class Descent:
    """An update of the simplest kind, spectra alone, in NumPy: what `Engine` asks of one."""

    def __init__(self, buffers, gradient, states, *, chain, prior, step_sizes):
        self.buffers, self.n_steps = buffers, states[0].n_steps
        self.rate = step_sizes.spectrum

    def step(self):
        self.n_steps += 1
        device, b = self.buffers.device, self.buffers
        spectra = device.get(b.spectra) - self.rate * device.get(b.d_spectra)
        device.upload(np.maximum(spectra, 0), b.spectra)

    def memories(self):
        return [None] * len(self.buffers.scenes)


def test_another_update_takes_the_place_of_amsgrad(device):
    """Plain descent to small enough steps: the loss only falls, and the state comes back."""
    scene, state = posed(device, np.float32, fit_sky=False)
    settings = type("Steps", (), {"spectrum": 1e-4})
    e = Engine(
        [scene], [state], device, np.float32, chain=ProxChain(Positivity()), prior=None,
        step_sizes=settings, update=Descent,
    )  # fmt: skip
    losses = e.run(8)[:, 0]
    assert (np.diff(losses) < 0).all()
    (now,) = e.states()
    assert now.n_steps == e.n_steps == 8 and now.memory is None
    assert not np.array_equal(now.spectra, state.spectra)
    np.testing.assert_array_equal(now.morph[0], state.morph[0].astype(np.float32))


def test_signatures_tell_what_can_share_a_batch(device):
    def key(scene):
        return signature_of(scene.shape, scene.fit_sky, scene.ops, scene.ties)

    scene, state = posed(device)
    assert key(scene) == key(posed(device, boxes=BOXES, seed=9, psfs=PSFS)[0])
    for other in (
        {"shape": (30, 37)},
        {"fit_sky": False},
        {"ops": scene.ops[::-1]},
        {"ops": scene.ops[:1]},
    ):
        assert key(changed(scene, state, **other)[0]) != key(scene)


@pytest.mark.counts_memory
def test_engines_leave_nothing_on_the_device(device):
    pairs = ragged(device, np.float32)
    held = []
    for _ in range(6):
        e = engine(pairs, device, np.float32)
        e.run(2)
        del e
        gc.collect()
        held.append(device.in_use)
    assert held[1:] == held[:1] * 5
