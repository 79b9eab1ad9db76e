"""Sizes that depend on the device: tiles, group sizes, memory of one launch.

Sizes for CPUs were measured through PoCL. Those for GPUs follow from the vendors' documents and
from their compilers (gpu_sizes.py). Kernels get all of these sizes as macros.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .gpu_sizes import gpu_sizes, gpu_vendor
from .pocl_cpu_name import set_pocl_cpu_name
from .rounding import round_up

# Largest number of groups along the second and third axis of a launch: the limit of NVIDIA's
# compute capabilities and of Mesa's drivers.
MAX_GROUPS = 65535
# Processors for which PoCL compiles to 16 registers, whatever vector width it reports. The names
# are those of PoCL's compiler, with which the device's version string ends.
NARROW = ("haswell", "znver1", "znver2", "znver3")


@dataclass(frozen=True)
class Tuning:
    """Sizes for one device and floating type; `Tuning.of` chooses them.

    tile: macros of contract.cl: VW columns a vector, NV vectors and MR rows a work-item owns,
        WGX x WGY work-items a group. Larger tiles load less for each product, until they spill.
        With KB, the terms of a slab in local memory, they are macros of contract_group.cl
    row_choices: other values of MR, used if fewer rows of a matrix are then computed in vain
    two_sum_rows: largest MR of products with partial sums, which need twice the registers
    box_tile: macros of boxed.cl, whose boxes are lower than frames; None = those of `tile`
    row_loops: True = one work-item for each row of pixels, to fill a CPU's vectors; False = one for
        each pixel
    prefetch_columns: the contraction fetches the right factor's next columns while it multiplies.
        Without it, a CPU takes 15 to 20 % longer for a batch that is not in its cache
    sum_group: work-items that share one sum over a box or one sweep: 1 needs no barrier
    vector_group: the same for one sum over a long vector, a box of a source or a block; more
        work-items hide more of the memory's latency
    line_group: work-items of a group along an image row, for kernels without a loop. If it is not
        set, CPU runtimes choose another number for each image size and build the kernel again each
        time, which takes 0.1 to 0.3 s
    tile_group, item_group: groups of kernels over a matrix, and over items that each have a loop
    lanes: columns of a vector in shift.cl: 4, 8 or 16
    group_bytes [bytes]: intermediate matrices of one launch of the operator; more images than fit
        go in several launches
    slab_bytes [bytes]: shifted model of one slab of the paper's scheme
    chunk_terms: terms summed by one work-item of the paper's contraction; 16 columns of this many
        terms stay in a core's cache, where they are read again for each row
    tile_flops, pixel_flops [flop]: overheads of a tile of a frame in units of arithmetic: launches
        and shift tables for each tile, copies from and to the frame for each pixel. Larger values
        make larger tiles
    vector_chunk: elements of one partial sum of lbfgs.cl; on CPUs chosen so that they stay in the
        first cache together with their factors
    use_folded: small float32 images are computed in float64, in parts even and odd about their
        middles. On CPUs with float64 that is as fast as float32, since it needs half of the
        products and float64 has half the speed; on GPUs it is slower
    n_scenes: scenes fitted side by side; more hide the launches better, and need more memory
    start_sources: largest number of sources of one group of scenes, each of which takes up to 1 MB
        at the start, for its profile and slopes in all observations. A few dozen hide the cost of a
        launch on CPUs, a full batch on GPUs
    group_memory [bytes]: of the device for one group of scenes, by default
    prefetch_groups: a second thread prepares and uploads a group of fits while another group
        iterates; False if the device is the CPU, whose cores both would share
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
    vector_group: int
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
    start_sources: int
    group_memory: int
    prefetch_groups: bool
    memory: int

    @classmethod
    def of(cls, device, dtype=np.float32) -> Tuning:
        """Sizes for a Device and float32 or float64: those stored by `clresample tune`, if any."""
        return replace(cls.untuned(device, dtype), **tuned(device, dtype))

    @classmethod
    def untuned(cls, device, dtype=np.float32) -> Tuning:
        """Default sizes for a device that has not been measured."""
        shared = {
            "chunk_terms": 1024,
            "tile_flops": 4e7,  # 1 ms, where PoCL does 40 Gflop/s
            "pixel_flops": 80.0,  # 2 ns
            "memory": min(1 << 30, device.memory // 4),
        }
        # Software drivers on the CPU compile as for a GPU, with many work-items at a time. A
        # work-item that loops over a whole box alone would soon exceed Mesa's limit on iterations.
        if device.kind == "CPU" and not device.simulated:
            return cls(
                tile=_cpu_tile(device, np.dtype(dtype)),
                row_choices=(),
                two_sum_rows=16,
                box_tile=None,
                lanes=8,
                row_loops=True,
                prefetch_columns=True,
                tile_group=(8, 1, 1),  # fewer groups start slower, larger ones waste work-items
                item_group=(1, 1),
                sum_group=1,
                vector_group=1,
                line_group=32,
                group_bytes=4 << 20,  # in the cache, where they are read back at speed
                slab_bytes=2 << 20,  # what one core has in its cache
                vector_chunk=512,
                use_folded=True,
                n_scenes=32,  # more leave the cache, fewer do not hide the launches
                start_sources=500,
                group_memory=1 << 30,
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
            line_group=64,  # a wave of AMD's, two warps
            vector_group=256 if device.cl.max_work_group_size >= 256 else 64,
            group_bytes=1 << 30,  # the whole batch in flight
            slab_bytes=256 << 20,
            vector_chunk=1024,  # four for each work-item of a group
            use_folded=False,
            n_scenes=1024,
            start_sources=8192,
            group_memory=device.memory // 4,
            prefetch_groups=not device.simulated,
            **shared,
        )

    def tile_for(self, n_rows=None, *, two_sums=False) -> dict[str, int]:
        """The tile that covers matrices of `n_rows`, or many rows, with the fewest wasted rows.

        two_sums: the product has partial sums
        """

        def covered(rows):
            group = rows * self.tile["WGY"]
            return round_up(n_rows, group), -rows

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

        If at least half of the last float32 vector is empty and there are few vectors: two of half
        the width, of which the empty one is not summed. With more columns this gains less than the
        2 % that half vectors take longer.
        """
        tile = self.tile
        if tile["VW"] == 16 and tile["NV"] == 1 and n <= 128 and 1 <= n % 16 <= 8:
            return tile | {"VW": 8, "NV": 2}
        return tile

    def local_size(self, n_axes):
        """Group of a kernel with a work-item for each item (1 axis), or row or pixel (3 axes).

        One on CPUs, whose runtimes would otherwise choose another size for every box and build each
        kernel again, 0.6 s in all. On GPUs neighbours in a row read adjacent memory, and two warps
        of 32 make a group that every GPU permits.
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
    device.remembered.invalidate(PART, "its sizes are not those that `clresample tune` stores")
    return {}
