"""Progress of a field run: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from ...fields.options import RunProgress
from ..options import print_progress

# [s] Between two lines of a log: jobs of a day stay within a few thousand lines.
LINE_S = 30.0
FORMAT = "{desc} {percentage:3.0f} % |{bar:24}| {n_fmt} of {total_fmt} {unit}{postfix}"


class ProgressDisplay(RunProgress):
    """Blends done, sources a second, time left: of every stage of a run.

    arguments: of the command; quiet ones show nothing
    clock: seconds that only grow
    """

    def __init__(self, arguments, clock=time.monotonic):
        self.arguments, self.clock = arguments, clock
        self.bar = None
        self.said = clock()

    def stage(self, name, total):
        """A stage begins: its own bar."""
        self.close()
        self.name, self.total = name, total
        self.done = self.counted = self.sources = 0
        self.began, self.ends = self.clock(), None
        watched = sys.stderr.isatty() and not self.arguments.quiet
        self.bar = tqdm(
            total=total,
            desc=name,
            unit=self.unit,
            bar_format=FORMAT,
            leave=False,
            file=sys.stderr,
            disable=not watched,
        )

    @property
    def unit(self):
        """Unit in which the stage counts."""
        return {"search": "tiles", "write": "steps"}.get(self.name, "blends")

    def step(self, n, sources=0):
        """Counts finished tasks.

        Tasks found on disk have no sources counted, and do not enter this run's speed.
        """
        self.done += n
        self.sources += sources
        self.counted += n if sources else 0
        if not self.bar.disable:
            self.bar.set_postfix_str(self.speed(), refresh=False)
            self.bar.update(n)
        elif not self.arguments.quiet and self.clock() - self.said >= LINE_S:
            line = f"{self.name}: {self.done} of {self.total} {self.unit}"
            print_progress(self.arguments, ", ".join(filter(None, [line, self.speed()])))
            self.said = self.clock()

    def time_left(self, seconds):
        """Keeps the predicted end of the stage, and shows it."""
        self.ends = None if seconds is None else self.clock() + seconds
        if not self.bar.disable:
            self.bar.set_postfix_str(self.speed())

    def speed(self):
        """Sources a second and the time left, as far as they are known."""
        seconds = self.clock() - self.began
        words, left = [], None
        if self.counted and seconds > 0:
            words.append(f"{self.sources / seconds:.1f} sources/s")
            # by the number of tiles, which are alike
            left = (self.total - self.done) * seconds / self.counted
        if self.ends is not None:
            left = max(0.0, self.ends - self.clock())
        if left is not None:
            words.append(f"about {duration(left)} left in this stage")
        return ", ".join(words)

    def message(self, text):
        """A line of its own, above the bar."""
        if not self.arguments.quiet:
            with tqdm.external_write_mode(file=sys.stderr):
                print_progress(self.arguments, text)

    def close(self):
        """Removes the bar."""
        if self.bar is not None:
            self.bar.close()


def duration(seconds):
    """A time in words: 42 s, 3 min, 2 h 10 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
