"""Compiles every kernel for GPUs that are absent, and says what each takes there.

    make gpu-builds [ARGS='sm_90 gfx90a --all']

A row is a kernel in the build that takes most of it on a target:

    group   work-items of its groups; `driver` where the driver chooses
    regs    registers of a work-item (Intel: of a thread and its lanes)
    spill   bytes of registers kept in memory, a work-item
    stack   bytes of private memory, a work-item
    local   bytes of local memory, a group
    waves   warps a multiprocessor, waves a SIMD or threads a vector engine, and of how many
    lanes   part of the lanes of its waves that a group fills

Exit status 1: a build failed, spills, has a stack or takes more local memory than 32 KiB. What is
known and kept, faults.py lists with the reason. Targets whose compiler is missing are named, and
with none left the status is 77.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from .compilers import TARGETS, BuildError, MissingCompilerError, Toolbox, compiler_for
from .faults import faults_of, is_fault
from .readings import Resources

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Row:
    """A kernel of a build on a target; `resources` is None where the build failed with `error`."""

    target: str
    file: str
    kernel: str
    dtype: str
    variant: str
    group: tuple[int, ...] | None
    resources: Resources | None = None
    waves: tuple[int, int] = (0, 0)
    lanes: float = 0.0
    error: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def faults(self):
        return ["does not build"] if self.resources is None else faults_of(self)

    def rank(self):
        """The larger, the worse."""
        r = self.resources
        if r is None:
            return (3,)
        wrong = self.faults
        return any(map(is_fault, wrong)) + bool(wrong), r.spill, r.stack, r.registers, r.local


def rows_of(build, compiler, stem):
    """The rows of one build on one target; its files begin with `stem`."""
    source = stem.with_suffix(".cl")
    source.write_text(build.text)
    head = {"target": compiler.name, "file": build.file, "dtype": build.dtype}
    head["variant"] = build.variant
    try:
        found, said = compiler.compile(source, stem)
    except BuildError as error:
        return [Row(kernel="*", group=None, error=str(error), **head)]
    rows = []
    for name, groups in build.groups.items():
        for group in groups:
            size, one = math.prod(group or (64,)), found[name]
            wave = compiler.wave or one.lanes
            rows.append(
                Row(
                    kernel=name,
                    group=group,
                    resources=one,
                    waves=compiler.waves(one, size),
                    lanes=size / (-(-size // wave) * wave),
                    warnings=tuple(said),
                    **head,
                )
            )
    return rows


def worst(rows):
    """Of a kernel's rows on a target and in a type the one that takes most."""
    found = {}
    for row in rows:
        key = row.target, row.file, row.kernel, row.dtype
        if key not in found or row.rank() > found[key].rank():
            found[key] = row
    return [found[key] for key in sorted(found, key=lambda k: (TARGETS + k[:1]).index(k[0]))]


HEAD = (
    f"{'target':8} {'kernel':32} {'type':4} {'build':34} {'group':7} "
    f"{'regs':>7} spill stack  local waves lanes"
)


def line(row):
    """A row as text."""
    file = row.file.removesuffix(".cl")
    name = file if row.kernel == file else f"{file} {row.kernel}"
    head = f"{row.target:8} {name:32.32} f{row.dtype[5:]:3} {row.variant or '-':34.34}"
    r = row.resources
    if r is None:
        return f"{head} FAILED\n{row.error}"
    group = "x".join(map(str, row.group)).removesuffix("x1") if row.group else "driver"
    registers = f"{r.registers}/{r.lanes}" if r.lanes else str(r.registers)
    return (
        f"{head} {group:7} {registers:>7} {r.spill:5} {r.stack:5} {r.local:6} "
        f"{row.waves[0]:2}/{row.waves[1]:<2} {row.lanes:5.0%} {'; '.join(row.faults)}"
    ).rstrip()


def available(names, tools):
    """The compilers of those targets whose programs are here; the others are named."""
    found = []
    for name in names:
        try:
            found.append(compiler_for(name, tools))
        except MissingCompilerError as error:
            print(f"gpu-builds: {name} left out: {error}", flush=True)
    return found


def compiled(compilers, jobs):
    """The rows of all builds with all compilers."""
    for folder in (ROOT, ROOT / "tests", ROOT / "tools"):
        sys.path.insert(0, str(folder))
    with tempfile.TemporaryDirectory() as name:
        os.environ["CLRESAMPLE_CACHE"] = name  # no sizes that were tuned here
        warnings.simplefilter("ignore")
        import grind

        from clresample import get_device

        from .captured import captured_builds, contraction_builds

        shared = captured_builds(grind.WORKS)
        tasks = [(c, build.for_vendor(c.vendor)) for c in compilers for build in shared]
        for compiler in compilers:
            own = contraction_builds(get_device(), compiler.vendor)
            tasks += [(compiler, build) for build in own]
        with ThreadPoolExecutor(jobs) as pool:
            made = [
                pool.submit(rows_of, build, compiler, Path(name) / f"{i}-{compiler.name}")
                for i, (compiler, build) in enumerate(tasks)
            ]
            return len(tasks), [row for one in made for row in one.result()]


def main(arguments=None):
    """Prints the table; the exit status."""
    parser = argparse.ArgumentParser("gpu-builds", description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", default=TARGETS, help="all where none is named")
    parser.add_argument("--all", action="store_true", help="every build of a kernel")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="compilers at a time")
    given = parser.parse_args(arguments)
    packages = os.environ.get("GPU_COMPILERS_PYTHON")
    tools = Toolbox(os.environ.get("GPU_COMPILERS"), [packages] if packages else [])
    compilers = available(given.targets, tools)
    if not compilers:
        print("skipped: gpu-builds: no compiler for any of its targets is here", file=sys.stderr)
        return 77
    n_builds, rows = compiled(compilers, given.jobs)
    print(HEAD)
    for row in rows if given.all else worst(rows):
        print(line(row))
    for words in sorted({(row.file, said) for row in rows for said in row.warnings}):
        print("warning:", *words)
    wrong = sum(any(map(is_fault, row.faults)) for row in rows)
    names = ", ".join(c.name for c in compilers)
    print(f"gpu-builds: {n_builds} builds, {len(rows)} kernels on {names}; {wrong} at fault")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
