"""Small charts as SVG, drawn in the page's own colours by classes of its style sheet."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from html import escape

import numpy as np

WIDTH, HEIGHT = 284, 208  # [units of the drawing] the page scales it
LEFT, RIGHT, TOP, BOTTOM = 50, 14, 10, 40  # for the labels
SQUARE = WIDTH - LEFT - RIGHT + TOP + BOTTOM  # height at which both axes are as long
# More points than this are shown as shaded cells: as single points they would be one blot.
MAX_POINTS = 1200
CELL = 5  # [units] side of such a cell
SHADES = 4  # of cells, by the logarithm of the number of points
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class ChartAxis:
    """An axis: from `low` to `high`, linear or logarithmic, with its label (quantity and unit)."""

    low: float
    high: float
    label: str
    log: bool = False

    @classmethod
    def over(cls, values, label, *, log=False, least=None, low=None, high=None) -> ChartAxis:
        """An axis that holds all values that are finite, and with `log` positive.

        least: the smallest extent, in decades if `log`; low, high: ends that are given
        """
        values = np.asarray(values, float).ravel()
        values = values[np.isfinite(values) & ((values > 0) | (not log))]
        values = np.log10(values) if log else values
        a, b = (values.min(), values.max()) if len(values) else (0.0, 1.0)
        a, b = (a, b) if low is None else (math.log10(low) if log else low, b)
        a, b = (a, b) if high is None else (a, math.log10(high) if log else high)
        least = least or 1.0
        if b - a < least:
            middle = (a + b) / 2
            a = a if low is not None else middle - least / 2
            b = b if high is not None else max(middle + least / 2, a + least)
        room = 0.04 * (b - a)
        a, b = a - (room if low is None else 0), b + (room if high is None else 0)
        return cls(10**a, 10**b, label, True) if log else cls(a, b, label)

    def part(self, values) -> np.ndarray:
        """0 ... 1 of values from `low` to `high`; of those beyond, beyond."""
        values = np.asarray(values, float)
        if not self.log:
            return (values - self.low) / (self.high - self.low)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(values)
        a, b = math.log10(self.low), math.log10(self.high)
        return (values - a) / (b - a)

    def ticks(self) -> list[tuple[float, str]]:
        """Values with their texts, three to seven."""
        return _decades(self.low, self.high) if self.log else _round_steps(self.low, self.high)


@dataclass(eq=False)
class Chart:
    """A chart to which marks are added; `svg` is its text.

    x, y: ChartAxis; about: description for screen readers; height [units]
    """

    x: ChartAxis
    y: ChartAxis
    about: str
    height: int = HEIGHT
    marks: list = field(default_factory=list)

    def _at(self, x, y):
        u = LEFT + self.x.part(x) * (WIDTH - LEFT - RIGHT)
        v = self.height - BOTTOM - self.y.part(y) * (self.height - TOP - BOTTOM)
        return np.broadcast_arrays(np.clip(u, -9999, 9999), np.clip(v, -9999, 9999))

    def path(self, x, y, kind):
        """A line through points; it is broken where one is not finite."""
        d, pen = [], "M"
        for u, v in zip(*self._at(x, y), strict=True):
            if not (math.isfinite(u) and math.isfinite(v)):
                pen = "M"
                continue
            d.append(f"{pen}{u:.1f} {v:.1f}")
            pen = "L"
        self.marks.append(f'<path class="{kind}" d="{"".join(d)}"/>')

    def steps(self, edges, heights, kind):
        """A histogram: bars from the lower axis where `kind` is filled, else their outline."""
        heights = np.where(np.isfinite(heights), heights, self.y.low)
        floor = np.maximum(heights, self.y.low)
        x = np.repeat(edges, 2)
        y = np.concatenate([[self.y.low], np.repeat(floor, 2), [self.y.low]])
        self.path(x, y, kind)

    def points(self, x, y, kind="points"):
        """Points, or shaded cells where they are many."""
        u, v = self._at(x, y)
        good = np.isfinite(u) & np.isfinite(v) & (u >= LEFT) & (u <= WIDTH - RIGHT)
        good &= (v >= TOP) & (v <= self.height - BOTTOM)
        u, v = u[good], v[good]
        if len(u) <= MAX_POINTS:
            d = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(u, v, strict=True))
            self.marks.append(f'<path class="{kind}" d="{d}"/>')
            return
        cells, counts = np.unique(np.stack([u, v], axis=1) // CELL, axis=0, return_counts=True)
        shade = np.rint((SHADES - 1) * np.log(counts) / max(np.log(counts.max()), 1e-9)).astype(int)
        for s in range(SHADES):
            few = cells[shade == s] * CELL
            d = "".join(f"M{a:g} {b:g}h{CELL}v{CELL}h-{CELL}z" for a, b in few)
            self.marks.append(f'<path class="cells s{s}" d="{d}"/>')

    def image(self, source, extent):
        """A picture (a data URI) over (x0, y0, x1, y1), its first row below."""
        (u0, u1), (v0, v1) = self._at(np.array(extent[::2]), np.array(extent[1::2]))
        self.marks.append(
            f'<image href="{source}" preserveAspectRatio="none" width="{u1 - u0:.2f}" '
            f'height="{v0 - v1:.2f}" transform="matrix(1 0 0 -1 {u0:.2f} {v0:.2f})"/>'
        )

    @property
    def svg(self) -> str:
        """The chart with its axes."""
        right, low = WIDTH - RIGHT, self.height - BOTTOM
        parts = [
            f'<svg class="chart" viewBox="0 0 {WIDTH} {self.height}" role="img" '
            f'aria-label="{escape(self.about)}"><title>{escape(self.about)}</title>'
        ]
        for value, text in self.x.ticks():
            u = float(self._at(value, self.y.low)[0])
            parts.append(f'<path class="grid" d="M{u:.1f} {TOP}V{low}"/>')
            parts.append(f'<text class="tick" x="{u:.1f}" y="{low + 14}">{text}</text>')
        for value, text in self.y.ticks():
            v = float(self._at(self.x.low, value)[1])
            parts.append(f'<path class="grid" d="M{LEFT} {v:.1f}H{right}"/>')
            parts.append(f'<text class="tick y" x="{LEFT - 6}" y="{v + 3.5:.1f}">{text}</text>')
        middle = (LEFT + right) / 2, (TOP + low) / 2
        parts += [
            *self.marks,
            f'<path class="axis" d="M{LEFT} {TOP}V{low}H{right}"/>',
            f'<text class="label" x="{middle[0]}" y="{self.height - 8}">'
            f"{escape(self.x.label)}</text>",
            f'<text class="label" transform="translate(13 {middle[1]}) rotate(-90)">'
            f"{escape(self.y.label)}</text></svg>",
        ]
        return "".join(parts)


def _round_steps(low, high):
    """Multiples of a round step."""
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-300) / 4))
    step *= next(k for k in (1, 2, 5, 10) if (high - low) / (k * step) <= 6)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(k * step, _signed(f"{k * step:.{digits}f}")) for k in range(first, last + 1)]


def _decades(low, high):
    """Powers of ten; between them 2 and 5 where there are few."""
    first, last = math.floor(math.log10(low)), math.floor(math.log10(high))
    every = max(1, math.ceil((last - first) / 7))
    first -= first % every
    within = (1, 2, 5) if math.log10(high / low) < 2 else (1,)
    found = []
    for power in range(first, last + 1, every):
        for k in within if every == 1 else (1,):
            value = k * 10.0**power
            if low * 0.999 <= value <= high * 1.001:
                plain = -3 <= power <= 4
                text = f"{value:g}" if plain else f"10{str(power).translate(SUPERSCRIPTS)}"
                found.append((value, text if plain or k == 1 else f"{k}·{text}"))
    return found


def _signed(text):
    """A number with a proper minus; no minus before zero."""
    if text.startswith("-") and not text.strip("-0."):
        text = text[1:]
    return text.replace("-", "−")
