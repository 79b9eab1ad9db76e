"""Fits under the prior that learns: what they end with, when they end, one and many."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.scenes import BRIGHT, GALAXIES, blend, chi2, truth
from helpers.solver import close, posed, ragged

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.settings import Settings
from clresample.deblending.solver.multiscale import lbfgs_control, strengths
from clresample.deblending.solver.multiscale.engine import MultiscaleEngine
from clresample.deblending.solver.multiscale.exchange_direction import ExchangeDirection
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.sky.sources import PointSource

SHORT = Settings(max_iter=12, loss_tol=0)


def made(device, pairs, dtype=np.float64, loss_tol=1.0):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    pairs = [(with_power(scene), state) for scene, state in pairs]
    some, states = map(list, zip(*pairs, strict=True))
    return MultiscaleEngine(some, states, device, dtype, MultiscalePrior(), loss_tol)


def with_power(scene):
    """sum w (R p)^2 of every source, one by one."""
    power = []
    for (y, x), p in zip(scene.origin, scene.profile, strict=True):
        image = np.zeros((1, *scene.shape))
        image[0, y : y + p.shape[0], x : x + p.shape[1]] = p
        row = []
        for op, w in zip(scene.ops, scene.weights, strict=True):
            seen = op.forward(np.repeat(image, op.shape_in[0], 0).astype(op.dtype))
            row += (w * seen.astype(float) ** 2).sum((1, 2)).tolist()
        power.append(row)
    return replace(scene, spectrum_curvature=np.array(power))


def test_gradients_are_finite_differences(build):
    """Of structure, spectra and sky, with the prior's part, where no bound is near."""
    scene, state = posed(build, fixed=(1,))
    e = made(build, [(scene, state)])
    v, rng = e.vectors, np.random.default_rng(0)
    x0 = build.get(v.x)
    x0[: v.latents.size] = 0.003 * rng.normal(size=v.latents.size)
    x0[-v.n_sky - v.n_spectra :] += 1
    directions = np.zeros((3, v.size))
    latents = v.latents.pack([[np.ones(n) for n in shapes] for shapes in v.latents.shape])
    directions[0, : len(latents)] = latents * rng.normal(size=len(latents))
    directions[1, v.latents.size : -v.n_sky] = rng.normal(size=v.n_spectra)
    directions[2, -v.n_sky :] = rng.normal(size=v.n_sky)

    def loss_at(x):
        build.upload(x, v.x_new)
        return e._evaluate()[2][0]

    x0[: len(latents)] *= latents
    loss_at(x0)
    gradient = build.get(v.g_new)
    for d, step in zip(directions, (1e-4, 0.1, 0.1), strict=True):
        slope = (loss_at(x0 + step * d) - loss_at(x0 - step * d)) / (2 * step)
        assert slope == pytest.approx(gradient @ d, rel=1e-6)


def test_losses_fall_and_scenes_are_as_if_alone(build):
    """Of three scenes of other sizes; rejected trials of one do not touch the others."""
    pairs = ragged(build, np.float64)
    together, alone = made(build, pairs), [made(build, [pair]) for pair in pairs]
    losses = []
    for _ in range(25):
        together.round()
        losses.append(together.progress.loss.copy())
        for i, e in enumerate(alone):
            e.round()
            assert together.progress.loss[i] == pytest.approx(e.progress.loss[0], rel=1e-6)
    early = np.array(losses[:15])  # before strengths change what a loss is
    assert (np.diff(early, axis=0) <= 0).all() and (early[-1] < early[0]).all()
    for i, state in enumerate(together.states()):
        (other,) = alone[i].states()
        close(state.spectra, other.spectra, np.float32)
        assert min(m.min() for m in state.morph) >= 0


def a_direction(scene, state, evidence, strengths):
    """Of the first source with coefficients, in place of those found."""
    i = np.flatnonzero(~scene.fixed)[0]
    values = 0.1 * np.ones(sum(z.size for z in state.learned.structure[i]))
    return [ExchangeDirection(i, np.arange(len(values)), values, 1e-2 * state.spectra)]


@pytest.mark.parametrize("exchanging", [False, True])
def test_a_part_of_a_batch_goes_on_as_if_nothing_had_happened(build, monkeypatch, exchanging):
    if exchanging:
        monkeypatch.setattr(lbfgs_control, "FIRST_EXCHANGE_ROUND", 8)
        monkeypatch.setattr(strengths, "find_exchange_directions", a_direction)
    pairs = ragged(build, np.float64)
    whole, cut = (made(build, pairs, loss_tol=0.0) for _ in range(2))
    for _ in range(11):
        whole.round(), cut.round()
    assert [bool(some) for some in cut._exchanges] == [exchanging] * 3
    cut = cut.subset(np.array([2, 0]))
    for _ in range(4):
        whole.round(), cut.round()
        np.testing.assert_allclose(cut.progress.loss, whole.progress.loss[[2, 0]], rtol=1e-9)
    assert cut.progress.live.all() and cut.progress.n_rounds.tolist() == [15, 15]


def test_a_scene_of_stars_alone(build):
    scene, state = posed(build, fixed=(0, 1, 2))
    e = made(build, [(scene, state)])
    while e.progress.live.any():
        e.round()
        assert e.progress.n_rounds[0] < 60
    for a, b in zip(e.states()[0].morph, state.morph, strict=True):
        np.testing.assert_array_equal(a, b)
    assert e.progress.converged[0]


def test_a_scene_of_no_number_harms_nobody(build):
    pairs = ragged(build, np.float64)
    scene, state = pairs[1]
    pairs[1] = replace(scene, data=[d * np.nan for d in scene.data]), state
    e, alone = made(build, pairs), made(build, pairs[:1])
    for _ in range(8):
        e.round(), alone.round()
    assert e.progress.failed.tolist() == [False, True, False]
    assert e.progress.loss[0] == pytest.approx(alone.progress.loss[0], rel=1e-7)


@pytest.fixture(scope="module")
def plain(device):
    return scenes.fit(blend(BRIGHT), device)


def test_it_is_the_default_and_converges(plain):
    assert plain.status == "converged" and 0.85 < chi2(plain) < 1.05
    for i, drawn in enumerate(BRIGHT):
        model, want = plain.source_model(i), truth([drawn])
        error = np.linalg.norm(model - want, axis=(1, 2)) / np.linalg.norm(want, axis=(1, 2))
        assert error.max() < 0.05


def test_a_fit_ends_when_little_is_left_to_gain(device, plain):
    """Continued to the end, no flux changes by 0.3 of its error."""
    longer = scenes.fit(blend(BRIGHT), device, settings=Settings(max_iter=500, loss_tol=1e-3))
    error = np.sqrt(np.einsum("cnn->nc", plain.covariance))
    for i, (a, b) in enumerate(zip(plain.components, longer.components, strict=True)):
        away = np.abs(a.flux - b.flux) / (error[i] * b.morphology.sum())
        assert away.max() < 0.3
    assert len(longer.losses) > len(plain.losses)


def test_the_iteration_limit_is_kept(device):
    for max_iter in (0, 1, 7):
        seen = []

        def note(n, loss, seen=seen):
            seen.append((n, loss.shape))

        settings = Settings(max_iter=max_iter, loss_tol=0)
        result = scenes.fit(blend(), device, settings=settings, progress=note)
        assert result.status == "iteration limit"
        assert len(result.losses) <= max_iter + 1 and np.isfinite(chi2(result))
        assert seen == [(n, (1,)) for n in (5, 7) if n <= max_iter] or max_iter == 1


@pytest.mark.parametrize("given", [{}, {"fit_sky": True}, {"fit_shifts": True}], ids=str)
def test_many_are_as_if_each_were_alone(device, given):
    """Of other sizes, in padded frames: the same fits to what rounding makes of 12 iterations."""
    blends = [
        blend(seed=0),
        blend(GALAXIES[:1], seed=1),
        blend(seed=2, shape=(33, 37)),
        blend(seed=3, shift=(0.3, -0.2)),
    ]
    settings = replace(SHORT, **given)
    results = deblend_many(blends, settings=settings, device=device)
    for b, result in zip(blends, results, strict=True):
        alone = scenes.fit(b, device, settings=settings)
        assert result.status == alone.status
        np.testing.assert_allclose(result.shifts, alone.shifts, atol=1e-2)
        for k, o in enumerate(alone.observations):
            away = (result.model(k) - alone.model(k)) * np.sqrt(o.weights)
            assert np.abs(away).max() < 0.1


def test_fits_that_stop_leave_the_batch(device):
    """All converge, in smaller and smaller batches."""
    bright = [(place, tuple(10 * np.array(flux)), size) for place, flux, size in BRIGHT]
    blends = [blend(seed=i) for i in range(5)] + [blend(bright, seed=9)]
    results = deblend_many(blends, device=device)
    assert all(r.converged and 0.8 < chi2(r) < 1.2 for r in results)
    assert len({len(r.losses) for r in results}) > 1


def test_shifts_are_found(device):
    b = blend(BRIGHT, shift=(0.4, -0.3), seed=1)
    result = scenes.fit(b, device, settings=Settings(fit_shifts=True))
    assert result.converged
    np.testing.assert_allclose(result.shifts, [(0, 0), (0.4, -0.3)], atol=0.05)


def test_stars_beside_galaxies_stay_points(device):
    b = blend((*BRIGHT, ((5.0, 28.0), (40, 30, 60), 0)))
    sources = (*b.sources[:2], PointSource(position_px=(5.0, 28.0)))
    result = deblend(b.observations, sources, frame=b.frame, device=device)
    assert result.converged and chi2(result) < 1.05
    assert result.components[2].flux == pytest.approx([40, 30, 60], rel=0.05)


@pytest.mark.parametrize("when", [0, 3, 9])
def test_ctrl_c_gives_the_present_state(device, monkeypatch, when):
    original, calls = MultiscaleEngine._evaluate, []

    def evaluate(self):
        calls.append(1)
        if len(calls) == when + 1:
            raise KeyboardInterrupt
        return original(self)

    monkeypatch.setattr(MultiscaleEngine, "_evaluate", evaluate)
    result = scenes.fit(blend(BRIGHT), device)
    assert result.status == "interrupted" and np.isfinite(chi2(result))
    assert len(result.losses) <= when


def test_an_engine_and_its_buffers_are_freed_without_the_garbage_collector(build):
    engine = made(build, [posed(build)])
    engine._evaluate()
    gone = weakref.ref(engine)
    del engine
    assert gone() is None


def test_settings_that_cannot_be():
    with pytest.raises(ValueError, match="loss_tol is -1"):
        Settings(loss_tol=-1)
