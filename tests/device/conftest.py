"""Kernels for the tests alone."""

import pytest
from helpers.checkout import ROOT

from clresample.device import program

SOURCES = {
    "scale.cl": """#include "common.h"
#ifndef OFFSET
#define OFFSET 0
#endif
__kernel void scale(__global const REAL *x, __global REAL *out)
{
    const size_t i = get_global_id(0);
    out[i] = 2 * x[i] + OFFSET;
}
""",
    "broken.cl": """__kernel void early(__global float *x) { x[0] = absent; }
#include "common.h"
__kernel void late(__global REAL *x) { x[0] = missing; }
""",
    # Every type of argument; a comment with a comma, and a group size, between the names.
    "mixed.cl": """#include "common.h"
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void mixed(const int n, __global const REAL *restrict x, /* first, read */ const ulong first,
           const REAL factor, __global REAL *restrict out, const uint add, const long step)
{
    const int i = (int)get_global_id(0);
    if (i < n) out[i] = factor * x[first + step * i] + add;
}
__kernel void other(__global const int *x) {}
__kernel void unknown(const char c) {}
""",
}


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """A folder of kernels of our own, with the project's common.h."""
    common = (ROOT / "kernels" / "common.h").read_text()
    for file, source in SOURCES.items() | {("common.h", common)}:
        (tmp_path / file).write_text(source)
    monkeypatch.setattr(program, "kernels_folder", lambda: tmp_path)
    program.read_kernel.cache_clear()
    yield tmp_path
    program.read_kernel.cache_clear()
