"""Output of a run: its record, tables on the screen, JSON, and a log to continue from."""

from __future__ import annotations

import datetime
import json
import math
import os
import platform
import re
from importlib.metadata import version

from clresample import __version__, get_device
from clresample.files.atomic import atomic_file

from .options import BadOption


def record(threads):
    """Record of a run: device, versions, date, and how each side was limited to one thread."""
    device = get_device()
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "device": device.name,
        "platform": f"{device.platform}, {device.cl.platform.version}",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        "load": f"{os.getloadavg()[0]:.1f} processes wanted a core, mean of the last minute",
        "python": platform.python_version(),
        "clresample": __version__,
        **{name: version(name) for name in ("numpy", "pyopencl", "galsim")},
        "threads": threads,
    }


def columns(text):
    """A table's columns, (field, width, format of numbers) each, from "name:6 flux:8.2f"."""
    found = (re.fullmatch(r"(\w+):(\d+)(.*)", word).groups() for word in text.split())
    return tuple((name, int(width), form) for name, width, form in found)


def print_head(columns):
    """Prints the names of a table's columns."""
    print("  ".join(name.rjust(width) for name, width, _ in columns), flush=True)


def print_row(columns, row):
    """Prints one line of the table; what is not a number is printed as it is."""
    cells = []
    for name, width, form in columns:
        is_number = isinstance(row[name], (int, float))
        cells.append((format(row[name], form) if is_number else str(row[name])).rjust(width))
    print("  ".join(cells), flush=True)


def show(columns, found, record, path, *, summarise=None, below=None, order=None, **more):
    """Prints a record, then rows as they come; writes all to a JSON file.

    path: the file, or None
    summarise: from all rows to the groups of figures that are printed at the end
    below: prints more of a row, below it
    order: the key by which rows are sorted before the end
    more: further entries of the file
    returns the rows
    """
    print_record(record)
    print_head(columns)
    rows = []
    for row in found:
        rows.append(row)
        print_row(columns, row)
        if below is not None:
            below(row)
    if order is not None:
        rows.sort(key=order)
    if summarise is not None:
        more["summary"] = summarise(rows)
        print_summary(more["summary"])
    if path is not None:
        write_json(path, {"record": record, "rows": rows, **more})
    return rows


def print_stages(row):
    """Prints the seconds of a row's stages, and the calling thread's milliseconds, where it has."""
    if row["stage"]:
        print("  " + ", ".join(f"{name} {s:.2f} s" for name, s in row["stage"].items()), flush=True)
    if row.get("host_ms"):
        stages = ", ".join(f"{name} {ms:.1f} ms" for name, ms in row["host_ms"].items())
        print(f"  host: {stages}", flush=True)


def print_lines(texts):
    """Prints texts below a row, a line each."""
    for text in texts:
        print(f"    {text}", flush=True)


def print_record(record):
    """Prints a record, one name and value on each line."""
    for name, value in record.items():
        print(f"{name}: {value}")


def print_summary(summary):
    """Prints groups of figures {group: {name: value}}, one figure on each line."""
    for group, figures in summary.items():
        print(f"{group}:")
        for name, value in figures.items():
            print(f"  {name}: {value:.3f}" if isinstance(value, float) else f"  {name}: {value}")


def write_json(path, content):
    """Writes JSON whole or not at all; infinite and undefined numbers become null."""
    write_text(path, json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


def read_json(path):
    """Reads what `write_json` wrote; null, an infinite or undefined number, becomes NaN."""
    return _numbers(json.loads(path.read_text(encoding="utf-8")))


def write_text(path, text):
    """Writes a file whole or not at all. Raises FileError where it cannot be written."""
    with atomic_file(path) as part:
        part.write_text(text, encoding="utf-8")


class Log:
    """Log of a run, one line of JSON for each part done; the next run continues from it.

    path: the file
    settings: what all parts of it share; a file made with others is refused by `BadOption`
    done: parts by their keys; of a part that was appended twice, the later one
    """

    def __init__(self, path, settings):
        self.path, self.done = path, {}
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        if len(whole) < len(text):  # the run ended in the middle of a line
            os.truncate(path, len(whole))
        if not whole:
            self._append(settings)
            return
        found, *parts = map(json.loads, whole.splitlines())
        for name, value in settings.items():
            if found.get(name) != value:
                raise BadOption(
                    f"{path} comes from a run with {name} {found.get(name)}, not {value}: "
                    "remove it or name another --folder"
                )
        for key, part in parts:
            self.done[tuple(key)] = part

    def append(self, key, part):
        """Keeps a part, `key` being a tuple of strings and numbers; its line is written at once."""
        self._append([key, part])
        self.done[key] = part

    def _append(self, content):
        line = json.dumps(_finite(content), allow_nan=False) + "\n"
        with self.path.open("ab", buffering=0) as file:
            file.write(line.encode())


def _numbers(value):
    if isinstance(value, dict):
        return {name: _numbers(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return math.nan if value is None else value


def _finite(value):
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
