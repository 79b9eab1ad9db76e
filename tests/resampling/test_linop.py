"""Every operator's use of its caller's arrays, and the checks of testing.py themselves."""

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH, TYPES, distance, operator, psfs

from clresample.device.device import Device
from clresample.device.discovery import load_pyopencl
from clresample.resampling.linop import LinOp
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint, dense

every_type = pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)
every_path = pytest.mark.parametrize("geometry", ONE_OF_EACH)


def noise(shape, dtype=np.float32):
    return np.random.default_rng(11).normal(size=shape).astype(dtype)


def build(device, geometry="60 degrees", dtype=np.float32):
    return operator(device, GEOMETRIES[geometry](), *psfs(), dtype)


class MatrixOp(LinOp):
    """A matrix on the host, and one that claims to be its transpose."""

    def __init__(self, device, matrix, transpose=None, dtype=np.float64):
        super().__init__(device, dtype, (1, matrix.shape[1], 1), (1, matrix.shape[0], 1))
        self.matrix = matrix
        self.transpose = matrix.T if transpose is None else transpose

    def _forward(self, x, out):
        self._multiply(self.matrix, x, out)

    def _adjoint(self, y, out):
        self._multiply(self.transpose, y, out)

    def _multiply(self, matrix, x, out):
        result = np.einsum("ij,bcjx->bcix", matrix, x.get())
        out.set(np.ascontiguousarray(result, dtype=self.dtype))


@every_path
def test_numpy_arrays_of_any_layout_and_type(device, geometry):
    op = build(device, geometry)
    x, y = noise((3, *op.shape_in)), noise((3, *op.shape_out))
    for run, images in ((op.forward, x), (op.adjoint, y)):
        truth = run(images)
        assert type(truth) is np.ndarray and truth.dtype == np.float32
        assert truth.flags.c_contiguous
        before = images.copy()
        for layout in (
            np.asfortranarray(images),
            images[::-1, ::-1, ::-1, ::-1].copy()[::-1, ::-1, ::-1, ::-1],
            np.repeat(np.repeat(images, 2, axis=1), 3, axis=-1)[:, ::2, :, ::3],
            np.moveaxis(np.ascontiguousarray(np.moveaxis(images, 1, -1)), -1, 1),
            images.astype(">f4"),  # as FITS files hold them
            images.astype(float),
            images.tolist(),
        ):
            np.testing.assert_array_equal(run(layout), truth)
        np.testing.assert_array_equal(images, before)
    whole = np.rint(10 * x[0]).astype(np.int16)
    np.testing.assert_array_equal(op(whole), op(whole.astype(np.float32)))


@every_path
def test_permuted_bands_are_not_swapped_back(device, geometry):
    op = build(device, geometry)
    x = noise(op.shape_in)
    both = [
        operator(device, GEOMETRIES[geometry](), *(psf[i] for psf in psfs()))(x[i : i + 1])[0]
        for i in (0, 1)
    ]
    assert distance(op(x), both) < 1e-4  # noise at the edge rings by the padding, one per operator
    swapped = operator(device, GEOMETRIES[geometry](), *(psf.select([1, 0]) for psf in psfs()))
    np.testing.assert_array_equal(swapped(x[::-1]), op(x)[::-1])
    assert distance(op(x[::-1])[::-1], op(x)) > 0.01


@every_path
@every_type
def test_one_image_in_every_band(device, geometry, dtype):
    op = build(device, geometry, dtype)
    x = noise((3, *op.shape_in[1:]), dtype)
    truth = op(np.repeat(x[:, None], 2, axis=1))
    np.testing.assert_array_equal(op.render(x), truth)
    np.testing.assert_array_equal(op.render(x[1]), truth[1])
    on_device, out = device.put(x), device.empty(truth.shape, dtype)
    assert op.render(on_device, out=out) is out
    np.testing.assert_array_equal(op.render(on_device[1:]).get(), truth[1:])
    np.testing.assert_array_equal(out.get(), truth)
    with pytest.raises(ValueError, match=r"x has shape \(2, 31, 25\), expected \(31, 26\)"):
        op.render(x[:2, :, 1:])
    plans = Resampler.from_plans(op.plans * 3, dtype=dtype, device=device)
    np.testing.assert_array_equal(plans.render(x), truth)


@every_path
@every_type
def test_device_arrays_stay_on_the_device(device, geometry, dtype, monkeypatch):
    op = build(device, geometry, dtype)
    x, y = noise((4, *op.shape_in), dtype), noise((4, *op.shape_out), dtype)
    forward, adjoint = op(x), op.adjoint(y)
    # items 1 and 2 of longer arrays, whose other items are no numbers: in place, from an offset
    x_long, y_long = np.full_like(x, np.nan), np.full_like(y, np.nan)
    x_long[1:3], y_long[1:3] = x[1:3], y[1:3]
    x_long, y_long = device.put(x_long), device.put(y_long)
    x_out, y_out = (device.put(np.full(a.shape, 7.0, dtype)) for a in (x, y))

    def forbidden(*arguments, **options):
        raise AssertionError("a copy through the host")

    with monkeypatch.context() as patch:
        for name in ("upload", "download", "get", "put"):
            patch.setattr(Device, name, forbidden)
        new = op(x_long[1:3]), op.adjoint(y_long[1:3])
        assert op.forward(x_long[1:3], out=y_out[1:3]).base_data is y_out.base_data
        op.adjoint(y_long[1:3], out=x_out[1:3])
        with pytest.raises(AssertionError, match="a copy through the host"):
            op(x)
    for result, out, truth in zip(new, (y_out, x_out), (forward, adjoint), strict=True):
        np.testing.assert_array_equal(result.get(), truth[1:3])
        np.testing.assert_array_equal(out.get()[1:3], truth[1:3])
        assert (out.get()[[0, 3]] == 7).all()
    # one item, without the batch axis
    np.testing.assert_array_equal(op(x_long[1]).get(), forward[1])
    np.testing.assert_array_equal(x_long.get()[1:3], x[1:3])


def test_device_arrays_of_another_queue(device):
    cl = load_pyopencl()
    import pyopencl.array

    op = build(device)
    x = noise(op.shape_in)
    queue = cl.CommandQueue(device.context, device.cl)
    out = pyopencl.array.empty(queue, op.shape_out, np.float32)
    op(pyopencl.array.to_device(queue, x), out=out)
    np.testing.assert_array_equal(out.get(), op(x))
    context = cl.Context([device.cl])  # some drivers do not keep it for its queues
    elsewhere = cl.CommandQueue(context, device.cl)
    with pytest.raises(ValueError, match="x belongs to an OpenCL context"):
        op(pyopencl.array.to_device(elsewhere, x))


def test_out_is_written_and_returned(device):
    op = build(device)
    x = noise((2, *op.shape_in))
    truth = op(x)
    for out in (
        np.full(truth.shape, np.nan, np.float32),
        np.full(truth.shape, np.nan),  # float64: cast
        np.full((2, 2, *truth.shape[2:], 3), np.nan, np.float32)[..., 1],
    ):
        assert op.forward(x, out=out) is out
        np.testing.assert_array_equal(out, truth)
    assert distance(op.adjoint(truth, out=np.empty_like(x)), op.adjoint(truth)) == 0


def test_wrong_arrays_are_refused(device):
    op = build(device)
    x = noise(op.shape_in)
    on_device = device.put(x)
    wide = device.put(np.repeat(x, 2, axis=-1))
    y = device.empty(op.shape_out, np.float32)
    for array, out, match in (
        (x[:, :-1], None, r"x has shape \(2, 30, 26\), expected \(2, 31, 26\)"),
        (x[None][:0], None, r"x has shape \(0, 2, 31, 26\)"),
        (x[0], None, r"x has shape \(31, 26\)"),
        (None, None, "x must be an array of real numbers, it holds None"),
        (x + 1j, None, "x must be an array of real numbers, not of type complex64"),
        (x, np.empty((2, 13, 17)), r"out has shape \(2, 13, 17\), expected \(2, 13, 18\)"),
        (x, y, "out is a .*Array, but x a numpy.ndarray"),
        (x, [1.0], "out is a builtins.list"),
        (on_device, np.empty(op.shape_out), "out is a numpy.ndarray, but x a .*Array"),
        (device.put(x.astype(np.float64)), None, "x has dtype float64, the operator has float32"),
        (wide[..., ::2], None, r"x has strides .*C-contiguous"),
        (on_device, device.empty((2, 18, 13), np.float32).transpose((0, 2, 1)), "out has strides"),
        (on_device, device.empty(op.shape_out, np.int32), "out has dtype int32"),
    ):
        with pytest.raises(ValueError, match=match):
            op.forward(array, out=out)
    with pytest.raises(ValueError, match=r"y has shape \(2, 31, 26\)"):
        op.adjoint(x)


@pytest.mark.parametrize("geometry", ["aligned", "60 degrees"])
def test_numbers_that_the_type_cannot_hold_are_refused(device, geometry):
    op = build(device, geometry)
    x = np.ones((2, *op.shape_in))
    before = op(x)
    x[1, 0, 3, 4] = 1e39
    for call, name, values in ((op, "x", x), (op.adjoint, "y", 1e39 * np.ones(op.shape_out))):
        with pytest.raises(ValueError, match=rf"^{name} holds numbers of up to 1e\+39, float32 "):
            call(values)
    assert np.array_equal(op(np.ones((2, *op.shape_in))), before)
    x[1, 0, 3, 4] = np.inf  # what says itself what it is goes through
    assert not np.isfinite(op(x)[1]).all() and np.array_equal(op(x)[0], before[0])


def test_images_of_one_band_need_no_band_axis(device):
    op = operator(device, GEOMETRIES["mirrored"](), PSF.gaussian(0.8), PSF.gaussian(1.5))
    x = noise(op.shape_in)
    assert op(x[0]).shape == op.shape_out[1:]
    np.testing.assert_array_equal(op(x[0]), op(x)[0])
    np.testing.assert_array_equal(op.adjoint(op(x)[0]), op.adjoint(op(x))[0])


@every_type
def test_matmul_transpose_and_scipy(device, dtype):
    op = build(device, dtype=dtype)
    x, y = noise(op.shape_in, dtype), noise(op.shape_out, dtype)
    np.testing.assert_array_equal(op @ x, op.forward(x))
    np.testing.assert_array_equal(op.T @ y, op.adjoint(y))
    np.testing.assert_array_equal(op.T.T @ x, op.forward(x))
    assert (op.T.shape_in, op.T.shape_out) == (op.shape_out, op.shape_in)
    flat = op.as_scipy()
    assert flat.shape == (y.size, x.size) and flat.dtype == dtype
    np.testing.assert_array_equal(flat @ x.ravel(), op(x).ravel())
    np.testing.assert_array_equal(flat.T @ y.ravel(), op.adjoint(y).ravel())
    columns = np.stack([x.ravel(), -x.ravel()], axis=1)
    np.testing.assert_array_equal(flat @ columns, np.stack([op(x).ravel(), -op(x).ravel()], axis=1))
    both = flat.T @ flat  # SciPy's own algebra
    assert distance(both @ x.ravel(), op.adjoint(op(x)).ravel()) == 0


def test_calls_do_not_disturb_each_other(device):
    op, other = build(device), build(device, "mirrored")
    x = noise((5, *op.shape_in))
    truth = op(x)
    first = op(x[:2])
    op(x[4]), other(x), op.adjoint(op(x[3]))
    np.testing.assert_array_equal(first, truth[:2])  # results are the caller's own
    np.testing.assert_array_equal(op(x), truth)  # the same bits on every run


def test_dense_and_the_dot_test_know_a_matrix(device):
    if not device.has_fp64:
        pytest.skip("no float64")
    rng = np.random.default_rng(12)
    matrix = rng.normal(size=(9, 7))
    op = MatrixOp(device, matrix)
    np.testing.assert_array_equal(dense(op), matrix)
    np.testing.assert_array_equal(dense(op.T), matrix.T)
    assert check_adjoint(op, rng) <= 1e-13


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(lambda a: -a.T, id="wrong sign"),
        pytest.param(lambda a: a.T * (1 + 1e-12), id="wrong scale"),
        pytest.param(lambda a: np.roll(a.T, 1, axis=0), id="a pixel off"),
        pytest.param(lambda a: np.where(np.arange(7)[:, None] == 6, 0, a.T), id="a row left out"),
        pytest.param(lambda a: a[:7, ::-1].T[:, list(range(7)) + [0, 0]], id="flipped"),
    ],
)
def test_the_dot_test_sees_a_wrong_adjoint(device, fault):
    if not device.has_fp64:
        pytest.skip("no float64")
    matrix = np.random.default_rng(13).normal(size=(9, 7))
    op = MatrixOp(device, matrix, fault(matrix))
    with pytest.raises(AssertionError, match=r"of \|Ax\|\|y\|"):
        check_adjoint(op, np.random.default_rng(14))


def test_the_dot_test_refuses_an_operator_that_answers_zero(device):
    op = MatrixOp(device, np.zeros((3, 4)), dtype=np.float32)
    with pytest.raises(AssertionError, match="A x is zero"):
        check_adjoint(op, np.random.default_rng(15))
