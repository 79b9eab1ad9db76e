"""Arrays on disk that are mapped into memory."""

from __future__ import annotations

import os

import numpy as np

from ..files.atomic import WriteError


def create_memmap(path, dtype, shape) -> np.ndarray:
    """A new array of zeros in a file, an older one of that name replaced.

    Its disk space is allocated at once. So a full disk raises FileError here, instead of ending the
    process by a signal when a page is written (SIGBUS).
    """
    try:
        array = np.lib.format.open_memmap(path, "w+", dtype, shape)
        if hasattr(os, "posix_fallocate"):
            with open(path, "r+b") as file:
                os.posix_fallocate(file.fileno(), 0, os.path.getsize(path))
    except OSError as error:
        raise WriteError(f"{path}: cannot be written ({error.strerror or error})") from error
    return array
