"""Tasks of a field in three steps, and the base of the workers that run them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ...files.atomic import atomic_file


@dataclass(frozen=True)
class TaskKind:
    """A task type in three steps: gather, compute, store.

    Only `compute` takes time; it needs no run folder.

    gather: called as gather(context, task), returns the task's inputs from the run's folder
    compute: called as compute(context, task, inputs), returns (value, content): a small value for
        the caller, and the bytes of the task's file
    path: called as path(context, task), returns the path of that file

    All are functions of modules, so that another process can import them. Calling the TaskKind runs
    all three in turn and returns the value.
    """

    gather: Callable
    compute: Callable
    path: Callable

    def __call__(self, context, task):
        value, content = self.compute(context, task, self.gather(context, task))
        self.keep(context, task, content)
        return value

    def keep(self, context, task, content):
        """Writes a task's file, whole or not at all. Raises FileError."""
        with atomic_file(self.path(context, task)) as part:
            part.write_bytes(content)


class Backend:
    """Workers of a field's tasks, with `outcomes` of their own.

    turns: (stage, Outcome) of every task that has succeeded so far, with its times
    """

    def __init__(self):
        self.turns: list[tuple] = []

    def begin(self, work):
        """Starts the workers, if they do not run yet, and loads in them the work's modules."""

    def close(self):
        """Ends what it has started."""

    def run(self, work, context, tasks, again=None, stage=""):
        """Yields the Outcome of every task of a TaskKind, as `Crew.outcomes` does."""
        for outcome in self.outcomes(work, context, tasks, again):
            if outcome.reason is None:
                self.turns.append((stage, outcome))
            yield outcome
