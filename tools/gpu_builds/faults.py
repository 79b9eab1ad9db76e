"""Limits of a kernel's resources on a GPU, and accepted exceptions."""

from __future__ import annotations

from dataclasses import dataclass

# The least local memory of a group that OpenCL promises.
MAX_LOCAL_BYTES = 32 << 10
KEPT = "kept: "


@dataclass(frozen=True)
class Kept:
    """An accepted exception: resources that a kernel may take beyond the limits, with the reason.

    target: "" for any; spill, stack [bytes]: at most
    """

    target: str
    file: str
    kernel: str
    dtype: str
    spill: int
    stack: int
    reason: str

    def holds(self, row):
        """True where a row takes no more than this."""
        one = row.resources
        same = (self.file, self.kernel, self.dtype) == (row.file, row.kernel, row.dtype)
        within = one.spill <= self.spill and one.stack <= self.stack
        return same and self.target in ("", row.target) and within


ARRAY = "an array that is indexed once, after the loop; written out it takes 100 registers"
DOUBLE = "float64 is asked for in no fit by itself, and a spill of few registers is in the L1 cache"
PAPER = "the paper's scheme, which no fit uses"
LANE = "a vector that is stored by element, after the loop"

KEPT_KERNELS = (
    Kept("", "start.cl", "gram", "float32", 0, 104, ARRAY),
    Kept("", "start.cl", "residual_products", "float32", 0, 40, ARRAY),
    Kept("", "draw.cl", "draw_profiles", "float32", 0, 24, ARRAY),
    Kept("pvc", "start.cl", "gram", "float32", 0, 512, ARRAY),
    Kept("pvc", "start.cl", "residual_products", "float32", 0, 128, ARRAY),
    Kept("pvc", "boxed.cl", "multiply_boxes", "float32", 0, 16, LANE),
    Kept("pvc", "shift.cl", "unshift_plane", "float32", 40, 64, PAPER),
    Kept("pvc", "contract_group.cl", "contract_group", "float64", 32, 32, DOUBLE),
)


def is_fault(words):
    """True of words of `faults_of` that are not of something kept."""
    return not words.startswith(KEPT)


def faults_of(row):
    """Faults of a kernel on a target, in words; accepted ones begin with KEPT."""
    one, found = row.resources, []
    kept = KEPT if any(entry.holds(row) for entry in KEPT_KERNELS) else ""
    if one.spill:
        found.append(f"{kept}spills {one.spill}")
    if one.stack > one.spill:
        found.append(f"{kept}stack {one.stack}")
    if one.local > MAX_LOCAL_BYTES:
        found.append(f"local {one.local} > {MAX_LOCAL_BYTES}")
    return found
