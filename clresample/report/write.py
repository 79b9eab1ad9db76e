"""The report of a run, written: one HTML page that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from ..files.atomic import FileError, atomic_file, check_folder, check_output
from ..sky.box import Box
from ..sky.wcs import local_axes
from . import sections
from .html import PAGE, data_block, page
from .page_data import data_of, instrument_data
from .pyramid import full_bytes, pyramid_of
from .run_folder import read_run
from .truth import truth_of

NAME = "report.html"
# [bytes] Default size of a page, which browsers open within some seconds. It suffices for all
# pixels of a field of 4096 x 4096 with Rubin's three bands, and pictures of its 1700 sources.
MAX_BYTES = 64 << 20
TEXT_BYTES = 700_000  # [bytes] that tables and figures take at most, whatever the field
MIN_BYTES = 2_000_000

FIELD = (PAGE / "field.html").read_text()


@dataclass(frozen=True)
class Report:
    """Files that were written.

    path: of the page; n_bytes; n_sources: of the catalogue; n_pictures: sources with pictures
    notes: what is missing in it, a line each
    """

    path: Path
    n_bytes: int
    n_sources: int
    n_pictures: int
    notes: tuple[str, ...] = ()


def write_report(folder, path=None, *, truth=None, most_bytes=MAX_BYTES, overwrite=False) -> Report:
    """Writes the report of a run of `run_field`, finished or not: one HTML page.

    The page holds the pixel values of the field's data, models and residuals as tiles to zoom into,
    every source of it, pictures of up to 2000 sources in every channel, the source alone where the
    run's inputs and an OpenCL device are there, colours and magnitudes, number counts, signal to
    noise, a map of chi2, pulls where the truth is known, the slowest and the failed fits, and the
    versions and settings of the run. It loads nothing and needs no network.

    folder: of the run, or of one part of a field
    path: of the page; None = report.html in the folder, which is replaced
    truth: table of the true sources (y, x [px of the model], flux_CHANNEL [uJy], and snr); None =
        truth.ecsv in the folder, beside it or beside the run's inputs, if there is one
    most_bytes: limit on the page. To stay below it, the page omits the finest tiles; pictures of
        sources, first of those without failure or misfit and with the lowest signal to noise; and
        the faintest sources, by default of more than about 90,000 with four channels
    overwrite: replace the file at `path`

    Raises FileError for a folder without a run, a catalogue or `truth` that cannot be read, and
    where the page cannot be written; ValueError for a limit under 2 MB.
    """
    if not most_bytes >= MIN_BYTES:
        raise ValueError(f"most_bytes is {most_bytes}, must be {MIN_BYTES} or more")
    folder = Path(folder)
    run = read_run(folder)
    out = folder / NAME if path is None else Path(path)
    check_folder(out.absolute().parent)
    check_output(out, overwrite=overwrite or path is None, inputs=_inputs(folder, truth))
    notes = list(run.notes)
    known = truth_of(run, truth, notes)
    most = most_bytes - TEXT_BYTES
    data = data_of(run, most, notes)
    pyramids = _pyramids(run, most - len(data_block("", data)), notes)
    data["instruments"] = [instrument_data(pyramid) for pyramid in pyramids]
    n_pictures = sum("stamps" in one for one in data["details"].values())
    if pyramids and n_pictures < len(run.sources):
        notes.append(f"{n_pictures} of {len(run.sources)} sources have pictures in this page")
    written = page(
        f"{folder.absolute().name}: field report", _body(run, known, pyramids, notes), data
    )
    content = written.encode()
    with atomic_file(out) as part:
        part.write_bytes(content)
    return Report(out, len(content), len(run.sources), n_pictures, tuple(notes))


def _inputs(folder, truth):
    """Files that the page must not replace."""
    names = "*.fits", "*.ecsv", "*.parquet", "*.json"
    return [*(p for name in names for p in folder.glob(name)), *([truth] if truth else [])]


def _pyramids(run, budget, notes):
    """Tiles of all instruments, with bytes divided in proportion to their full sizes."""
    found: list = []
    wanted = [full_bytes(one) for one in run.instruments]
    for k, one in enumerate(run.instruments):
        left = budget - sum(pyramid.n_bytes for pyramid in found)
        share = left * wanted[k] / sum(wanted[k:])  # bytes not used by earlier ones included
        try:
            found.append(pyramid_of(one, run.instruments[0].grid, share))
        except FileError as error:
            notes.append(f"no images of {one.name}: {error}")
    return found


def area_of(run) -> float | None:
    """[arcmin^2] of the sky that the first instrument has data of; None without images.

    Found on every 16th row and column.
    """
    if not run.instruments:
        return None
    one = run.instruments[0]
    n_y, n_x = one.grid.shape
    seen = total = 0
    try:
        with one.opened() as read:
            for y in range(0, n_y, 16):
                row = read(Box(y, 0, y + 1, n_x))[1][:, 0, ::16]
                seen, total = seen + int(np.isfinite(row).any(axis=0).sum()), total + row.shape[1]
    except FileError:
        return None
    return n_y * n_x * one.grid.pixel_scale_arcsec**2 / 3600 * seen / total


def _body(run, truth, pyramids, notes):
    """All that is between the page's head and its script."""
    area = area_of(run)
    parts = {
        "Field": _field(run, pyramids),
        "Sources": sections.source_table(run),
        "Colours": sections.colours(run),
        "Counts": sections.photometry(run, truth, area),
        "χ²": sections.chi2(run, pyramids),
        "Truth": sections.truth_section(run, truth),
        "Fits": sections.fits(run),
        "Origin": sections.origin(run),
    }
    anchors = "field", "sources", "colours", "counts", "chi2", "truth", "fits", "origin"
    links = "".join(
        f'<a href="#{anchor}">{title}</a>'
        for (title, text), anchor in zip(parts.items(), anchors, strict=True)
        if text
    )
    return (
        f'<div class="wrap">{sections.heading(run, area)}{sections.notices(run, notes)}</div>'
        f'<nav class="bar" aria-label="Sections"><div class="wrap">{links}'
        '<button type="button" id="theme" class="live" aria-label="Change colours">Dark</button>'
        f'</div></nav><main class="wrap">{"".join(parts.values())}</main>'
        '<footer class="wrap">Written by clresample report. This page loads nothing.</footer>'
    )


def _field(run, pyramids):
    """The viewer, which a script fills."""
    instruments = "".join(
        f'<label><input type="radio" name="instrument" value="{k}"{" checked" if not k else ""}>'
        f"<span>{escape(pyramid.instrument.name)}</span></label>"
        for k, pyramid in enumerate(pyramids)
    )
    coarse = [
        f"{p.instrument.name} is shown in pixels of {2**p.finest} x {2**p.finest} of its own"
        for p in pyramids
        if p.finest
    ]
    return FIELD.format(
        instruments=instruments,
        hidden="" if pyramids else " hidden",
        compass=_compass(run),
        reduced=escape("; ".join(coarse) + ("." if coarse else "")),
    )


def _compass(run):
    """Arrows to north and east."""
    if not run.instruments:
        return ""
    grid = run.instruments[0].grid
    steps = np.linalg.inv(local_axes(grid, (np.array(grid.shape) - 1) / 2))  # px per arcsec
    arrows = []
    for (y, x), name in zip(steps.T, "NE", strict=True):
        length = np.hypot(x, y)
        u, v = x / length, -y / length
        arrows.append(
            f'<path d="M31 31L{31 + 17 * u:.1f} {31 + 17 * v:.1f}"/>'
            f'<text x="{31 + 25 * u:.1f}" y="{35 + 25 * v:.1f}">{name}</text>'
        )
    return (
        f'<svg class="over compass" viewBox="0 0 62 62" aria-hidden="true">{"".join(arrows)}</svg>'
    )
