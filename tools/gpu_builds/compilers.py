"""Compilers for GPUs of NVIDIA, AMD and Intel, from their packages; no GPU is needed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

from .readings import read_amd, read_intel, read_ptxas, warnings_of

# Versions of Clang with all targets, newest that was tried first.
CLANGS = (19, 20, 21, 18)
TARGETS = ("sm_90", "gfx90a", "gfx1100", "pvc")


class BuildError(Exception):
    """A text that does not compile, with the compiler's words."""


class MissingCompilerError(Exception):
    """A program or a library that a target needs, and the package that has it."""


class Toolbox:
    """Programs and libraries of compilers, unpacked in a folder or installed.

    root: folder of unpacked Debian packages, which is looked at first; None for those installed
    packages: folders of Python packages, one of which may hold ptxas
    """

    def __init__(self, root=None, packages=()):
        self.roots = [*([Path(root)] if root else []), Path("/")]
        self.packages = [*map(Path, packages), Path(sysconfig.get_paths()["purelib"])]
        libraries = [self.roots[0] / "usr/lib" / part for part in (self._arch(), "llvm-19/lib")]
        known = os.environ.get("LD_LIBRARY_PATH")
        path = ":".join([*map(str, libraries), *([known] if known else [])])
        self.environment = os.environ | ({"LD_LIBRARY_PATH": path} if root else {})

    def program(self, names, package):
        """The path of the first program found; MissingCompilerError where there is none."""
        for name in names:
            for folder in [root / "usr/bin" for root in self.roots[:-1]]:
                if (folder / name).is_file():
                    return str(folder / name)
            found = shutil.which(name) or next(self._beside(name), None)
            if found:
                return str(found)
        raise MissingCompilerError(f"no {names[0]}, which the package {package} has")

    def bitcode(self, folder, name, package):
        """The path of a library in LLVM's code; MissingCompilerError where it is not there."""
        for root in self.roots:
            if (root / folder / name).is_file():
                return root / folder / name
        raise MissingCompilerError(f"no {folder}/{name}, which the package {package} has")

    def run(self, *command):
        """All that a command prints; BuildError where it fails."""
        done = subprocess.run(
            list(map(str, command)),
            capture_output=True,
            text=True,
            errors="replace",
            env=self.environment,
            check=False,
        )
        if done.returncode:
            raise BuildError((done.stderr + done.stdout).strip()[-800:])
        return done.stderr + done.stdout

    def clang(self, options, libraries, source, out):
        """Compiles OpenCL C to assembly with optimisation, as drivers do; what Clang says.

        What the language does not have is an error, as for NVIDIA's driver, whose Clang is older.
        """
        names = [f"clang-{n}" for n in CLANGS] + ["clang"]
        command = [self.program(names, "clang-19"), "-x", "cl", "-cl-std=CL1.2", "-O3", "-S"]
        command += ["-Wall", "-Wno-unused", "-pedantic-errors"]
        command += ["-Xclang", "-finclude-default-header", *options]
        for path in libraries:
            command += ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", path]
        return self.run(*command, source, "-o", out)

    def _beside(self, name):
        for folder in self.packages:
            yield from sorted(folder.glob(f"nvidia/*/bin/{name}"))

    @staticmethod
    def _arch():
        return f"{os.uname().machine}-linux-gnu"


class Nvidia:
    """Clang to PTX and ptxas to machine code: NVIDIA's driver has another front end before it."""

    vendor = "NVIDIA"
    wave, max_waves, max_groups = 32, 64, 32  # of a multiprocessor, compute capability 9.0
    registers, local_bytes, reserved_bytes = 65536, 227 << 10, 1 << 10

    def __init__(self, name, tools):
        self.name, self.tools = name, tools
        self.library = tools.bitcode("usr/lib/clc", "nvptx64--nvidiacl.bc", "libclc-19")
        self.ptxas = tools.program(["ptxas"], "nvidia-cuda-nvcc of PyPI")
        tools.program([f"clang-{n}" for n in CLANGS] + ["clang"], "clang-19")

    def compile(self, source, stem):
        """({kernel: Resources}, warnings) of a file."""
        ptx = stem.with_suffix(".ptx")
        options = ["-target", "nvptx64-nvidia-nvcl", f"-march={self.name}"]
        said = self.tools.clang(options, [self.library], source, ptx)
        binary = stem.with_suffix(".cubin")
        words = self.tools.run(self.ptxas, f"-arch={self.name}", "-v", ptx, "-o", binary)
        return read_ptxas(words), warnings_of(said)

    def waves(self, one, size):
        """(warps that a multiprocessor holds, at most) for groups of `size` work-items."""
        warps = -(-size // self.wave)
        # registers are given out in steps of 256 a warp
        of_warp = -(-one.registers * self.wave // 256) * 256
        by_registers = self.registers // of_warp // warps
        by_memory = self.local_bytes // (one.local + self.reserved_bytes)
        groups = min(self.max_groups, self.max_waves // warps, by_registers, by_memory)
        return groups * warps, self.max_waves


class Amd:
    """Clang with ROCm's device libraries, which is what AMD's driver is."""

    vendor = "AMD"

    def __init__(self, name, tools):
        self.name, self.tools = name, tools
        self.wave, self.max_waves = (32, 16) if name.startswith("gfx1") else (64, 8)
        # an older chip's library of the same family serves where there is none of its own
        older = "90a" if self.wave == 64 else "1030"
        parts = ["opencl", "ocml", "ockl", "oclc_abi_version_500", "oclc_unsafe_math_off"]
        parts += ["oclc_correctly_rounded_sqrt_off", "oclc_daz_opt_off", "oclc_finite_only_off"]
        parts += [f"oclc_wavefrontsize64_{'on' if self.wave == 64 else 'off'}"]
        try:
            isa = self._library(f"oclc_isa_version_{name.removeprefix('gfx')}")
        except MissingCompilerError:
            isa = self._library(f"oclc_isa_version_{older}")
        self.libraries = [*map(self._library, parts), isa]
        tools.program([f"clang-{n}" for n in CLANGS] + ["clang"], "clang-19")

    def _library(self, name):
        folder = f"usr/lib/{os.uname().machine}-linux-gnu/amdgcn/bitcode"
        return self.tools.bitcode(folder, f"{name}.bc", "rocm-device-libs")

    def compile(self, source, stem):
        """({kernel: Resources}, warnings) of a file."""
        out = stem.with_suffix(".s")
        options = ["-target", "amdgcn-amd-amdhsa", f"-mcpu={self.name}", "-nogpulib"]
        said = self.tools.clang(options, self.libraries, source, out)
        return read_amd(out.read_text()), warnings_of(said)

    def waves(self, one, size):
        """(waves that a SIMD holds, at most), as Clang says."""
        return one.waves, self.max_waves


class Intel:
    """Intel's own compiler, ocloc."""

    vendor = "Intel"
    wave, max_waves = 0, 8  # threads of a vector engine with 128 registers each

    def __init__(self, name, tools):
        self.name, self.tools = name, tools
        self.ocloc = tools.program(["ocloc"], "intel-opencl-icd")
        copies = [*(f"llvm-objcopy-{n}" for n in CLANGS), "llvm-objcopy", "objcopy"]
        self.objcopy = tools.program(copies, "llvm-19")

    def compile(self, source, stem):
        """({kernel: Resources}, warnings) of a file."""
        folder = stem.with_suffix(".out")
        folder.mkdir(exist_ok=True)
        command = [self.ocloc, "compile", "-file", source, "-device", self.name]
        command += ["-options", "-cl-std=CL1.2", "-internal_options", "-cl-intel-allow-zebin"]
        words = self.tools.run(*command, "-out_dir", folder, "-output", "kernels")
        (binary,) = folder.glob("*.bin")
        info = folder / "info"
        section = f"--dump-section=.ze_info={info}"
        self.tools.run(self.objcopy, "-O", "binary", section, binary, folder / "rest")
        return read_intel(info.read_text(errors="replace"), words), warnings_of(words)

    def waves(self, one, size):
        """(threads that a vector engine holds, at most): half with the large register file."""
        return self.max_waves * 128 // max(one.registers, 128), self.max_waves


def compiler_for(name, tools):
    """The compiler of a target; MissingCompilerError, or ValueError for a name of no vendor."""
    kinds = {r"sm_\d+a?": Nvidia, r"gfx[0-9a-f]+": Amd, r"[a-z].*": Intel}
    for pattern, kind in kinds.items():
        if re.fullmatch(pattern, name):
            return kind(name, tools)
    raise ValueError(f"target is {name!r}; it must be sm_NN, gfxNNN or a name that ocloc knows")
