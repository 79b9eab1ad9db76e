"""Reasons of a field's tasks that have no value."""

from __future__ import annotations

from dataclasses import replace

from ...device.workers.outcome import Cause, Reason
from ...files.atomic import WriteError


def reason_of(error) -> Reason:
    """The reason of an exception; a file that cannot be written is a matter of its disk."""
    reason = Reason.of(error)
    return replace(reason, cause=Cause.DISK) if isinstance(error, WriteError) else reason
