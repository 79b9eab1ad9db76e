"""The command `clresample` and the demonstration. Imports every room; nothing imports it."""

from .command import main

__all__ = ["main"]
