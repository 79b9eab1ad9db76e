"""The picture of a deblended scene as a file."""

from __future__ import annotations

from .panels import write_png


def plot_deblended(path, result, *, title=""):
    """Writes `Result.plot` as a PNG, whole or not at all.

    Raises ImportError, with what to install, without matplotlib; FileError where the file cannot be
    written.
    """
    write_png(path, result.plot(title=title))
