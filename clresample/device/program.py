"""Kernel sources as text: where they lie, their includes, macros and build logs."""

from __future__ import annotations

import functools
import re
from pathlib import Path

from .discovery import DeviceError


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


def define_line(name, value):
    if value is None or value is False:
        return None
    return f"#define {name} {1 if value is True else value}"


def build_log(error):
    """The compiler's own words out of pyopencl's message."""
    log = re.sub(r"\(options: .*\)\s*$", "", str(error).split(">:\n", 1)[-1], flags=re.DOTALL)
    return log.strip()
