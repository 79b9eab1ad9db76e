"""The iteration on the device: each kernel as its reference, gradients as finite differences,
steps as NumPy's AMSGrad, on CPUs' builds and on GPUs'."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import BOXES, problem

from clresample.deblending.solver import reference_scene as ref
from clresample.deblending.solver.constraints import Chain, MaxNorm, Monotone, Positivity
from clresample.deblending.solver.engine import BETA1, DAMPING, HISTORY, Engine
from clresample.deblending.solver.prior import Prior
from clresample.deblending.solver.problem import StepSizes
from clresample.deblending.solver.reference_prox import monotone_sweep
from clresample.device.device import Device
from clresample.sky.psf import PSF

PRIOR = Prior(alpha=0.1, correlation_px=1.0)
RATES = StepSizes(field=0.05, morphology=0.01, spectrum=0.1)
TYPES = [np.float32, np.float64]
# [relative to an array's largest value] a few hundred roundings: sums over pixels and frequencies
CLOSE = {np.float32: 1e-4, np.float64: 1e-12}
PSFS = PSF.gaussian(1.2, n_pixels=19), PSF.gaussian(0.9, n_pixels=15, n_bands=2)
every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)
with_and_without = pytest.mark.parametrize("prior", [PRIOR, None], ids=["prior", "free"])


@pytest.fixture(params=["rows", "groups"])
def build(request, device, monkeypatch):
    """The build for CPUs, or the one for GPUs: an item a pixel, 64 a sum."""
    if request.param == "groups":
        if device.kind != "CPU":
            pytest.skip("this device's own")
        monkeypatch.setattr(device, "kind", "GPU")
    return device


def engine(problems, device, dtype=np.float64, *, prior=PRIOR, chain=None, rates=RATES):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    chain = chain or Chain(Positivity(), Monotone())
    return Engine(problems, device, dtype, chain=chain, prior=prior, rates=rates)


def ragged(device, dtype, **given):
    """Scenes of 3, 1 and 5 sources, one with PSFs of its own; a star; boxes at all edges, and of
    one pixel; dark pixels, and spectra next to zero."""
    problems = [
        problem(device, dtype, seed=1, fixed=(1,), **given),
        problem(device, dtype, seed=2, boxes=BOXES[4:], psfs=PSFS, **given),
        problem(device, dtype, seed=3, boxes=BOXES, **given),
    ]
    for p in problems:
        p.spectra[0] *= 1e-3
        for m in p.morph:
            m[::3, 1::4] = 0
    return problems


def close(found, wanted, dtype):
    scale = np.abs(wanted).max(initial=1e-3)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=CLOSE[dtype] * scale)


class Reference:
    """One scene iterated in NumPy; only the operators are the device's."""

    def __init__(self, p, prior):
        self.p, self.prior, self.i_step = p, prior, p.n_steps
        self.morph, self.field = list(p.morph), list(p.field)
        self.spectra, self.sky = p.spectra, p.sky
        self.moments = [(np.zeros(m.shape),) * 3 for m in p.morph]
        self.moments_spectra = (np.zeros(p.spectra.shape),) * 3

    def gradient(self):
        p = self.p
        model = ref.compose(p.shape, p.origin, self.morph, self.spectra)
        g, self.loss, pull, channel = [], 0.0, [], 0
        for op, data, weights in zip(p.ops, p.data, p.weights, strict=True):
            part = slice(channel, channel + op.shape_out[0])
            channel = part.stop
            wr, loss, total = ref.residual(
                op.forward(model[part].astype(op.dtype)), data, weights, self.sky[part]
            )
            g.append(op.adjoint(wr.astype(op.dtype)))
            self.loss += loss
            pull.append(total)
        self.pull, self.g = np.concatenate(pull), np.concatenate(g).astype(float)
        self.d_morph = ref.gather_morph(self.g, p.origin, self.morph, self.spectra)
        self.d_spectra = ref.gather_spectra(self.g, p.origin, self.morph)
        if self.prior:
            self.loss += 0.5 * sum((f**2).sum() for f in self.field)

    def update(self):
        p = self.p
        self.i_step += 1
        direction, self.moments_spectra = ref.amsgrad(
            p.scale * self.d_spectra, self.moments_spectra, self.i_step
        )
        self.spectra = np.maximum(self.spectra - RATES.spectrum * p.scale * direction, 0)
        total = np.concatenate([w.sum(axis=(1, 2)) for w in p.weights])
        self.sky = self.sky - 0.5 * self.pull / total
        for s in np.flatnonzero(~p.fixed):
            self._move(s)
            image = np.maximum(self.morph[s], 0)
            self.morph[s] = monotone_sweep(image, p.center[s])

    def _damped(self, s, rate):
        return 1e-8 + rate * DAMPING * self.p.damping[s]

    def _move(self, s):
        if not self.prior:
            e = self._damped(s, RATES.morphology)
            g = self.d_morph[s]
            direction, self.moments[s] = ref.amsgrad(g, self.moments[s], self.i_step, epsilon=e)
            self.morph[s] = self.morph[s] - RATES.morphology * direction
            return
        amp, taps = PRIOR.alpha * np.sqrt(self.p.base[s]), PRIOR.taps
        g = ref.field_gradient(self.d_morph[s], self.morph[s], amp, self.field[s], taps)
        direction, self.moments[s] = ref.amsgrad(
            g, self.moments[s], self.i_step, epsilon=self._damped(s, RATES.field)
        )
        self.field[s] = self.field[s] - RATES.field * direction
        self.morph[s] = ref.form(self.p.base[s], amp, self.field[s], taps)


@every_type
def test_kernels_are_their_references(build, dtype):
    problems = ragged(build, dtype)
    e, references = engine(problems, build, dtype), [Reference(p, PRIOR) for p in problems]
    for r in references:
        r.gradient()
    for j, launch in ((0, 0), (1, len(e._iteration) // 2)):
        e._iteration[launch]()
        for b, p in enumerate(problems):
            model = ref.compose(p.shape, p.origin, p.morph, p.spectra)
            close(build.get(e.models[j])[b], model[(slice(0, 1), slice(1, 3))[j]], dtype)
    e.gradient(3)
    close(build.get(e.history)[3], [r.loss for r in references], dtype)
    close(
        np.concatenate([build.get(m) for m in e.models], axis=1), [r.g for r in references], dtype
    )
    close(build.get(e.d_spectra), np.concatenate([r.d_spectra for r in references]), dtype)
    found = e.host_boxes.unpack(build.get(e.d_morph))
    wanted = [d for r in references for d in r.d_morph]
    free = ~np.concatenate([p.fixed for p in problems])
    for i in range(len(wanted)):
        close(found[i], wanted[i] if free[i] else 0 * wanted[i], dtype)
    pull = np.add.reduceat(build.get(e.rows_pull), e.row0[:-1], axis=1)
    close(pull, [r.pull for r in references], dtype)


@every_type
@with_and_without
def test_steps_are_the_reference(build, prior, dtype):
    problems = ragged(build, dtype)
    e, references = engine(problems, build, dtype, prior=prior), []
    losses = e.run(4)
    for i, p in enumerate(problems):
        r = Reference(p, prior)
        references.append(r)
        for k in range(4):
            r.gradient()
            close(losses[k, i], r.loss, dtype)
            r.update()
    for r, now in zip(references, e.problems_now(), strict=True):
        assert now.n_steps == 4
        # a step divides a gradient by its own size: where that is tiny, its rounding is a step's
        grain = 1 if dtype == np.float64 else 10
        for s in range(len(r.morph)):
            close(now.morph[s] / grain, r.morph[s] / grain, dtype)
        close(now.spectra, r.spectra, dtype)
        close(now.sky, r.sky, dtype)
    close(e.final_losses(), [total_loss(r) for r in references], dtype)


def total_loss(reference):
    reference.gradient()
    return reference.loss


def test_a_fixed_morphology_stays(build):
    p = problem(build, fixed=(0, 2))
    e = engine([p], build)
    e.run(5)
    (now,) = e.problems_now()
    for s in (0, 2):
        np.testing.assert_array_equal(now.morph[s], p.morph[s])
    assert not np.array_equal(now.morph[1], p.morph[1])
    e = engine([replace(p, fixed=np.ones(3, bool))], build)
    e.run(5)
    (now,) = e.problems_now()
    for a, b in zip(now.morph, p.morph, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(now.spectra, p.spectra)


def losses_at(device, p, prior=PRIOR):
    return engine([p], device, prior=prior).final_losses()[0]


def formed(p, field):
    """The problem at another field z."""
    amps = [PRIOR.alpha * np.sqrt(b) for b in p.base]
    both = zip(p.base, amps, field, strict=True)
    return replace(p, field=field, morph=[ref.form(b, a, z, PRIOR.taps) for b, a, z in both])


def moved(p, what, direction, step):
    if what == "field":
        return formed(p, [z + step * d for z, d in zip(p.field, direction, strict=True)])
    now = getattr(p, what)
    if what == "morph":
        return replace(p, morph=[m + step * d for m, d in zip(now, direction, strict=True)])
    return replace(p, **{what: now + step * direction})


@pytest.mark.parametrize("what", ["field", "morph", "spectra", "sky"])
def test_gradients_are_finite_differences(device, what):
    """Along random directions. The loss is quadratic in each kind: no step is too large."""
    p = problem(device)
    prior = PRIOR if what == "field" else None
    p = formed(p, p.field)
    assert min(m.min() for m in p.morph) > 0
    e = engine([p], device, prior=prior)
    e.gradient()
    pull = device.get(e.rows_pull)
    e.update()  # a first moment is (1 - BETA1) of the gradient
    (now,) = e.problems_now()
    gradient = {
        "field": [m / (1 - BETA1) for m in now.moments_morph[0]],
        "morph": [m / (1 - BETA1) for m in now.moments_morph[0]],
        "spectra": now.moments_spectra[0] / (1 - BETA1) / p.scale,
        "sky": np.add.reduceat(pull[0], e.row0[:-1]),
    }[what]
    rng = np.random.default_rng(4)
    for _ in range(3):
        direction = [rng.normal(size=np.shape(g)) for g in gradient]
        if what in ("spectra", "sky"):
            direction = np.array(direction)
        sides = [losses_at(device, moved(p, what, direction, t), prior) for t in (0.1, -0.1)]
        slope = sum((g * d).sum() for g, d in zip(gradient, direction, strict=True))
        assert (sides[0] - sides[1]) / 0.2 == pytest.approx(slope, rel=1e-9)


def test_a_sky_step_is_half_of_newtons(device):
    """Alone with the data it leaves half of the residual's mean."""
    p = problem(device, spectra=np.zeros((3, 3)), scale=np.zeros((3, 3)))
    e = engine([p], device)
    e.run(1)
    flat = [
        (w * d).sum(axis=(1, 2)) / w.sum(axis=(1, 2))
        for w, d in zip(p.weights, p.data, strict=True)
    ]
    close(e.problems_now()[0].sky, (p.sky + np.concatenate(flat)) / 2, np.float64)


@every_type
@with_and_without
def test_a_warm_start_goes_on_as_if_nothing_had_happened(device, prior, dtype):
    problems = ragged(device, dtype)
    whole = engine(problems, device, dtype, prior=prior)
    whole.run(10)
    losses = whole.run(10)
    first = engine(problems, device, dtype, prior=prior)
    first.run(10)
    second = engine(first.problems_now(), device, dtype, prior=prior)
    np.testing.assert_array_equal(second.run(10), losses)
    for a, b in zip(whole.problems_now(), second.problems_now(), strict=True):
        for m, n in zip(a.morph, b.morph, strict=True):
            np.testing.assert_array_equal(m, n)
        np.testing.assert_array_equal(a.spectra, b.spectra)
        np.testing.assert_array_equal(a.moments_spectra, b.moments_spectra)
        assert a.n_steps == b.n_steps == 20


def test_the_best_state_is_kept(build):
    """Of each scene by itself, at the start of a run; never one whose loss is no number."""
    problems = ragged(build, np.float64)
    e = engine(problems, build)
    assert np.isinf(e.best_losses()).all()
    e.run(5)
    for p, kept in zip(problems, e.problems_now(kept=True), strict=True):
        np.testing.assert_array_equal(kept.spectra, p.spectra)  # that before the first step
    good, losses = e.problems_now(), e.run(1)[0]
    np.testing.assert_array_equal(e.best_losses(), losses)
    spectra = np.concatenate([p.spectra for p in good])
    spectra[0] += 100  # of scene 0, whose loss rises
    spectra[3] = np.nan  # scene 1
    build.upload(spectra, e.spectra)
    with np.errstate(invalid="ignore"):
        e.run(2)
    kept = e.problems_now(kept=True)
    for i in (0, 1):
        np.testing.assert_array_equal(kept[i].spectra, good[i].spectra)
        np.testing.assert_array_equal(kept[i].sky, good[i].sky)
        for a, b in zip(kept[i].morph + kept[i].field, good[i].morph + good[i].field, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(e.best_losses()[:2], losses[:2])
    assert np.isfinite(e.run(1)[0, 2])  # the others go on
    assert not np.array_equal(kept[2].morph[0], good[2].morph[0])
    best = e.best_losses()
    e.run(3)
    assert e.final_losses()[2] < e.best_losses()[2]  # which is that of a state that is kept
    assert best[2] < losses[2]


def test_a_normalisation_hands_its_factor_to_the_spectra(device):
    """Without a prior, max = 1 and the model stays."""
    p = problem(device, scale=np.zeros((3, 3)), fit_sky=False)
    still = replace(RATES, morphology=0.0)
    e = engine([p], device, prior=None, chain=Chain(MaxNorm()), rates=still)
    first, second = e.run(2)[:, 0]
    (now,) = e.problems_now()
    assert second == pytest.approx(first, rel=1e-12)
    for m in now.morph:
        assert m.max() == pytest.approx(1, rel=1e-12)


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
            e.update()
    with pytest.raises(ValueError, match=f"n_steps is {HISTORY + 1}"):
        e.run(HISTORY + 1)


def test_a_new_box_size_builds_no_kernel(device, monkeypatch):
    """CPU runtimes build for each size of a group: the engine never lets them choose."""
    if device.kind != "CPU":
        pytest.skip("CPUs' runtimes alone")
    sizes, launch = [], Device.launch

    def watched(self, kernel, size, local=None):
        sizes.append(local)
        launch(self, kernel, size, local)

    monkeypatch.setattr(Device, "launch", watched)
    for prior in (PRIOR, None):
        engine([problem(device, np.float32)], device, np.float32, prior=prior).run(2)
    assert sizes and None not in sizes


def test_signatures_tell_what_can_share_a_batch(device):
    p = problem(device)
    assert p.signature == problem(device, boxes=BOXES, seed=9, psfs=PSFS).signature
    for other in (
        replace(p, shape=(30, 37)),
        replace(p, fit_sky=False),
        replace(p, n_steps=5),
        replace(p, ops=p.ops[::-1]),
        replace(p, ops=p.ops[:1]),
    ):
        assert other.signature != p.signature


def test_engines_leave_nothing_on_the_device(device):
    problems = ragged(device, np.float32)
    held = []
    for _ in range(6):
        e = engine(problems, device, np.float32)
        e.run(2)
        del e
        gc.collect()
        held.append(device.in_use)
    assert held[1:] == held[:1] * 5


def test_priors_have_unit_variance():
    """sum of K's squares is 1; its taps fall as a Gaussian."""
    taps = Prior(correlation_px=2.0).taps
    assert len(taps) == 13 and (taps**2).sum() == pytest.approx(1)
    assert taps[8] / taps[6] == pytest.approx(np.exp(-0.5))
    noise = np.random.default_rng(0).normal(size=(200, 200))
    assert ref.blur(noise, taps)[10:-10, 10:-10].std() == pytest.approx(1, abs=0.05)
