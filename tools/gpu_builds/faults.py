"""What a kernel may not take on a GPU, and what is known and kept."""

from __future__ import annotations

# The least local memory of a group that OpenCL promises.
MAX_LOCAL_BYTES = 32 << 10
# Private memory [bytes] that a kernel may have on any target, beside no spill. These are small
# arrays that are indexed once, after the loop: written out they take 100 registers more.
KEPT_STACK = {
    ("start.cl", "gram"): 104,
    ("start.cl", "pull"): 40,
    ("draw.cl", "draw"): 24,
}
KEPT = "kept: "


def is_fault(words):
    """True of words of `faults_of` that are not of something kept."""
    return not words.startswith(KEPT)


def faults_of(row):
    """What is wrong with a kernel on a target, in words; those that begin with KEPT are known."""
    one, found = row.resources, []
    if one.spill:
        found.append(f"spills {one.spill}")
    if one.stack > one.spill:
        kept = one.stack <= KEPT_STACK.get((row.file, row.kernel), 0)
        found.append(f"{KEPT if kept else ''}stack {one.stack}")
    if one.local > MAX_LOCAL_BYTES:
        found.append(f"local {one.local} > {MAX_LOCAL_BYTES}")
    return found
