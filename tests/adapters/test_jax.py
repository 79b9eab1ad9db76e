"""The operator in JAX: values, derivatives and batches against the operator itself."""

import numpy as np
import pytest

from clresample import PSF, Grid, Resampler
from clresample.adapters.jax import as_jax

jax = pytest.importorskip("jax", reason="JAX is not installed: pip install jax")

EUCLID, RUBIN = Grid.flat((20, 24), 0.1), Grid.flat((9, 11), 0.2, angle_deg=20)


@pytest.fixture(scope="module", params=["aligned", "turned"])
def op(request):
    rubin = Grid.flat((9, 11), 0.2, angle_deg=20 if request.param == "turned" else 0)
    return Resampler(EUCLID, PSF.gaussian(1.6), rubin, PSF.gaussian([1.5, 1.6]), dtype=np.float32)


def draw(shape, seed=1):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def test_values_under_jit_are_the_operators(op):
    x = draw((3, *op.shape_in))
    np.testing.assert_array_equal(jax.jit(as_jax(op))(x), op(x))


def test_the_gradient_is_the_adjoint(op):
    f, x, y = as_jax(op), draw(op.shape_in), draw(op.shape_out, 2)
    gradient = jax.jit(jax.grad(lambda x: 0.5 * ((f(x) - y) ** 2).sum()))(x)
    expected = op.adjoint(op(x) - y)
    assert np.abs(gradient - expected).max() <= 1e-6 * np.abs(expected).max()


def test_forward_and_reverse_derivatives_agree(op):
    f, x, dx, y = as_jax(op), draw(op.shape_in), draw(op.shape_in, 2), draw(op.shape_out, 3)
    _, tangent = jax.jvp(f, (x,), (dx,))
    np.testing.assert_array_equal(tangent, op(dx))
    _, pull = jax.vjp(f, x)
    np.testing.assert_array_equal(pull(y)[0], op.adjoint(y))


def test_second_derivatives(op):
    f, x, v = as_jax(op), draw(op.shape_in), draw(op.shape_in, 2)
    gradient = jax.grad(lambda x: 0.5 * (f(x) ** 2).sum())
    _, curved = jax.jvp(gradient, (x,), (v,))
    np.testing.assert_allclose(curved, op.adjoint(op(v)), rtol=0, atol=1e-6)


def test_vmap_is_one_batch(op, monkeypatch):
    f, x = as_jax(op), draw((5, *op.shape_in))
    calls = []
    run = type(op).forward
    monkeypatch.setattr(type(op), "forward", lambda self, x: calls.append(len(x)) or run(self, x))
    result = jax.vmap(as_jax(op))(x)
    assert calls == [5]
    monkeypatch.undo()
    np.testing.assert_array_equal(result, op(x))
    back = jax.vmap(jax.grad(lambda x: f(x).sum()))(x)
    np.testing.assert_allclose(back, op.adjoint(np.ones((5, *op.shape_out), np.float32)), 1e-6)


def test_refuses_what_it_cannot_hold(op):
    with pytest.raises(ValueError, match=r"x has shape \(3, 4\)"):
        as_jax(op)(np.zeros((3, 4)))
    double = Resampler(EUCLID, PSF.gaussian(1.6), RUBIN, PSF.gaussian(1.5), dtype=np.float64)
    with pytest.raises(ValueError, match="jax_enable_x64"):
        as_jax(double)
    with jax.enable_x64(True):
        x = np.random.default_rng(1).standard_normal(double.shape_in)
        gradient = jax.grad(lambda x: 0.5 * (as_jax(double)(x) ** 2).sum())(x)
        np.testing.assert_allclose(gradient, double.adjoint(double(x)), 0, 1e-14)


def test_an_image_of_one_band_needs_no_band_axis():
    one = Resampler(EUCLID, PSF.gaussian(1.6), RUBIN, PSF.gaussian(1.5))
    f, x = as_jax(one), draw(one.shape_in[1:])
    np.testing.assert_array_equal(f(x), one(x))
    gradient = jax.grad(lambda x: 0.5 * (f(x) ** 2).sum())(x)
    np.testing.assert_allclose(gradient, one.adjoint(one(x)), atol=1e-6)
    assert jax.vmap(f)(np.stack([x, x])).shape == (2, *RUBIN.shape)
