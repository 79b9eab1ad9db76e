"""Kernel sources: where they lie, what they declare, and what is built of them for a device."""

from __future__ import annotations

import functools
import re
import threading
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path

import numpy as np

from .discovery import DeviceError, load_pyopencl
from .errors import no_double, not_built

# Types of scalar arguments; REAL is the floating type of a build. Whatever else is a buffer.
SCALARS = {"int": np.int32, "uint": np.uint32, "long": np.int64, "ulong": np.uint64}


def kernels_folder():
    """The folder of kernel sources: in the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if folder.is_dir():
            return folder
    raise DeviceError(f"the kernel sources are missing beside {package}: reinstall clresample")


@functools.cache
def read_kernel(file):
    """The source of kernels/`file`, each line `#include "x"` replaced by that file's text."""

    def paste(match):
        line = source.count("\n", 0, match.start()) + 2
        return f'#line 1 "{match[1]}"\n{read_kernel(match[1])}\n#line {line} "{file}"'

    source = (kernels_folder() / file).read_text(encoding="utf-8")
    return re.sub(r'^#include "(.+)"$', paste, source, flags=re.MULTILINE)


def source_of(file, dtype, defines):
    """What is compiled for kernels/`file`: its macros, a line each, and its text.

    dtype: float32 or float64, which REAL stands for
    defines: macros; True defines the bare name, False and None leave it out
    """
    double = np.dtype(dtype) == np.float64
    defines = {**defines, "REAL": "double" if double else "float", "USE_DOUBLE": double}
    lines = [
        f"#define {name} {1 if value is True else value}"
        for name, value in defines.items()
        if value is not None and value is not False
    ]
    return "\n".join([*lines, f'#line 1 "{file}"', read_kernel(file)])


def signature(file, name):
    """The arguments of kernel `name` in kernels/`file`: ((name, type), ...) in their order.

    type: of SCALARS, "REAL", or None for a buffer
    ValueError: there is no such kernel, or an argument has another type
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


class Programs:
    """What was built for one device so far: equal requests share one program and one kernel."""

    def __init__(self, device):
        self.device = device
        self._programs, self._kernels = {}, {}

    def kernel(self, file, name, dtype, defines):
        """A pyopencl.Kernel that knows its scalars' types, and {argument: whether it is a buffer}.

        DeviceError: the file does not build here (with the compiler's log), or no float64
        ValueError: dtype is another, or the file has no such kernel
        """
        dtype = np.dtype(dtype)
        if dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise ValueError(f"dtype is {dtype}; kernels are built for float32 or float64")
        build = _request(file, dtype, defines)
        if (build, name) not in self._kernels:
            arguments, cl = signature(file, name), load_pyopencl()
            program = self._program(file, dtype, defines)
            kernel, types = cl.Kernel(program, name), SCALARS | {"REAL": dtype.type}
            kernel.set_scalar_arg_dtypes([types.get(type_) for _, type_ in arguments])
            is_buffer = {argument: type_ is None for argument, type_ in arguments}
            self._kernels[build, name] = kernel, is_buffer
        return self._kernels[build, name]

    def build_ahead(self, requests):
        """Start to build programs in a thread; `kernel` waits for one that is being built.

        requests: (file, dtype, defines), as `kernel` takes them. One that does not build raises
        its error when `kernel` asks for it again.
        """

        def build():
            for file, dtype, defines in requests:
                if not threading.main_thread().is_alive():
                    break  # Python waits for this thread to end
                with suppress(DeviceError):
                    self._program(file, np.dtype(dtype), defines)

        threading.Thread(target=build).start()

    def _program(self, file, dtype, defines):
        """A program, built by the first thread that asks for it; the others wait."""
        build, mine = _request(file, dtype, defines), Future()
        program = self._programs.setdefault(build, mine)
        if program is mine:
            try:
                mine.set_result(self._built(file, dtype, defines))
            except BaseException as error:
                del self._programs[build]
                mine.set_exception(error)
        return program.result()

    def _built(self, file, dtype, defines):
        device, cl = self.device, load_pyopencl()
        if dtype == np.float64 and not device.has_fp64:
            raise no_double(device)
        program = cl.Program(device.context, source_of(file, dtype, defines))
        try:
            return program.build(options=["-cl-std=CL1.2"])
        except cl.Error as error:
            raise not_built(device, file, defines, build_log(error)) from error


def _request(file, dtype, defines):
    """What tells one program from another."""
    return file, np.dtype(dtype), tuple(sorted(defines.items()))


def build_log(error):
    """The compiler's own words out of pyopencl's message."""
    log = re.sub(r"\(options: .*\)\s*$", "", str(error).split(">:\n", 1)[-1], flags=re.DOTALL)
    return log.strip()
