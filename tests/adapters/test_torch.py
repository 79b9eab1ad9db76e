"""The operator in PyTorch: values and derivatives against the operator itself."""

import numpy as np
import pytest

from clresample import PSF, Grid, Resampler
from clresample.adapters.torch import as_torch

torch = pytest.importorskip("torch", reason="torch is missing: pip install torch")


@pytest.fixture(scope="module")
def op():
    grids = Grid.flat((7, 8), 0.1), Grid.flat((3, 4), 0.2, angle_deg=20)
    psfs = PSF.gaussian(1.6), PSF.gaussian([1.5, 1.6])
    return Resampler(grids[0], psfs[0], grids[1], psfs[1], dtype=np.float64)


def test_values_and_batches(op):
    x = torch.randn((2, 3, *op.shape_in), dtype=torch.float64)
    result = as_torch(op)(x)
    assert result.shape == (2, 3, *op.shape_out)
    np.testing.assert_array_equal(result[1].numpy(), op(x[1].numpy()))


def test_gradcheck(op):
    x = torch.randn(op.shape_in, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(as_torch(op), x)
    assert torch.autograd.gradgradcheck(as_torch(op), x)


def test_gradcheck_sees_a_wrong_adjoint(op):
    class Wrong:
        dtype, shape_in, shape_out, forward = op.dtype, op.shape_in, op.shape_out, op.forward

        @staticmethod
        def adjoint(y):
            return 1.1 * op.adjoint(y)

    x = torch.randn(op.shape_in, dtype=torch.float64, requires_grad=True)
    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        torch.autograd.gradcheck(as_torch(Wrong), x)


def test_refuses_other_shapes_and_dtypes(op):
    with pytest.raises(ValueError, match=r"x has shape \(3, 4\)"):
        as_torch(op)(torch.zeros(3, 4))
    with pytest.raises(ValueError, match="float32"):
        as_torch(op)(torch.zeros(op.shape_in, dtype=torch.float32))


def test_an_image_of_one_band_needs_no_band_axis():
    grids = Grid.flat((7, 8), 0.1), Grid.flat((3, 4), 0.2, angle_deg=20)
    one = Resampler(grids[0], PSF.gaussian(1.6), grids[1], PSF.gaussian(1.5), dtype=np.float64)
    x = torch.randn((7, 8), dtype=torch.float64)
    np.testing.assert_array_equal(as_torch(one)(x).numpy(), one(x.numpy()))
