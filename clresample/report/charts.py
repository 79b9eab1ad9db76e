"""The report's figures: number counts, signal to noise, chi2, pulls, completeness, times."""

from __future__ import annotations

import numpy as np

from .codes import as_text
from .colours import EMPTY
from .png import png
from .stamps import plain
from .svg import SQUARE, Chart, ChartAxis

BIN_MAG = 0.5
MAX_CHANNELS = 12  # with a chart of their own
UJY_MAG = 23.9  # AB magnitude of one microjansky
CLEAR = 5.0  # [errors] significance of the dotted line
PULL_RANGE, PULL_BIN = 5.0, 0.5  # [errors]
# bins of the true signal to noise, in equal steps of its logarithm
SNR_EDGES = 10 ** np.arange(0.5, 3.01, 0.25)
FEW = 3  # true sources in a bin; with fewer no fraction is shown
# chi2 of the map's colours: a quarter of the noise's, and four times as much
CHI2_SHADES, CHI2_ENDS = 31, (0.25, 4.0)
CHI2_LOW, CHI2_MIDDLE, CHI2_HIGH = (70, 110, 190), (228, 228, 226), (196, 88, 20)


def magnitudes(flux, unit):
    """AB magnitudes of fluxes [uJy], or -2.5 log10 of counts; NaN where not positive."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mag = -2.5 * np.log10(np.where(flux > 0, flux, np.nan))
    return mag + (UJY_MAG if unit == "uJy" else 0.0)


def channel_fluxes(run):
    """(channel, flux (S,), error (S,), unit) of the channels, MAX_CHANNELS at most."""
    for channel in run.channels[:MAX_CHANNELS]:
        names = f"flux_{channel}", f"flux_err_{channel}"
        if set(names) <= set(run.sources.colnames):
            flux, error = (plain(run.sources[name]) for name in names)
            yield channel, flux, error, str(run.sources[names[0]].unit or "counts")


def number_counts(run, truth, area_arcmin2):
    """[(title, svg)] of sources in magnitude, one for each channel, beside the true ones."""
    found, per = [], "/ arcmin² /" if area_arcmin2 else "per"
    area = area_arcmin2 or 1.0
    for channel, flux, _, unit in channel_fluxes(run):
        mags = [magnitudes(flux, unit)]
        name = f"flux_{channel}"
        if truth is not None and unit == "uJy" and name in truth.table.colnames:
            mags.append(magnitudes(plain(truth.table[name])[truth.is_interior], unit))
        mags = [m[np.isfinite(m)] for m in mags]
        every = np.concatenate(mags)
        if not len(every):
            continue
        low, high = np.floor(every.min()), np.ceil(every.max() + 1e-9)
        edges = np.arange(low, high + BIN_MAG / 2, BIN_MAG)
        counts = [np.histogram(m, edges)[0] / area for m in mags]
        top = max(c.max() for c in counts)
        least = min(c[c > 0].min() for c in counts if c.any())
        system = "AB mag" if unit == "uJy" else "−2.5 log₁₀ counts"
        chart = Chart(
            ChartAxis(low, high, f"{channel} [{system}]"),
            ChartAxis(least / 2, top * 1.6, f"sources {per} {BIN_MAG:g} mag", log=True),
            f"Number of sources by magnitude in {channel}",
        )
        chart.steps(edges, counts[0], "bars")
        if len(counts) > 1:
            chart.steps(edges, counts[1], "outline")
        found.append((channel, chart.svg))
    return found


def signal_to_noise(run):
    """[(title, svg)] of flux over its error against flux, one for each channel."""
    found = []
    for channel, flux, error, unit in channel_fluxes(run):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = flux / error
        good = np.isfinite(ratio) & (ratio > 0)
        if not good.any():
            continue
        shown = "µJy" if unit == "uJy" else unit
        chart = Chart(
            ChartAxis.over(flux[good], f"flux in {channel} [{shown}]", log=True),
            ChartAxis.over([*ratio[good], CLEAR], "flux / its error", log=True),
            f"Signal to noise against flux in {channel}, {good.sum()} sources",
        )
        chart.path([chart.x.low, chart.x.high], [CLEAR, CLEAR], "mark")
        chart.points(flux[good], ratio[good])
        found.append((channel, chart.svg))
    return found


def chi2_maps(pyramids):
    """[(title, svg)] of the mean chi2 of cells, one for each instrument, in its own pixels."""
    found = []
    for pyramid in pyramids:
        n_y, n_x = pyramid.instrument.grid.shape
        side = max(n_y, n_x)
        chart = Chart(
            ChartAxis(-0.5, side - 0.5, f"x [px of {pyramid.instrument.name}]"),
            ChartAxis(-0.5, side - 0.5, f"y [px of {pyramid.instrument.name}]"),
            f"Mean chi2 per pixel of {pyramid.instrument.name} in cells of {pyramid.cell_px} px",
            SQUARE,
        )
        image = png(chi2_numbers(pyramid.chi2), chi2_palette())
        m_y, m_x = (k * pyramid.cell_px - 0.5 for k in pyramid.chi2.shape)
        chart.image(f"data:image/png;base64,{as_text(image)}", (-0.5, -0.5, m_x, m_y))
        found.append((pyramid.instrument.name, chart.svg))
    return found


def chi2_numbers(chi2):
    """Numbers uint8 in `chi2_palette` of a map; 0 for NaN."""
    low, high = np.log(CHI2_ENDS)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = (np.log(np.clip(chi2, *CHI2_ENDS)) - low) / (high - low)
    steps = np.rint(np.nan_to_num(part) * (CHI2_SHADES - 1)) + 1
    return np.where(np.isfinite(chi2), steps, 0).astype(np.uint8)


def chi2_palette():
    """(1 + CHI2_SHADES, 3) uint8: no data, then from low to high, 1 in the middle."""
    at = np.linspace(-1, 1, CHI2_SHADES)[:, None]
    end = np.where(at < 0, CHI2_LOW, CHI2_HIGH)
    colours = CHI2_MIDDLE + abs(at) * (end - np.array(CHI2_MIDDLE))
    return np.rint(np.vstack([[EMPTY], colours])).astype(np.uint8)


def pull_charts(run, truth):
    """[(title, svg, median, width, number)] of (flux - truth) / error, one for each channel."""
    found = []
    edges = np.arange(-PULL_RANGE, PULL_RANGE + PULL_BIN / 2, PULL_BIN)
    for channel in run.channels[:MAX_CHANNELS]:
        pulls = truth.pulls(run, channel)
        if not len(pulls):
            continue
        middle = float(np.median(pulls))
        width = float(1.4826 * np.median(np.abs(pulls - middle)))
        share = np.histogram(np.clip(pulls, edges[0], edges[-1]), edges)[0] / len(pulls)
        x = np.linspace(-PULL_RANGE, PULL_RANGE, 101)
        normal = PULL_BIN * np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
        chart = Chart(
            ChartAxis(-PULL_RANGE, PULL_RANGE, f"(flux − truth) / error in {channel}"),
            ChartAxis(0, 1.1 * max(share.max(), normal.max()), f"share per {PULL_BIN:g}"),
            f"Pulls of {len(pulls)} fluxes in {channel}: median {middle:.2f}, width {width:.2f}",
        )
        chart.steps(edges, share, "bars")
        chart.path(x, normal, "outline")
        found.append((channel, chart.svg, middle, width, len(pulls)))
    return found


def completeness(truth):
    """(svg, shares [(low, high, found, of)]) of the true sources found, by their signal to noise.

    None if the truth has no signal to noise.
    """
    if "snr" not in truth.table.colnames:
        return None
    snr, own = (
        plain(truth.table["snr"])[truth.is_interior],
        truth.matched_rows[truth.is_interior] >= 0,
    )
    of, _ = np.histogram(snr, SNR_EDGES)
    found, _ = np.histogram(snr[own], SNR_EDGES)
    share = np.where(of >= FEW, found / np.maximum(of, 1), np.nan)
    middle = np.sqrt(SNR_EDGES[1:] * SNR_EDGES[:-1])
    chart = Chart(
        ChartAxis(SNR_EDGES[0], SNR_EDGES[-1], "true signal to noise, all channels", log=True),
        ChartAxis(0, 1.05, "share found"),
        "Share of the true sources that were found, by their signal to noise",
    )
    chart.path(middle, share, "line")
    chart.points(middle, share)
    ends = zip(SNR_EDGES[:-1], SNR_EDGES[1:], found, of, strict=True)
    return chart.svg, [(float(a), float(b), int(n), int(m)) for a, b, n, m in ends]


def fit_times(run):
    """SVG of the fits' seconds against their sources; None where nothing is known of them."""
    if not {"seconds", "n_sources"} <= set(run.fits.colnames) or not len(run.fits):
        return None
    seconds, n = plain(run.fits["seconds"]), plain(run.fits["n_sources"])
    chart = Chart(
        ChartAxis.over(n, "sources in the fit", log=True, least=0.7),
        ChartAxis.over(seconds, "time of the fit [s]", log=True),
        f"Time of {len(seconds)} fits against their number of sources",
    )
    chart.points(n, seconds)
    return chart.svg
