"""Progress bars in terminals and notebooks; a line now and then in logs."""

from __future__ import annotations

import logging
import sys
import time
import warnings

LOG = logging.getLogger("clresample")
# [s] Between two lines of a log.
LINE_S = 30.0


class ProgressBar:
    """Progress display, called with the number of finished items; a context manager.

    total: number of all items; unit: their name in the plural
    """

    def __init__(self, total, unit):
        self.total, self.unit = total, unit
        self._began = self._said = time.monotonic()
        self._bar = _drawn(total=total, unit=f" {unit}") if is_watched() else None

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self._bar is not None:
            self._bar.close()

    def __call__(self, n_done):
        if self._bar is not None:
            self._bar.update(n_done - self._bar.n)
            return
        now = time.monotonic()
        if now - self._said >= LINE_S or n_done == self.total:
            took = now - self._began
            line = f"{n_done} of {self.total} {self.unit} after {took:.0f} s"
            tell(line)
            self._said = now


def passing_bar(title, unit, n_done, began):
    """A tqdm bar of an unknown total, erased when closed; `began` [s] by time.monotonic."""
    shape = "{desc}: {n_fmt} {unit}, {elapsed}"
    bar = _drawn(desc=title, unit=unit, initial=n_done, bar_format=shape, leave=False)
    bar.start_t -= time.monotonic() - began
    bar.refresh()
    return bar


def _drawn(**options):
    """tqdm's own choice between a notebook's bar and a terminal's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of notebooks without widgets: they get text
        from tqdm.auto import tqdm

        return tqdm(**options)


def tell(line):
    """Logs a requested line of progress, and prints it unless `logging` handles such lines.

    It is printed on standard error, unless Python's `logging` is configured to show or to hide it.
    """
    LOG.info(line)
    if not LOG.isEnabledFor(logging.INFO) and LOG.level == logging.NOTSET:
        print(line, file=sys.stderr, flush=True)


def is_watched():
    """Returns True if the output is interactive: a terminal, or a notebook's kernel."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules
