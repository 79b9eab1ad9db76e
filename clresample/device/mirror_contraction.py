"""Products with mirror-symmetric tables of waves, in half the operations."""

from __future__ import annotations

from .contraction import ROW_TILES, Contraction, round_up_columns
from .tuning import Tuning

FILE, BACK_FILE = "mirror_to_waves.cl", "mirror_to_pixels.cl"
# Tiles that a work-item of X W^T computes, one below the other: the sums and differences of their
# rows stay in its core's first cache. With 2, products take a quarter longer. More tiles would
# leave fewer work-items of a single image for many cores.
OF_ROWS = 4
# The same for W X, where all tiles share the sums and differences of their columns. With 8,
# products take up to 10 % longer.
OF_COLUMNS = 16


def fourier_contraction(
    device, dtype, side, *, back=False, mirrored=True, tuning=None, **options
) -> Contraction:
    """Fastest Contraction for one factor that is a table of waves (2 h, n), or its transpose.

    Rows 2i, 2i + 1 are the cosines and sines of frequency i.

    side: "left" or "right", the factor that is the table
    back: from waves to pixels, Z W or W^T Z; else to waves, X W^T or W X
    mirrored: True if all tables are symmetric, see `sky.fourier.is_mirror_symmetric`
    tuning, options: as for Contraction
    """
    options["tuning"] = tuning or Tuning.of(device, dtype)
    if not mirrored or not is_supported(options["tuning"]):
        return Contraction(device, dtype, **options)
    return MirrorContraction(device, dtype, side, back=back, **options)


def is_supported(tuning) -> bool:
    """Returns True for CPUs with one work-item a group, for which the kernels are written."""
    return tuning.row_loops and "KB" not in tuning.tile


class MirrorContraction(Contraction):
    """A Contraction with a table of waves as one of its factors; see kernels/mirror.h, for CPUs.

    The order of its sums is fixed: `inward` of `bind` has no effect.

    side, back: see `fourier_contraction`
    """

    def __init__(self, device, dtype, side, *, back=False, **options):
        super().__init__(device, dtype, **options)
        self.right, self.back = side == "right", back
        self.options |= {"SIDE": int(self.right)}

    def build(self, n_rows=None, n_terms=0, n=0):
        """See `Contraction.build`; n_rows does not matter."""
        n = self._columns(n)
        own = {"RT": ROW_TILES, "READ_AHEAD": self.tuning.prefetch_columns}
        if not self.back:
            own["RT"] = OF_ROWS if self.right else OF_COLUMNS
        file = BACK_FILE if self.back else FILE
        return file, self.options | own | self.tuning.tile_for_columns(n, round_up_columns(n))

    def _columns(self, n):
        """Number of columns that are summed, of n: if columns mirror each other, the first half."""
        return -(-n // 2) if self.right and self.back else n

    def _extent(self, tile, n):
        """Rows and columns of C computed by one work-item, and columns computed by all."""
        rows, columns = tile["MR"] * tile["RT"], tile["NV"] * tile["VW"]
        if self.back:
            return rows // 2 if self.right else rows, columns, round_up_columns(self._columns(n))
        return rows, columns, columns if self.right else round_up_columns(n)

    def _order(self, k, inward):
        return {}


def operator_programs(device, dtype):
    """Builds needed by operators between aligned or rotated images.

    All pixels of the images must lie on the model.

    returns [(file, dtype, macros)], the requests of `Device.build_ahead`
    """
    products = [
        fourier_contraction(device, dtype, "right"),
        fourier_contraction(device, dtype, "left", epilogue="MIX"),
        fourier_contraction(device, dtype, "left", back=True),
        fourier_contraction(device, dtype, "right", back=True, ragged=True),
        Contraction(device, dtype, epilogue="TWIST"),
    ]
    builds = [product.build() for product in products]
    return [(file, dtype, macros) for file, macros in builds]
