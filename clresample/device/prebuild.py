"""Compiles products in a process of its own; `compile_beside` of compiling.py starts it."""

from __future__ import annotations

import sys

import numpy as np

from .contraction import Contraction, MatrixBatch, box_product, row_stride
from .device import Device
from .discovery import choose


def compile_products(device):
    """Runs a turned operator's product, and that of sources' boxes, on a matrix of zeros."""
    dtype, n = np.dtype(np.float32), row_stride(2)
    zeros = device.zeros(64 * n, dtype).base_data
    matrix = MatrixBatch(zeros, n)
    turned = Contraction(device, dtype, epilogue="TWIST")
    result = MatrixBatch(device.zeros(2 * n, dtype).base_data, n)
    boxes = box_product(device, dtype, strided=False, ragged=False)
    sizes = device.zeros(12, np.int64), device.zeros(1, np.int32)
    boxes.bind(items=sizes[0], active=sizes[1], block=4, inward=1, add=0, ragged=0)
    boxes((1, 1, 1), A=zeros, B=zeros, C=result.buffer)
    turned.bind(2, 2, 2, matrix, matrix, result, (zeros, 0, 0))(1)
    device.finish()


if __name__ == "__main__":
    compile_products(Device(choose(sys.argv[1])))
