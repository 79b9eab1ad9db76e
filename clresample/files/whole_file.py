"""Files that are whole or absent, whatever interrupts their writing."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path


class FileError(ValueError):
    """A file that cannot be read or written: one line that names it."""


def check_output(path, *, overwrite=False):
    """Raise FileError where a file could not be written; ask before a long computation.

    path: the file; overwrite: whether one that exists may be replaced
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f"{path}: is a directory, not a file to write")
    if path.exists() and not overwrite:
        raise FileError(f"{path}: exists already, and is kept unless overwriting is asked for")
    if not path.absolute().parent.is_dir():
        raise FileError(f"{path}: the folder {path.parent} does not exist")


@contextmanager
def whole_file(path):
    """The path to write a file under, renamed to `path` once the block has ended.

        with whole_file("out.txt") as part:
            part.write_text("...")

    The other name lies in the same folder and keeps the ending of `path`, by which some writers
    choose a format or a compression. A block that fails leaves neither a new file nor a changed
    one: an older file of the name `path` stays as it was.

    Raises FileError for an OSError, such as a full disk, and passes on every other exception.
    """
    path = Path(path)
    part = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise FileError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        part.unlink(missing_ok=True)
