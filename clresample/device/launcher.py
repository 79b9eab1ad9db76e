"""Kernels launched with their arguments by name, as the kernel sources declare them."""

from __future__ import annotations

# The value of an argument that was never given: pyopencl refuses to set it.
UNSET = object()


class Launcher:
    """One kernel, some of its arguments bound; `Device.launcher` makes it.

        blur = device.launcher("update.cl", "blur", dtype=dtype).bind(table=table, taps=taps)
        blur((nx, ny, n_sources), v=latent)

    `bind` gives arguments that stay, a call those of one launch. A buffer is a pyopencl array that
    starts at its buffer's first byte, a pyopencl Buffer, or None where the kernel reads none. Bound
    buffers live as long as the launcher; OpenCL keeps those of a call until its kernel has run.

    All arguments are set before each launch, in one call to pyopencl: 1.5 us for 23 of them, where
    one number by itself takes 6 us. So nothing remembers what an earlier launch has set, and all
    launchers of one build share its pyopencl.Kernel, which takes 0.2 ms to make; `lock` keeps other
    threads away between setting and queueing.

    is_buffer {name: bool}: the kernel's arguments in its order
    local_size: work-items of a group along each axis of a launch; None leaves it to the driver
    """

    def __init__(self, device, kernel, is_buffer, lock, local_size=None):
        self.device, self.kernel, self.local_size = device, kernel, local_size
        self._whole_groups = local_size is not None and max(local_size) > 1
        self._is_buffer, self._lock = is_buffer, lock
        self._bound = dict.fromkeys(is_buffer, UNSET)  # in the kernel's order

    def bind(self, **arguments):
        """Give arguments that stay; returns the launcher. ValueError for an unknown name."""
        self._bound = self._merged(arguments)
        return self

    def __call__(self, global_size, **arguments):
        """Queue the kernel on `global_size` (x, y, z), `arguments` in place of what is bound.

        The size is rounded up to whole groups; kernels leave out the work-items beyond it.

        ValueError: a name that the kernel does not have, one that was never given, or an array
            that starts inside its buffer
        """
        values = (self._merged(arguments) if arguments else self._bound).values()
        with self._lock:
            try:
                self.kernel.set_args(*values)
            except Exception as error:
                unset = [n for n, v in zip(self._bound, values, strict=True) if v is UNSET]
                if not unset:
                    error.add_note(f"arguments of {self!r}: {', '.join(self._bound)}")
                    raise
                raise ValueError(f"{self!r} was not given {', '.join(unset)}") from error
            if self._whole_groups:
                global_size = tuple([-(-n // g) * g for n, g in zip(global_size, self.local_size)])
            event = self.device.launch(self.kernel, global_size, self.local_size)
        profile = self.device.profile
        if profile is not None:
            given = dict(zip(self._bound, values, strict=True))
            profile.note(event, self.kernel.function_name, given, global_size)

    def _merged(self, arguments):
        for name, value in arguments.items():
            if self._is_buffer.get(name) and hasattr(value, "base_data"):
                if value.offset:
                    raise ValueError(
                        f"{name} of {self!r} starts at byte {value.offset} of its buffer: kernels "
                        "take arrays from byte 0 on"
                    )
                arguments[name] = value.base_data
        merged = self._bound | arguments
        if len(merged) != len(self._bound):
            unknown = ", ".join(arguments.keys() - self._bound.keys())
            raise ValueError(f"{self!r} takes {', '.join(self._bound)}, not {unknown}")
        return merged

    def __repr__(self):
        return f"Launcher({self.kernel.function_name})"
