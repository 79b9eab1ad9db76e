"""Columns of the table of sources, for the page's text and for its script."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .charts import channel_fluxes, magnitudes
from .stamps import plain

MAX_CHANNELS = 8  # with columns in the table


@dataclass(frozen=True, eq=False)
class TableColumn:
    """A column of numbers.

    title, unit; form: format of its numbers, as Python's; values (S,)
    kind: "magnitude", "chi2" or "", which a script uses to find columns; channel: it belongs to
    """

    title: str
    unit: str
    form: str
    values: np.ndarray
    kind: str = ""
    channel: str = ""

    def as_json(self) -> dict:
        """All but its values, as the script reads them."""
        names = "title", "unit", "form", "kind", "channel"
        return {name: getattr(self, name) for name in names}


def columns_of(run) -> list[TableColumn]:
    """The columns of a run: position, S/N, fluxes and magnitudes, size, chi2."""
    rows = run.sources
    sky = [n for n in ("ra", "dec", "y_sky", "x_sky", "l", "b") if n in rows.colnames][:2]
    found = [_column(rows, name, name, str(rows[name].unit or ""), ".6f", "sky") for name in sky]
    found.append(_column(rows, "snr", "S/N", "all channels", ".4g"))
    measured = list(channel_fluxes(run))[:MAX_CHANNELS]
    for channel, flux, _, unit in measured:
        found.append(TableColumn(channel, unit.replace("uJy", "µJy"), ".4g", flux, "flux", channel))
    for channel, flux, _, unit in measured:
        system = "AB mag" if unit == "uJy" else "−2.5 log₁₀"
        mags = magnitudes(flux, unit)
        found.append(TableColumn(channel, system, ".2f", mags, "magnitude", channel))
    found.append(_column(rows, "rms_size", "size", "arcsec", ".3f"))
    for name in rows.colnames:
        if name.startswith("chi2_"):
            found.append(_column(rows, name, f"χ² {name[5:]}", "", ".2f"))
    return [one for one in found if one is not None]


def _column(rows, name, title, unit, form, kind=""):
    if name not in rows.colnames:
        return None
    return TableColumn(title, unit, form, plain(rows[name]), kind)
