"""The builds that a GPU's driver would be given, noted while every kernel runs on this machine.

A Build is a text with its macros, and the groups that its kernels are launched in. Those of the
contraction, whose tile depends on the vendor, are listed instead of noted: all heights of tiles,
stages after the product and layouts, few terms and many, in float32 and float64.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field, replace

import numpy as np

from clresample import get_device
from clresample.device.contraction import GROUP_FILE, ONE_SUM, Contraction
from clresample.device.device import Device
from clresample.device.gpu_sizes import gpu_sizes
from clresample.device.program import Launcher, source_of
from clresample.device.tuning import Tuning

BOXED_FILE = "boxed.cl"
# (epilogue, adjoint, ragged, strided) of the products that operators and fits ask for.
LAYOUTS = (
    (None, False, False, False),
    (None, False, False, True),
    (None, False, True, False),
    ("MIX", False, False, False),
    ("MIX", True, False, False),
    ("TWIST", False, False, False),
    ("TWIST", True, False, False),
)
# Macros that are the same in all builds of a file, or that say nothing of its size.
COMMON = {"WG", "ALIGN", "N_SCALES", "RADII", "STEPS", "TAPS", "MARGIN", "MOST", "PANEL", "LANES"}


@dataclass
class Build:
    """One text as a driver compiles it.

    groups {kernel: set}: work-items along each axis of its launches; None where a driver chooses
    """

    file: str
    dtype: str
    text: str
    macros: dict
    groups: dict[str, set] = field(default_factory=dict)

    @property
    def variant(self):
        """The macros that tell it from other builds of its file, in short."""
        return " ".join(
            name if value is True else f"{name}={value}"
            for name, value in self.macros.items()
            if name not in COMMON and (name, value) != ("SIGN", 1)
        )

    def for_vendor(self, vendor):
        """The same with a vendor's sizes: of products of boxes, and of columns side by side."""
        sizes, groups = gpu_sizes(vendor, self.dtype), self.groups
        macros = dict(self.macros)
        if self.file == BOXED_FILE:
            macros |= sizes["box_tile"]
            groups = {name: {(macros["WGX"], macros["WGY"], 1)} for name in groups}
        if "LANES" in macros:
            macros["LANES"] = sizes["lanes"]
        text = source_of(self.file, self.dtype, macros)
        return replace(self, text=text, macros=macros, groups=groups)


class Notebook:
    """Notes what is built and launched from `watch` on, by text."""

    def __init__(self):
        self.builds: dict[str, Build] = {}

    def note(self, file, dtype, defines):
        """The Build of a text, made at its first mention."""
        given = {k: v for k, v in defines.items() if v is not None and v is not False}
        text = source_of(file, dtype, defines)
        return self.builds.setdefault(text, Build(file, np.dtype(dtype).name, text, given))

    def watch(self):
        """Has devices pose as GPUs that are none of a CPU's, and notes their launches."""
        opened, made, launch, notebook = Device.__init__, Device.launcher, Launcher.__call__, self

        def as_gpu(device, cl_device):
            opened(device, cl_device)
            device.kind, device.simulated = "GPU", False

        def launcher(device, file, name, *, dtype=np.float32, local_size=None, **defines):
            one = made(device, file, name, dtype=dtype, local_size=local_size, **defines)
            one.groups = notebook.note(file, dtype, defines).groups.setdefault(name, set())
            return one

        def noted(one, *arguments, **given):
            one.groups.add(one.local_size and tuple(one.local_size))
            launch(one, *arguments, **given)

        Device.__init__, Device.launcher, Launcher.__call__ = as_gpu, launcher, noted


def captured_builds(works):
    """The builds of `works`, functions of a device, but those of the contraction."""
    notebook = Notebook()
    notebook.watch()
    device = get_device()
    for work in works:
        work(device)
        device.finish()
    return [b for b in notebook.builds.values() if b.file != GROUP_FILE]


def contraction_builds(device, vendor):
    """The builds of the contraction for GPUs of a vendor: "NVIDIA", "AMD" or "Intel"."""
    notebook = Notebook()
    for dtype, layout in itertools.product((np.float32, np.float64), LAYOUTS):
        epilogue, adjoint, ragged, strided = layout
        tuning = replace(Tuning.untuned(device, dtype), **gpu_sizes(vendor, dtype))
        product = Contraction(
            device,
            np.dtype(dtype),
            epilogue=epilogue,
            adjoint=adjoint,
            ragged=ragged,
            strided=strided,
            tuning=tuning,
        )
        group = tuning.tile["WGY"]
        heights = sorted({*tuning.row_choices, tuning.tile["MR"]})
        for rows, terms, own in itertools.product(heights, (64, 2 * ONE_SUM), (False, True)):
            file, macros = product.build(rows * group, terms, 64)
            build = notebook.note(file, dtype, macros | {"OWN": own})
            size = (macros["WGX"], macros["WGY"], 1)
            build.groups[file.removesuffix(".cl")] = {size}
    return list(notebook.builds.values())


def kernel_names(text):
    """The kernels of a text, in its order."""
    bare = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return re.findall(r"__kernel\b[^;{]*?\bvoid\s+(\w+)", bare)
