"""The proximal operators against their NumPy references, over sources of many shapes at once.

Each is a proximal operator or a projection, as it states.
"""

import numpy as np
import pytest
from helpers.morphologies import DTYPES, apply, eps, many_boxes, morphologies

from clresample.deblending.solver.boxes import Boxes
from clresample.paper.solver import reference as ref
from clresample.paper.solver.constraints import (
    L0,
    L1,
    MaxNorm,
    Monotone,
    MonotoneWeights,
    Positivity,
    ProxChain,
    SumNorm,
    Symmetry,
)
from clresample.testing import check_prox


@pytest.fixture
def boxes():
    return many_boxes()


def alone(device, prox, shape, center, dtype=np.float64, step=1.0):
    """The operator as a function of one image."""
    box = Boxes([0], [[0, 0]], [shape], [center])
    return lambda y: apply(device, prox, box, [y], dtype, step=step)[0]


CASES = {
    "positivity": (Positivity(), lambda x, c: ref.positivity(x)),
    "l1": (L1(0.5), lambda x, c: ref.l1(x, x.dtype.type(0.3 * 0.5))),
    "l0": (L0(0.1), lambda x, c: ref.l0(x, 0.3 * 0.1)),
    "max": (MaxNorm(), lambda x, c: ref.max_norm(x)[0]),
    "sum": (SumNorm(), lambda x, c: ref.sum_norm(x)[0]),
    "symmetry": (Symmetry(), lambda x, c: ref.symmetry(x, c)),
    "half symmetry": (Symmetry(0.5), lambda x, c: ref.symmetry(x, c, 0.5)),
    "chain": (
        ProxChain(Positivity(), Symmetry(), ProxChain(Monotone(gradient=0.1), L1(0.2)), MaxNorm()),
        lambda x, c: ref.max_norm(
            ref.l1(ref.monotone_sweep(ref.symmetry(ref.positivity(x), c), c, gradient=0.1), 0.06)
        )[0],
    ),
    "nine steps": (ProxChain(*[L1(0.1)] * 9), lambda x, c: ref.l1(x, 9 * 0.3 * 0.1)),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES)
def test_answers_as_the_reference(device, boxes, case, dtype):
    prox, reference = CASES[case]
    images = morphologies(boxes, dtype)
    found = apply(device, prox, boxes, images, dtype, step=0.3)
    for image, center, got in zip(images, boxes.center, found, strict=True):
        # A few roundings a pixel, in sums of a few hundred pixels.
        np.testing.assert_allclose(got, reference(image, center), rtol=0, atol=eps(dtype, image))


PROXES = {
    "positivity": (Positivity(), lambda x: 0 if x.min() >= 0 else np.inf, True),
    "l1": (L1(0.4), lambda x: 0.4 * abs(x).sum(), True),
    "l0": (L0(0.2), lambda x: 0.2 * np.count_nonzero(x), False),
    "symmetry": (
        Symmetry(),
        lambda x: 0 if abs(x - x[::-1, ::-1]).max() < 1e-12 else np.inf,
        True,
    ),
    "half symmetry": (  # k = 1: strength k / (1 + k)
        Symmetry(0.5),
        lambda x: (((x - x[::-1, ::-1]) / 2) ** 2).sum() / 2,
        True,
    ),
}


def monotone(x):
    return ref.monotone_violation(x, (3, 4), gradient=0.05).max() < 1e-12


@pytest.mark.parametrize("case", PROXES)
def test_is_a_prox(device, case):
    if not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    prox, penalty, convex = PROXES[case]
    # Strength 1/2 is the prox of its penalty at step 1 alone, as its text says.
    step = 1.0 if "symmetry" in case else 0.7
    function = alone(device, prox, (7, 9), (3, 4), step=step)
    rng = np.random.default_rng(2)
    check_prox(function, penalty, (7, 9), rng, step=step, convex=convex, tolerance=1e-7)


BROKEN = {
    "wrong strength": (lambda y: ref.l1(y, 0.3), lambda x: 0.4 * abs(x).sum()),
    "hard for soft": (lambda y: ref.l0(y, 0.4), lambda x: 0.4 * abs(x).sum()),
    "absolute value": (abs, lambda x: 0 if x.min() >= 0 else np.inf),
    "feasible, too low": (
        lambda y: 0.9 * ref.positivity(y),
        lambda x: 0 if x.min() >= 0 else np.inf,
    ),
    "infeasible": (lambda y: y, lambda x: 0 if x.min() >= 0 else np.inf),
    "the sweep is no projection": (
        lambda y: ref.monotone_sweep(ref.positivity(y), (3, 4), gradient=0.05),
        lambda x: 0 if monotone(x) and x.min() >= 0 else np.inf,
    ),
    "the sweep alone neither": (
        lambda y: ref.monotone_sweep(y, (3, 4), gradient=0.05),
        lambda x: 0 if monotone(x) else np.inf,
    ),
    "expansive": (lambda y: 1.5 * y, lambda x: 0 * x.sum()),
}


@pytest.mark.parametrize("case", BROKEN)
def test_check_sees_a_broken_prox(case):
    prox, penalty = BROKEN[case]
    with pytest.raises(AssertionError, match="trial"):
        check_prox(prox, penalty, (7, 9), np.random.default_rng(2))


def test_check_sees_expansion_alone():
    """L0 minimises its cost, but jumps: it fails by non-expansiveness and by nothing else."""
    args = lambda y: ref.l0(y, 0.4), lambda x: 0.4 * np.count_nonzero(x), (7, 9)
    check_prox(*args, np.random.default_rng(2), convex=False)
    with pytest.raises(AssertionError, match="p1-p2"):
        check_prox(*args, np.random.default_rng(2))


@pytest.mark.parametrize("prox", [ProxChain(Positivity(), Monotone()), MaxNorm()])
@pytest.mark.parametrize("active", [[1, 4], np.arange(10) % 3 == 1, []])
def test_others_are_left_alone(device, boxes, prox, active):
    images = morphologies(boxes, np.float32)
    found = apply(device, prox, boxes, images, active=active)
    chosen = np.isin(np.arange(10), np.arange(10)[active] if len(active) else [])
    whole = apply(device, prox, boxes, images)
    for i in range(10):
        np.testing.assert_array_equal(found[i], whole[i] if chosen[i] else images[i])


def test_parameters_per_source(device, boxes):
    images = morphologies(boxes, np.float32)
    kinds = np.array([MonotoneWeights(i % 4) for i in range(10)])
    gradient = np.linspace(0, 0.3, 10)
    strength = np.arange(10) % 2 * 0.3
    prox = ProxChain(L1(strength), Monotone(weights=kinds, gradient=gradient))
    found = apply(device, prox, boxes, images)
    for i, (image, center) in enumerate(zip(images, boxes.center, strict=True)):
        want = ref.l1(image, strength[i])
        if kinds[i]:
            want = ref.monotone_sweep(want, center, kinds[i], gradient[i])
        np.testing.assert_allclose(found[i], want, rtol=0, atol=3e-6)


def test_factors_keep_the_model(device, boxes):
    """The divisor is returned, over both launches of a chain of nine steps."""
    images = [abs(image) + 0.1 for image in morphologies(boxes, np.float32)]
    images[3][:] = 0
    for prox in (
        ProxChain(SumNorm(), MaxNorm()),
        ProxChain(SumNorm(), *[Positivity()] * 7, MaxNorm()),
    ):
        factor = device.put(np.full(10, 7, np.float32))
        found = apply(device, prox, boxes, images, factor=factor, active=np.arange(9))
        factor = device.get(factor)
        assert factor[9] == 7
        assert factor[3] == 1
        for i in range(9):
            np.testing.assert_allclose(found[i] * factor[i], images[i], rtol=3e-6)
            assert i == 3 or found[i].max() == 1


def test_nan_stays_visible(device):
    box = Boxes([0], [[0, 0]], [[5, 5]])
    image = np.full((5, 5), np.nan, np.float32)
    for prox in (Positivity(), L1(0.1), L0(0.1), Monotone(), MaxNorm(), SumNorm(), Symmetry()):
        assert np.isnan(apply(device, prox, box, [image])[0]).all()


@pytest.mark.parametrize(
    ("prox", "message"),
    [
        (L1(-1), "strength is -1"),
        (L0([0.1, 0.2]), r"strength has shape \(2,\) for 10 sources"),
        (Symmetry(2), "strength is 2"),
        (Monotone(gradient=1.5), "gradient is 1.5"),
        (Monotone(weights=9), "weights is 9"),
    ],
)
def test_wrong_parameters_are_named(device, boxes, prox, message):
    with pytest.raises(ValueError, match=message):
        apply(device, prox, boxes, morphologies(boxes, np.float32))


def test_wrong_arrays_are_named(device, boxes):
    placed = boxes.put(device)
    with pytest.raises(ValueError, match=r"morphs is \(5,\)"):
        Positivity().prox(device.zeros(5, np.float32), placed)
    morphs = device.zeros(boxes.size, np.float32)
    with pytest.raises(ValueError, match=r"factor is \(3,\) float32, must be \(10,\)"):
        MaxNorm().prox(morphs, placed, factor=device.zeros(3, np.float32))
    with pytest.raises(ValueError, match="active names source 10"):
        MaxNorm().prox(morphs, placed, active=[10])


@pytest.mark.parametrize("norm", [ref.max_norm, ref.sum_norm])
def test_what_holds_no_light_is_not_scaled(norm):
    for image in (np.zeros((2, 3), np.float32), -np.ones((2, 3), np.float32)):
        scaled, factor = norm(image)
        np.testing.assert_array_equal(scaled, image)
        assert factor == 1 and scaled.dtype == np.float32
    scaled, factor = norm(np.array([[1.0, 0.0], [2.0, 1.0]]))
    np.testing.assert_allclose(scaled * factor, [[1, 0], [2, 1]])
    assert factor == (2 if norm is ref.max_norm else 4)
