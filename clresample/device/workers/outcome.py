"""Ends of tasks: values, or the reasons why there are none."""

from __future__ import annotations

import enum
import errno
import traceback
from dataclasses import dataclass

from ..discovery import DeviceError


class Cause(enum.Enum):
    """Kind of a reason, by which a run decides what follows.

    TASK: an error of the task itself; WORKER: its worker ended or hung
    DEVICE: an error of the worker's device; DISK: a file cannot be written, as on a full disk
    PACKAGE: a package is not installed
    """

    TASK = enum.auto()
    WORKER = enum.auto()
    DEVICE = enum.auto()
    DISK = enum.auto()
    PACKAGE = enum.auto()


@dataclass(frozen=True)
class Reason:
    """Reason for which a task has no value; its text is one line.

    message: without the kind of error; cause: Cause; kind: name of the exception's class
    """

    message: str
    cause: Cause
    kind: str = ""

    def __str__(self):
        return f"{self.kind}: {self.message}" if self.kind else self.message

    @classmethod
    def of(cls, error) -> Reason:
        """The reason of an exception, with the place where it was raised.

        A ValueError or DeviceError of a raise statement has no place: its text is for users.
        """
        text = " ".join(str(error).split()) or "no message"
        last = traceback.extract_tb(error.__traceback__)[-1]
        is_for_users = isinstance(error, (ValueError, DeviceError))
        if not (is_for_users and str(last.line).startswith("raise")):
            text = f"{text} ({last.name}, line {last.lineno})"
        return cls(text, _cause(error), type(error).__name__)


def _cause(error):
    if isinstance(error, DeviceError):
        return Cause.DEVICE
    if getattr(error, "errno", None) == errno.ENOSPC:
        return Cause.DISK
    return Cause.PACKAGE if isinstance(error, ImportError) else Cause.TASK


@dataclass(frozen=True, eq=False)
class Outcome:
    """End of a task: its value, or the reason why there is none.

    worker: which worker had it, from 0; start_s, end_s [s]: by the monotonic clock
    """

    task: object
    value: object = None
    reason: Reason | None = None
    worker: int = 0
    start_s: float = 0.0
    end_s: float = 0.0

    @property
    def cause(self) -> Cause | None:
        """Kind of the reason, None of a task with a value."""
        return None if self.reason is None else self.reason.cause
