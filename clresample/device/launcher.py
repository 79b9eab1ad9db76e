"""Kernels launched with their arguments by name, as the kernel sources declare them."""

from __future__ import annotations

import functools
import re

import numpy as np

from .program import read_kernel

# Types of scalar arguments; REAL is the floating type of a build. Whatever else is a buffer.
SCALARS = {"int": np.int32, "uint": np.uint32, "long": np.int64, "ulong": np.uint64}


@functools.cache
def signature(file, name):
    """The arguments of kernel `name` in kernels/`file`: ((name, type), ...) in their order.

    type: of SCALARS, "REAL", or None for a buffer
    ValueError: there is no such kernel
    """
    text = re.sub(r"/\*.*?\*/", " ", read_kernel(file), flags=re.DOTALL)
    found = re.search(rf"__kernel\b[^;{{]*?\bvoid\s+{name}\s*\((.*?)\)\s*\{{", text, re.DOTALL)
    if found is None:
        raise ValueError(f"kernels/{file} has no kernel {name}")
    arguments = []
    for declaration in found[1].split(","):
        words = re.findall(r"\w+", declaration)
        scalar = None if "*" in declaration else words[-2]
        if scalar not in (None, "REAL", *SCALARS):
            raise ValueError(f"{name} of kernels/{file}: argument type {scalar} is not known")
        arguments.append((words[-1], scalar))
    return tuple(arguments)


class Launcher:
    """One kernel and its arguments; `Device.launcher` makes it.

    Arguments are given by name: `bind` sets those that stay, a call those that change, and then
    queues the kernel. Buffers are pyopencl arrays that start at their buffer's first byte, or
    buffers; they are kept here, since OpenCL does not keep what a kernel's arguments point to.
    Not safe to share between threads.
    """

    def __init__(self, device, kernel, arguments, dtype, local_size=None):
        self.device, self.kernel, self.local_size = device, kernel, local_size
        self._index = {name: i for i, (name, _) in enumerate(arguments)}
        types = [{None: None, "REAL": np.dtype(dtype).type, **SCALARS}[t] for _, t in arguments]
        kernel.set_scalar_arg_dtypes(types)
        self._values = [None] * len(arguments)
        self._arrays = {}  # what buffers belong to, so that they live as long as this
        self._buffers = [t is None for t in types]

    def bind(self, **arguments):
        """Set arguments that stay; returns the launcher. ValueError for a name that is not one."""
        for name, value in arguments.items():
            i = self._index.get(name)
            if i is None:
                raise ValueError(f"{name} is no argument of {self!r}: {', '.join(self._index)}")
            if self._buffers[i] and hasattr(value, "base_data"):
                self._arrays[i] = value
                value = value.base_data
            self._values[i] = value
        return self

    def __call__(self, global_size, **arguments):
        """Set the arguments that changed and queue the kernel on `global_size` (x, y, z)."""
        if arguments:
            self.bind(**arguments)
        self.kernel.set_args(*self._values)
        self.device.launch(self.kernel, global_size, self.local_size)

    def __repr__(self):
        return f"Launcher({self.kernel.function_name})"
