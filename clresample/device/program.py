"""Kernel sources, their arguments, their builds for a device, and their launches."""

from __future__ import annotations

import functools
import re
import threading
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from .build_lock import build_lock
from .compiling import CompilationNotice
from .discovery import DeviceError, load_pyopencl
from .errors import build_error, float64_error
from .rounding import round_up

# Types of scalar arguments; REAL is the floating type of a build. All other arguments are buffers.
SCALARS = {"int": np.int32, "uint": np.uint32, "long": np.int64, "ulong": np.uint64}
# The value of an argument that was never bound: pyopencl refuses to set it.
UNSET = object()


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
    """Source of kernels/`file` as compiled: its macros, a line each, and its text.

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
    Raises ValueError if there is no such kernel, or an argument has another type.
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
    """Programs built for one device so far: equal requests share one program and one kernel."""

    def __init__(self, device):
        self.device = device
        self._programs, self._kernels = {}, {}
        self._not_launched: dict[int, str] = {}  # {id of a kernel: its program}
        self.notice = CompilationNotice(device.name)

    def kernel(self, file, name, dtype, defines):
        """A pyopencl.Kernel with its scalars' types, and {argument: True for a buffer}.

        Raises DeviceError, with the compiler's log, if the file does not build on the device, or
        without float64; ValueError for another dtype, or if the file has no such kernel.
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
            if self.device.kind == "CPU":  # drivers for CPUs compile at the first launch
                self._not_launched[id(kernel)] = self._lock_name(build)
            self._kernels[build, name] = kernel, is_buffer
        return self._kernels[build, name]

    def unlaunched(self, kernel):
        """Returns the program of a kernel that has not been launched yet, once, or None."""
        return self._not_launched.pop(id(kernel), None) if self._not_launched else None

    @contextmanager
    def compiling(self, program):
        """Excludes other processes that compile the same program, and shows the wait."""
        with self.notice.shown(), build_lock(program):
            yield

    def _lock_name(self, build):
        return f"{self.device!r} {build}"

    def build_ahead(self, requests):
        """Starts building programs in a thread; `kernel` waits for one in progress.

        requests: (file, dtype, defines), the arguments of `kernel`. The error of a failed build is
            raised when `kernel` requests the same program.
        """

        def build():
            for file, dtype, defines in requests:
                if not threading.main_thread().is_alive():
                    break  # Python waits for this thread to end
                with suppress(DeviceError):
                    self._program(file, np.dtype(dtype), defines)

        threading.Thread(target=build).start()

    def _program(self, file, dtype, defines):
        """A program, built by the first thread that requests it; the others wait."""
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
            raise float64_error(device)
        program = cl.Program(device.context, source_of(file, dtype, defines))
        try:
            with self.compiling(self._lock_name(_request(file, dtype, defines))):
                return self.notice.build(lambda: program.build(options=["-cl-std=CL1.2"]))
        except cl.Error as error:
            raise build_error(device, file, defines, build_log(error)) from error


def _request(file, dtype, defines):
    """Key that identifies a program."""
    return file, np.dtype(dtype), tuple(sorted(defines.items()))


def build_log(error):
    """The compiler's log, extracted from pyopencl's message."""
    log = re.sub(r"\(options: .*\)\s*$", "", str(error).split(">:\n", 1)[-1], flags=re.DOTALL)
    return log.strip()


class Launcher:
    """One kernel, some of its arguments bound; `Device.launcher` makes it.

        blur = device.launcher("update.cl", "blur_latent", dtype=dtype).bind(table=table, taps=taps)
        blur((nx, ny, n_sources), v=latent)

    `bind` sets arguments for all launches, a call those of one launch. A buffer is a pyopencl array
    that starts at its buffer's first byte, a pyopencl Buffer, or None if the kernel reads none.
    Bound buffers live as long as the launcher; OpenCL keeps those of a call until its kernel ends.

    All arguments are set before each launch, in one call to pyopencl, which takes 1.5 us for 23
    arguments; setting a single number takes 6 us. No state is left from earlier launches, so all
    launchers of one build share its pyopencl.Kernel, which takes 0.2 ms to make. `lock` excludes
    other threads between setting and queueing.

    is_buffer {name: bool}: the kernel's arguments in its order
    local_size: work-items of a group along each axis of a launch; None leaves it to the driver
    """

    def __init__(self, device, kernel, is_buffer, lock, local_size=None):
        self.device, self.kernel, self.local_size = device, kernel, local_size
        self._whole_groups = local_size is not None and max(local_size) > 1
        self._is_buffer, self._lock = is_buffer, lock
        self._place = {name: i for i, name in enumerate(is_buffer)}
        self._bound = [UNSET] * len(is_buffer)  # in the kernel's order

    def bind(self, **arguments):
        """Binds arguments; returns the launcher. Raises ValueError for an unknown name."""
        self._bound = self._merged(arguments)
        return self

    def __call__(self, global_size, **arguments):
        """Queues the kernel on `global_size` (x, y, z); `arguments` replace bound ones.

        The size is rounded up to whole groups; work-items beyond `global_size` do nothing.

        Raises ValueError for a name that the kernel does not have, for an argument that was never
        given, and for an array that does not start at its buffer's first byte.
        """
        values = self._merged(arguments) if arguments else self._bound
        with self._lock:
            try:
                self.kernel.set_args(*values)
            except Exception as error:
                unset = [n for n, v in zip(self._place, values, strict=True) if v is UNSET]
                if not unset:
                    error.add_note(f"arguments of {self!r}: {', '.join(self._place)}")
                    raise
                raise ValueError(f"{self!r} was not given {', '.join(unset)}") from error
            if self._whole_groups:
                global_size = tuple(map(round_up, global_size, self.local_size))
            event = self.device.launch(self.kernel, global_size, self.local_size)
        if _recording.steps is not None:
            _recording.steps.append((self.kernel, values, global_size, self.local_size))
        profile = self.device.profile
        if profile is not None:
            given = dict(zip(self._place, values, strict=True))
            profile.record(event, self.kernel.function_name, given, global_size)

    def _merged(self, arguments):
        """The bound values with these in their places; a list, since it is made at every launch."""
        values, place = self._bound.copy(), self._place
        for name, value in arguments.items():
            if name not in place:
                unknown = ", ".join(arguments.keys() - place.keys())
                raise ValueError(f"{self!r} takes {', '.join(place)}, not {unknown}")
            if self._is_buffer[name] and hasattr(value, "base_data"):
                if value.offset:
                    raise ValueError(
                        f"{name} of {self!r} starts at byte {value.offset} of its buffer: kernels "
                        "need arrays that start at byte 0"
                    )
                value = value.base_data
            values[place[name]] = value
        return values

    def __repr__(self):
        return f"Launcher({self.kernel.function_name})"


class LaunchList:
    """The launches of a function: recorded at its first call, queued from the record at later ones.

    function: queues launches whose sizes, numbers and buffers stay the same; call `forget` where
        they change. What it uploads or copies is done once, unless through `queue_anew`. A launch
        takes 10 us of the host in place of 20 on two busy cores
    """

    def __init__(self, device, function):
        self._device, self._function, self._steps = device, function, None

    def __call__(self):
        """Queues the launches; a function that raises is not recorded."""
        if _recording.steps is not None or self._device.profile is not None:
            self._function()  # another list records, or launches are timed
        elif self._steps is not None:
            self._device.repeat(self._steps)
        else:
            _recording.steps = steps = []
            try:
                self._function()
                self._steps = steps
            finally:
                _recording.steps = None

    def forget(self):
        """Has the next call record anew."""
        self._steps = None


class _Recording(threading.local):
    steps: list | None = None  # of this thread, see Device.repeat


_recording = _Recording()


def queue_anew(function, *arguments):
    """Calls a function that LaunchLists must call each time, for instance because it locks."""
    steps, _recording.steps = _recording.steps, None
    try:
        function(*arguments)
    finally:
        _recording.steps = steps
    if steps is not None:
        steps.append((None, function, arguments, None))
