"""Writes files, one or several together, that appear whole or not at all.

All files are first written to the folder `.part-HOST-PID-xxxx` beside their destination and flushed
to the disk. Then the folder is renamed to `.done-HOST-PID-xxxx`, and the files are moved. The next
run deletes a `.part` folder of a killed run, and moves the files of a `.done` folder.
"""

from __future__ import annotations

import os
import platform
import re
import secrets
import shutil
import signal
import threading
from contextlib import contextmanager, suppress
from pathlib import Path

# letters and digits of this machine's name: other machines' runs may be alive
HOST = re.sub(r"[\W_]", "", platform.node())[:32] or "host"
STAGE = re.compile(rf"\.(part|done)-{HOST}-(\d+)-\w+")


class FileError(ValueError):
    """A file that cannot be read or written: one line that names it."""


class WriteError(FileError):
    """A file that cannot be written, such as on a full disk."""


def check_output(path, *, overwrite=False, inputs=()):
    """Raises FileError if a file could not be written: a check before long computations.

    path: the file; overwrite: True if an existing file may be replaced; inputs: files that must not
        be replaced, under any name
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise FileError(f"{path}: is a directory, not a file to write")
        if path.is_symlink():
            raise FileError(f"{path}: is a symbolic link, and is kept: name the file itself")
        if path.exists():
            for other in map(Path, inputs):
                if other.exists() and path.samefile(other):
                    raise FileError(f"{path}: is one of the inputs, and is kept")
            if not path.is_file():
                raise FileError(f"{path}: is a device, a pipe or a socket, and is kept")
            if not overwrite:
                raise FileError(
                    f"{path}: exists already, and is kept unless overwriting is asked for"
                )
        if not path.absolute().parent.is_dir():
            raise FileError(f"{path}: the folder {path.parent} does not exist")
    except OSError as error:
        raise WriteError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_folder(folder):
    """Raises FileError if a folder is not writable, or could not be made.

    It writes a test file in the folder, or in the first existing folder above it, and removes it.
    Files left by killed runs on this machine are removed too.
    """
    folder = Path(folder)
    try:
        there = next(f for f in (folder.absolute(), *folder.absolute().parents) if f.exists())
        if not there.is_dir():
            raise FileError(f"{there}: is a file, not a folder to write into")
        remove_stale(there)
        _new_folder(there).rmdir()
    except OSError as error:
        raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error


@contextmanager
def atomic_file(path):
    """The path to write a file under, moved to `path` once the block has ended.

        with atomic_file("out.txt") as part:
            part.write_text("...")

    The other path has the name of `path`, by whose ending some writers choose a format or a
    compression. A block that fails leaves neither a new file nor a changed one: an older file of
    the name `path` stays as it was.

    Raises FileError for an OSError, such as a full disk, and passes on every other exception.
    """
    with atomic_files([path]) as parts:
        yield parts[0]


@contextmanager
def atomic_files(paths):
    """Paths to write several files under; all of them appear together, or none does.

    See `atomic_file`. A new folder appears with all its files in it. In an existing folder files
    are moved in the order of `paths`; if a run is killed during the moves, the next `check_folder`
    or `atomic_files` there completes them.
    """
    paths = [Path(path) for path in paths]
    files = [(path.absolute().parent, path.name) for path in paths]
    outputs = _Outputs(dict.fromkeys(folder for folder, _ in files))
    with outputs.named(dict(zip(files, paths, strict=True))):
        yield [outputs.stages[folder] / name for folder, name in files]
        outputs.commit(files)


@contextmanager
def atomic_tree(folder, *, overwrite=True):
    """A folder to write into; all its files then appear together in `folder`, or none does.

    See `atomic_files`; for files whose names are not known before, also in subfolders. Other files
    in `folder` stay. overwrite: True if files may be replaced
    """
    home = Path(folder).absolute()
    outputs = _Outputs([home])
    with outputs.named({(home, ""): Path(folder)}):
        stage = outputs.stages[home]
        yield stage
        files = [p.relative_to(stage) for p in sorted(stage.rglob("*")) if not p.is_dir()]
        for name in files if home.is_dir() else ():
            if (home / name).parent.is_dir():
                check_output(Path(folder) / name, overwrite=overwrite)
        outputs.commit([(home, name) for name in files])


class _Outputs:
    """The folders in which outputs are written, each beside or in the folder it is meant for.

    stages {folder: where its files are written}; made: folders that were made on the way
    Files are pairs of the folder and of their place inside it.
    """

    def __init__(self, folders):
        self.folders, self.stages, self.made, self.old = list(folders), {}, [], {}

    @contextmanager
    def named(self, names):
        """Opens the files and closes them after the block; messages use the names {file: name}."""
        try:
            self.open()
            yield
        except OSError as error:
            given = ", ".join(map(str, names.values()))
            raise WriteError(f"{given}: cannot be written ({error.strerror or error})") from error
        except FileError as error:  # of a writer, with the file's temporary path
            message = str(error)
            for (folder, name), given in names.items():
                message = message.replace(str(self.stages.get(folder, folder) / name), str(given))
            raise type(error)(message) from error
        finally:
            self.close()

    def open(self):
        """Creates the files, after those left by killed runs are removed."""
        for folder in self.folders:
            home = folder
            if not folder.is_dir():
                home = folder.parent
                missing = [f for f in (home, *home.parents) if not f.exists()]
                self.made += missing
                home.mkdir(parents=True, exist_ok=True)
            remove_stale(home)
            self.stages[folder] = _new_folder(home)

    def commit(self, files):
        """Writes all files to the disk, then moves them; if one cannot be moved, all move back."""
        for stage in self.stages.values():
            for one in (*stage.rglob("*"), stage):
                _to_disk(one)
        with _unbroken():
            moved = []
            try:
                for folder in self.folders:
                    self._keep_old(folder, [name for home, name in files if home == folder])
                for file in files:
                    self._move(*file)
                    moved.append(file)
            except BaseException:
                for file in reversed(moved):
                    self._move_back(*file)
                raise
            self.made = []
        for folder in self.folders:
            _to_disk(folder)

    def _keep_old(self, folder, names):
        """Second names of the files that will be replaced, and the mark that all is complete."""
        if not folder.is_dir():
            return
        there = [name for name in names if (folder / name).exists()]
        if there:
            self.old[folder] = _new_folder(folder)
            for name in there:
                kept = self.old[folder] / name
                kept.parent.mkdir(parents=True, exist_ok=True)
                with suppress(OSError):  # a file system without hard links
                    os.link(folder / name, kept)
        stage = self.stages[folder]
        self.stages[folder] = stage.with_name(stage.name.replace(".part-", ".done-", 1))
        os.rename(stage, self.stages[folder])

    def _move(self, folder, name):
        if not folder.is_dir():  # with all that lies in it
            os.rename(self.stages[folder], folder)
        elif (self.stages[folder] / name).exists():
            _put(self.stages[folder] / name, folder / name)

    def _move_back(self, folder, name):
        old = self.old.get(folder, folder) / name
        if folder in self.old and old.exists():
            os.rename(old, folder / name)
        else:
            (folder / name).unlink(missing_ok=True)

    def close(self):
        """Removes the files that were not moved."""
        for stage in (*self.stages.values(), *self.old.values()):
            shutil.rmtree(stage, ignore_errors=True)
        for folder in self.made:
            with suppress(OSError):
                folder.rmdir()


def remove_stale(folder):
    """Removes files in a folder left by this user's killed runs on this machine."""
    if os.name != "posix":  # other systems cannot test if a process is alive
        return
    for entry in list(os.scandir(folder)):
        found = STAGE.fullmatch(entry.name)
        if not found or not entry.is_dir(follow_symlinks=False) or _alive(int(found[2])):
            continue
        if entry.stat(follow_symlinks=False).st_uid != os.getuid():
            continue
        with suppress(OSError):
            if found[1] == "done":
                for file in [p for p in Path(entry.path).rglob("*") if not p.is_dir()]:
                    _put(file, Path(folder) / file.relative_to(entry.path))
            shutil.rmtree(entry.path)


def remove_tree(folder):
    """Removes a folder and its content at once.

    If it is killed, `remove_stale` removes the rest.
    """
    aside = _new_folder(folder.absolute().parent)
    os.rename(folder, aside)
    shutil.rmtree(aside)


def _put(file, path):
    """Moves a file to its destination; creates the folder if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    os.replace(file, path)


def _alive(pid):
    """Returns True if a process of this machine is alive."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _new_folder(home):
    """A folder of this run in another one, with a unique name."""
    folder = home / f".part-{HOST}-{os.getpid()}-{secrets.token_hex(8)}"
    folder.mkdir()
    return folder


def _to_disk(path):
    """Waits until a file or folder is on the disk, if the system supports that."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def _unbroken():
    """Ctrl-C and the signal to end wait until the block, a few renames, has ended."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python's handlers run in the main thread
        return
    came, held = [], (signal.SIGINT, signal.SIGTERM)
    former = {number: signal.getsignal(number) for number in held}
    for number in held:
        if former[number] is not None:
            signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in former.items():
            if handler is not None:
                signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)
