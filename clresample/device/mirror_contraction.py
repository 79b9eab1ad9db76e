"""Products with tables of waves at pixels that mirror each other, in half the operations."""

from __future__ import annotations

from .contraction import ROW_TILES, Contraction, round_up_columns
from .tuning import Tuning

FILE, BACK_FILE = "mirror_to_waves.cl", "mirror_to_pixels.cl"
# Tiles that a work-item of X W^T takes one below the other: the sums and differences of their rows
# stay in its core's first cache. With 2 products take a quarter longer; more would leave fewer
# work-items of a single image for many cores.
OF_ROWS = 4
# Likewise of W X, where all of them share the sums and differences of its columns. With 8 products
# take up to 10 % longer.
OF_COLUMNS = 16


def fourier_contraction(
    device, dtype, side, *, back=False, mirrored=True, tuning=None, **options
) -> Contraction:
    """Fastest Contraction for one factor that is a table of waves (2 h, n), or its transpose.

    Rows 2i, 2i + 1 are the cosines and sines of frequency i.

    side: "left" or "right", the factor that is the table
    back: from waves to pixels, Z W or W^T Z; else to waves, X W^T or W X
    mirrored: whether all tables are, see `sky.fourier_contraction.is_mirror_symmetric`
    tuning, options: Contraction's
    """
    options["tuning"] = tuning or Tuning.of(device, dtype)
    if not mirrored or not is_supported(options["tuning"]):
        return Contraction(device, dtype, **options)
    return MirrorContraction(device, dtype, side, back=back, **options)


def is_supported(tuning) -> bool:
    """Returns True for CPUs, whose work-items are alone in a group: the kernels are for these."""
    return tuning.row_loops and "KB" not in tuning.tile


class MirrorContraction(Contraction):
    """A Contraction with a table of waves as one of its factors; see kernels/mirror.h, for CPUs.

    Its sums have an order of their own, whatever `bind` is asked for with `inward`.

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
        """Columns that are summed, of n: of those that mirror each other, the first half."""
        return -(-n // 2) if self.right and self.back else n

    def _extent(self, tile, n):
        """Rows and columns of C that a work-item takes, and columns that all take."""
        rows, columns = tile["MR"] * tile["RT"], tile["NV"] * tile["VW"]
        if self.back:
            return rows // 2 if self.right else rows, columns, round_up_columns(self._columns(n))
        return rows, columns, columns if self.right else round_up_columns(n)

    def _order(self, k, inward):
        return {}


def operator_programs(device, dtype):
    """Contractions of operators between aligned images, or images turned against each other.

    The images lie within the model.

    returns [(file, dtype, macros)], as `Device.build_ahead` takes them
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
