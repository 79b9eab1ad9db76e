"""Resources of kernels, read from the reports of compilers for GPUs."""

from __future__ import annotations

import re
from dataclasses import dataclass

# Work-items of Intel's registers: 64 bytes each on Ponte Vecchio.
INTEL_REGISTER_BYTES = 64


@dataclass(frozen=True)
class Resources:
    """Resources of one kernel on one target.

    registers: of a work-item; on AMD vector registers, on Intel those of a thread
    spill, stack [bytes]: of a work-item: registers kept in memory; all private memory, spills
        and indexed arrays
    local [bytes]: local memory of a group
    lanes: work-items of a hardware thread, where the compiler chooses it; else 0
    waves: hardware threads that fit beside each other, where the compiler says so; else 0
    """

    registers: int
    spill: int
    stack: int
    local: int
    lanes: int = 0
    waves: int = 0


def _number(pattern, text):
    """The number that a pattern's group finds in a text; ValueError where there is none."""
    found = re.search(pattern, text, re.MULTILINE)
    if found is None:
        raise ValueError(f"the compiler's words have no {pattern!r}; its format has changed")
    return int(found[1])


def read_ptxas(words):
    """{kernel: Resources} of `ptxas -v`; ValueError where a number is missing."""
    found = {}
    for part in words.split("Compiling entry function '")[1:]:
        local = re.search(r"(\d+) bytes smem", part)  # not printed where it is 0
        found[part.split("'", 1)[0]] = Resources(
            registers=_number(r"Used (\d+) registers", part),
            spill=_number(r"(\d+) bytes spill stores", part),
            stack=_number(r"(\d+) bytes stack frame", part),
            local=int(local[1]) if local else 0,
        )
    return found


def read_amd(assembly):
    """{kernel: Resources} of Clang's assembly for AMD; ValueError where a number is missing."""
    metadata = assembly.split(".amdgpu_metadata")[1]
    found = {}
    for part in re.split(r"^  - (?=\.)", metadata, flags=re.MULTILINE)[1:]:
        name = re.search(r"^    \.name: +(\w+)", part, re.MULTILINE)
        if name is None:
            continue  # a list of another kind
        body = assembly[assembly.index(f"\n{name[1]}:") :]
        found[name[1]] = Resources(
            registers=_number(r"\.vgpr_count: +(\d+)", part),
            spill=4 * _number(r"\.vgpr_spill_count: +(\d+)", part),
            stack=_number(r"\.private_segment_fixed_size: +(\d+)", part),
            local=_number(r"\.group_segment_fixed_size: +(\d+)", part),
            waves=_number(r"^; Occupancy: (\d+)", body),
        )
    return found


def read_intel(info, words):
    """{kernel: Resources} of the section .ze_info of a binary and what ocloc said beside it."""
    found = {}
    for part in info.split("kernels_misc_info")[0].split("\n  - name:")[1:]:
        name = part.split("\n", 1)[0].strip()
        lanes = _number(r"simd_size: +(\d+)", part)
        spilled = re.search(rf"kernel {name}\s.*spilled around (\d+)", words)
        scratch = re.findall(r"- type: +scratch\s+usage: +\w+\s+size: +(\d+)", part)
        local = re.search(r"slm_size: +(\d+)", part)
        found[name] = Resources(
            registers=_number(r"grf_count: +(\d+)", part),
            spill=int(spilled[1]) * INTEL_REGISTER_BYTES // lanes if spilled else 0,
            stack=sum(map(int, scratch)) // lanes,
            local=int(local[1]) if local else 0,
            lanes=lanes,
        )
    return found


def warnings_of(words):
    """Warnings of a compiler, without those about the names of the target's libraries."""
    noise = re.compile(r"linking module|Linking two modules|-Wlinker-warnings|compiled SIMD")
    return sorted({w for w in re.findall(r"warning: (.+)", words) if not noise.search(w)})
