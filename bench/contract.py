"""The contraction kernel against NumPy's matmul, one thread each, in GFLOP/s.

    python -m bench.contract [--json FILE]

A row is a batch of products (m, k) x (k, n), given as shape [m, k, n]: shapes for comparison
(REFERENCE_SHAPES), and those of the operator for EUCLID -> RUBIN at N = 100, 200 and 400.
"""

from __future__ import annotations

import numpy as np

from clresample import get_device
from clresample.device.contraction import Contraction, MatrixBatch, row_stride
from clresample.simulation.surveys import NOTEBOOK_SURVEYS

from .harness import records
from .harness.cases import Case
from .harness.clock import interleaved_ms, on_one_thread
from .harness.options import Parser, run

REFERENCE_SHAPES = (((60, 256, 256), 8), ((60, 256, 256), 64), ((256, 256, 256), 8))
OPERATOR_SIZES = ((100, 1), (100, 64), (200, 1), (200, 64), (400, 1))  # (N, batch)
COLUMNS = records.columns(
    "shape:16 batch:5d dtype:7 ours_gflops:11.1f numpy_gflops:12.1f ratio:6.2f"
)


def operator_shapes(n_model):
    """(m, k, n) of the aligned path's four products."""
    case = Case(NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"], n_model)
    plan = case.operator().plans[0]
    (k_y, n_y), (k_x, n_x) = plan.in_y.shape, plan.in_x.shape
    rows, columns = case.grid_out.shape
    return (n_y, n_x, k_x), (k_y, n_y, k_x), (rows, k_y, k_x), (rows, k_x, columns)


def measure(shape, batch, dtype, seconds):
    """One row: both multiply the same random matrices; ours lie on the device."""
    m, k, n = shape
    device, rng = get_device(), np.random.default_rng(0)
    a = rng.standard_normal((batch, m, k)).astype(dtype)
    b = np.zeros((batch, k, row_stride(n)), dtype)
    b[:, :, :n] = rng.standard_normal((batch, k, n))
    a_device, b_device = device.put(a), device.put(b)
    c_device = device.empty((batch, m, row_stride(n)), dtype)
    left, right, result = (
        MatrixBatch(array.base_data, array.shape[2], array.shape[1] * array.shape[2])
        for array in (a_device, b_device, c_device)
    )
    b, c = np.ascontiguousarray(b[:, :, :n]), np.empty((batch, m, n), dtype)
    product = Contraction(device, dtype).bind(m, n, k, left, right, result)

    def ours():
        product(batch)
        device.finish()

    ms = interleaved_ms({"ours": ours, "numpy": lambda: np.matmul(a, b, out=c)}, seconds=seconds)
    gflops = {name: 2e-6 * batch * m * k * n / t for name, t in ms.items()}
    return {
        "shape": list(shape),
        "batch": batch,
        "dtype": dtype,
        "ours_gflops": gflops["ours"],
        "numpy_gflops": gflops["numpy"],
        "ratio": gflops["ours"] / gflops["numpy"],
    }


def main(options):
    threads = on_one_thread()
    products = list(REFERENCE_SHAPES)
    for n_model, batch in OPERATOR_SIZES:
        products += [(shape, batch) for shape in operator_shapes(n_model)]
    dtypes = ["float32", "float64"] if get_device().has_fp64 else ["float32"]
    rows = (measure(*product, dtype, options.seconds) for dtype in dtypes for product in products)
    records.show(COLUMNS, rows, records.record(threads), options.json)


def parser():
    parser = Parser(__doc__)
    parser.add_seconds(0.3, "row")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
