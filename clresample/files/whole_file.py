"""Files that are whole or absent, whatever interrupts their writing."""

from __future__ import annotations

import os
from pathlib import Path


class FileError(ValueError):
    """A file that cannot be read or written: one line that names it."""


def check_output(path, *, overwrite=False):
    """Raise FileError where `write_fits` could not write; ask before a long computation."""
    path = Path(path)
    if path.is_dir():
        raise FileError(f"{path}: is a directory, not a file to write")
    if path.exists() and not overwrite:
        raise FileError(f"{path}: exists already, and is kept unless overwriting is asked for")
    if not path.absolute().parent.is_dir():
        raise FileError(f"{path}: the folder {path.parent} does not exist")


def replace_file(path, hdus):
    """Write under another name in the same folder, then rename: the file is whole or absent."""
    part = path.with_name(f".part-{os.getpid()}-{path.name}")  # astropy needs the suffix, .gz too
    try:
        hdus.writeto(part, checksum=True, overwrite=True)
        os.replace(part, path)
    except OSError as error:
        raise FileError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        part.unlink(missing_ok=True)
