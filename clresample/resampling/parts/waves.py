"""Products with tables of waves at pixels that mirror each other, in half the operations."""

from __future__ import annotations

from ...device.contraction import ROW_TILES, Contraction, whole
from ...device.tuning import Tuning

FILE, BACK_FILE = "waves.cl", "waves_back.cl"
# Tiles that a work-item takes one below the other where sums and differences are made for it: of
# its rows, which it multiplies by the whole table, as many as stay in its core's first cache; of
# its columns, which all its rows share. With half as many, products take up to 10 % longer.
OF_ROWS, OF_COLUMNS = 4, 16


def waves(device, dtype, side, *, back=False, mirrored=True, tuning=None, **options) -> Contraction:
    """The Contraction that is the quickest for one factor that is a table of waves (2 h, n), rows
    2i, 2i + 1 the cosines and sines of frequency i, or its transpose.

    side: "left" or "right", the factor that is the table
    back: from waves to pixels, a product with W on the right or W^T on the left; else W^T on the
        right or W on the left
    mirrored: whether all tables are, see `sky.waves.is_mirrored`
    tuning, options: Contraction's
    """
    options["tuning"] = tuning or Tuning.of(device, dtype)
    if not mirrored or "KB" in options["tuning"].tile:
        return Contraction(device, dtype, **options)
    return Waves(device, dtype, side, back=back, **options)


class Waves(Contraction):
    """A Contraction with a table of waves as one of its factors; see kernels/waves.h, for CPUs.

    side, back: see `waves`
    """

    def __init__(self, device, dtype, side, *, back=False, **options):
        super().__init__(device, dtype, **options)
        self.right, self.back = side == "right", back
        self.options |= {"SIDE": int(self.right)}

    def build(self, n_rows=None, n_terms=0, n=0):
        """See `Contraction.build`; n_rows does not matter."""
        n = self._columns(n)
        own = {"RT": ROW_TILES, "READ_AHEAD": self.tuning.reads_ahead}
        if not self.back:
            own["RT"] = OF_ROWS if self.right else OF_COLUMNS
        file = BACK_FILE if self.back else FILE
        return file, self.options | own | self.tuning.tile_for_columns(n, whole(n))

    def _columns(self, n):
        """Columns that are summed, of n: of those that mirror each other, the first half."""
        return -(-n // 2) if self.right and self.back else n

    def _extent(self, tile, n):
        """Rows and columns of C that a work-item takes, and columns that all take."""
        rows, columns = tile["MR"] * tile["RT"], tile["NV"] * tile["VW"]
        if self.back:
            return rows // 2 if self.right else rows, columns, whole(self._columns(n))
        return rows, columns, columns if self.right else whole(n)

    def _order(self, k, inward):
        return {}


def operator_programs(device, dtype):
    """The contractions of an operator between images turned against each other.

    returns [(file, dtype, macros)], as `Device.build_ahead` takes them
    """
    taken = {"epilogue": "MIX", "adjoint": True}
    turned = {"epilogue": "TWIST", "adjoint": True}
    products = [
        *(waves(device, dtype, "right"), waves(device, dtype, "left", epilogue="MIX")),
        *(Contraction(device, dtype, epilogue="TWIST"), waves(device, dtype, "left", back=True)),
        *(waves(device, dtype, "left", **turned), Contraction(device, dtype, **taken)),
        waves(device, dtype, "right", back=True, ragged=True),
    ]
    builds = [product.build() for product in products]
    return [(file, dtype, macros | {"OWN": False}) for file, macros in builds]
