"""Sizes that depend on the device: tiles, group sizes, memory of one launch.

Measured on CPUs through PoCL; the values for other devices follow from their documents and are the
first to measure on a GPU. Kernels get these sizes as macros; none is written in a kernel too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .gpu_sizes import gpu_sizes, gpu_vendor
from .pocl_cpu_name import set_pocl_cpu_name

# Groups of a launch along its second and third axis, which GPUs limit to so many: NVIDIA's compute
# capabilities list it, Mesa's drivers have the same.
MAX_GROUPS = 65535
# Mesa's driver for CPUs, llvmpipe, counts the iterations of all loops of a work-item in a launch;
# after 65,535 of them it ends every loop at once, and reports no error.
LLVMPIPE_LOOPS = 65535
# Processors, as PoCL's compiler names them and its device's version ends, for which it makes code
# of 16 registers, whatever width of vectors PoCL reports.
NARROW = ("haswell", "znver1", "znver2", "znver3")


@dataclass(frozen=True)
class Tuning:
    """Sizes for one device and floating type; `Tuning.of` chooses them.

    tile: macros of contract.cl: VW columns a vector, NV vectors and MR rows a work-item owns,
        WGX x WGY work-items a group. Larger tiles load less for each product, until they spill.
        With KB, the terms of a slab in local memory, they are macros of contract_group.cl
    row_choices: MR of a tile may be one of these instead, where a matrix then has fewer rows that
        are computed and not stored
    two_sum_rows: MR at most where a product sums stretches first, which takes twice the registers
    box_tile: macros of boxed.cl, where boxes are lower than frames; None takes the tile
    row_loops: one work-item takes a whole row of pixels, as a CPU's vector unit wants it; else one
        takes a pixel
    prefetch_columns: the contraction fetches the right factor's next columns while it multiplies.
        Without it, a CPU takes 15 to 20 % longer for a batch that is not in its cache
    sum_group: work-items that share one sum over a box or one sweep: 1 needs no barrier
    line_group: work-items of a group along an image row where a kernel has no loop of its own.
        Left to choose, CPU runtimes take another number for every image size and build the kernel
        anew for each, 0.1 to 0.3 s
    tile_group, item_group: groups of kernels over a matrix, and over items that each have a loop
    lanes: columns that a work-item of shift.cl takes at a time, one vector: 4, 8 or 16
    group_bytes [bytes]: intermediate matrices of one launch of the operator; more images than fit
        go in several launches
    slab_bytes [bytes]: shifted model of one slab of the paper's scheme
    chunk_terms: terms that a work-item of the paper's contraction sums; 16 columns of so many stay
        in a core's cache, where they are read again for each row
    tile_flops, pixel_flops: what a tile of a frame costs beside its arithmetic, as the arithmetic
        that takes as long: launches and the tables of its shift; each pixel's way out of the frame
        and back. Larger values make larger tiles
    vector_chunk: elements of a vector that one sum of lbfgs.cl runs over; on CPUs what stays in the
        first cache with all that it is multiplied by
    use_folded: small float32 images go through float64 in parts even and odd about their middles,
        where the device has it: as fast as float32 on CPUs, which do half as many a second, not on
            GPUs
    n_scenes: scenes fitted side by side; more hide the launches better, and need more memory
    prefetch_groups: a group of fits is prepared and uploaded by a second thread while another
        iterates; where the device is the CPU itself, both would share its cores
    max_loop_iterations: iterations of all its loops that a work-item may make in one launch; None
        where a device has no such limit
    memory [bytes]: of the device for one frame in tiles, unless a caller says otherwise. With less,
        tiles are smaller and overlap more; most instruments' quickest tiles take less than 1 GiB
    """

    tile: dict[str, int]
    row_choices: tuple[int, ...]
    two_sum_rows: int
    box_tile: dict[str, int] | None
    row_loops: bool
    prefetch_columns: bool
    sum_group: int
    line_group: int
    tile_group: tuple[int, int, int]
    item_group: tuple[int, int]
    lanes: int
    group_bytes: int
    slab_bytes: int
    chunk_terms: int
    tile_flops: float
    pixel_flops: float
    vector_chunk: int
    use_folded: bool
    n_scenes: int
    prefetch_groups: bool
    max_loop_iterations: int | None
    memory: int

    @classmethod
    def of(cls, device, dtype=np.float32) -> Tuning:
        """The sizes for a Device and float32 or float64: those `clresample tune` kept, if any."""
        return replace(cls.untuned(device, dtype), **tuned(device, dtype))

    @classmethod
    def untuned(cls, device, dtype=np.float32) -> Tuning:
        """Default sizes for a device that has not been measured."""
        shared = {
            "line_group": 32,  # one warp of a GPU
            "chunk_terms": 1024,
            "tile_flops": 4e7,  # 1 ms, where PoCL does 40 Gflop/s
            "pixel_flops": 80.0,  # 2 ns
            "max_loop_iterations": LLVMPIPE_LOOPS if "llvmpipe" in device.name else None,
            "memory": min(1 << 30, device.memory // 4),
        }
        # Drivers that draw on the CPU compile as for a GPU, with many work-items at a time; and a
        # work-item that walks a whole box alone soon makes more loops than Mesa's allows.
        if device.kind == "CPU" and not device.simulated:
            return cls(
                tile=_cpu_tile(device, np.dtype(dtype)),
                row_choices=(),
                two_sum_rows=16,
                box_tile=None,
                lanes=8,
                row_loops=True,
                prefetch_columns=True,
                tile_group=(8, 1, 1),  # fewer cost more in starting them, more are cut off
                item_group=(1, 1),
                sum_group=1,
                group_bytes=4 << 20,  # in the cache, where they are read back at speed
                slab_bytes=2 << 20,  # what one core has in its cache
                vector_chunk=512,
                use_folded=True,
                n_scenes=32,  # more leave the cache, fewer do not hide the launches
                prefetch_groups=False,
                **shared,
            )
        return cls(
            **gpu_sizes(gpu_vendor(device.cl.vendor), dtype),
            row_loops=False,
            prefetch_columns=False,
            tile_group=(8, 8, 1),
            item_group=(32, 1),
            sum_group=64,  # what every GPU allows
            group_bytes=1 << 30,  # the whole batch in flight
            slab_bytes=256 << 20,
            vector_chunk=4096,  # some for each work-item of a group
            use_folded=False,
            n_scenes=1024,
            prefetch_groups=not device.simulated,
            **shared,
        )

    def tile_for(self, n_rows=None, *, two_sums=False) -> dict[str, int]:
        """The tile for matrices of `n_rows`, or of most: of those allowed, what covers them best.

        two_sums: the product sums stretches first
        """

        def covered(rows):
            group = rows * self.tile["WGY"]
            return -(-n_rows // group) * group, -rows

        choices = {*self.row_choices, self.tile["MR"]}
        if two_sums:
            choices = {rows for rows in choices if rows <= self.two_sum_rows} or choices
        if n_rows is None:
            middle = self.tile["MR"]
            return self.tile | {"MR": middle if middle in choices else max(choices)}
        return self.tile | {"MR": min(choices, key=covered)}

    @property
    def tile_for_boxes(self) -> dict[str, int]:
        """The tile of boxed.cl."""
        return self.box_tile or self.tile

    def tile_for_columns(self, n, n_pad) -> dict[str, int]:
        """The tile for rows of `n` columns, of `n_pad` in whole vectors, on CPUs.

        Where the last of few float32 vectors is half empty or more: two half as wide, of which that
        one is not summed. With more columns it gains less than the 2 % that the two take longer.
        """
        tile = self.tile
        if tile["VW"] == 16 and tile["NV"] == 1 and n <= 128 and 1 <= n % 16 <= 8:
            return tile | {"VW": 8, "NV": 2}
        return tile

    def local_size(self, n_axes):
        """Group of a kernel with a work-item for each item (1 axis), or row or pixel (3 axes).

        Groups of one on CPUs: left to choose, their runtimes take another size for every box and
        build each kernel anew for it, 0.6 s in all. On GPUs neighbours in a row read together, and
        two warps of 32 make a group that every GPU allows.
        """
        return (1,) * n_axes if self.row_loops else {1: (64,), 3: (32, 2, 1)}[n_axes]


def _cpu_tile(device, dtype) -> dict[str, int]:
    """Eight rows of two vectors use the 32 registers of AVX-512 and load little for each product.

    Elsewhere 16 registers hold six rows of one.
    """
    built_for = set_pocl_cpu_name(device.cl) or device.cl.version
    wide = device.cl.native_vector_width_float >= 16 and not built_for.endswith(NARROW)
    rows = {"NV": 2, "MR": 8} if wide else {"NV": 1, "MR": 6}
    return {"VW": 16 if dtype == np.float32 else 8, **rows, "WGX": 1, "WGY": 1}


# Sizes that `clresample tune` measures, and what each of them may be.
TUNABLE = {
    "tile": lambda tile: is_tile(tile),  # defined below
    "row_choices": lambda rows: all(n in range(2, 17, 2) for n in rows),
    "group_bytes": lambda n: isinstance(n, int) and 1 << 16 <= n <= 1 << 34,
    "n_scenes": lambda n: isinstance(n, int) and 1 <= n <= 1 << 16,
}
PART = "sizes"


def is_tile(tile):
    """True of macros with which one of the contraction kernels builds on any device."""
    names = {"VW", "NV", "MR", "WGX", "WGY"}
    if not names <= set(tile) <= {*names, "KB"} or not all(type(n) is int for n in tile.values()):
        return False
    fits = tile["VW"] in (2, 4, 8, 16) and 1 <= tile["NV"] <= 8 and tile["MR"] in range(2, 17, 2)
    slab = tile.get("KB", 64)
    whole = slab in range(1, 65) and slab % tile["WGX"] == slab % tile["WGY"] == 0
    return fits and whole and 1 <= tile["WGX"] * tile["WGY"] <= 256


def tuned(device, dtype):
    """Sizes that `clresample tune` has kept for a device, its kind and a type: {name: size}."""
    kept = device.remembered.read(PART)
    if kept is None:
        return {}
    try:
        sizes = dict(kept.get(device.kind, {}).get(np.dtype(dtype).name, {}))
        if all(name in TUNABLE and TUNABLE[name](size) for name, size in sizes.items()):
            return {n: tuple(s) if n == "row_choices" else s for n, s in sizes.items()}
    except (TypeError, ValueError, AttributeError, KeyError):
        pass
    device.remembered.invalidate(PART, "its sizes are none that `clresample tune` keeps")
    return {}
