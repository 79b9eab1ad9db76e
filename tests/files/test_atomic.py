"""Files are whole or absent, and outputs are refused before a long computation."""

import gzip
import os
import signal
import subprocess
import sys

import pytest
from helpers.checkout import ROOT

from clresample.files.atomic import (
    HOST,
    FileError,
    atomic_file,
    atomic_files,
    check_folder,
    check_output,
)


def test_the_file_appears_when_all_is_written(tmp_path):
    path = tmp_path / "out.txt"
    with atomic_file(path) as part:
        part.write_text("one")
        assert part.parent.parent == tmp_path and not path.exists()
    assert path.read_text() == "one"
    with atomic_file(path) as part:
        part.write_text("two")
        assert path.read_text() == "one"
    assert path.read_text() == "two"
    assert os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.parametrize(
    "raised, seen",
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (ArithmeticError("of the caller's own"), ArithmeticError),
        (OSError(28, "No space left on device"), FileError),
    ],
)
def test_what_interrupts_the_writing_leaves_no_trace(tmp_path, raised, seen):
    (tmp_path / "old.txt").write_text("precious")
    for path in (tmp_path / "old.txt", tmp_path / "new.txt"):
        with pytest.raises(seen), atomic_file(path) as part:
            part.write_text("half a fi")
            raise raised
        assert os.listdir(tmp_path) == ["old.txt"]
        assert (tmp_path / "old.txt").read_text() == "precious"


def test_a_full_disk_is_one_line_that_names_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    message = r"out\.txt: cannot be written \(No space left on device\)"
    with pytest.raises(FileError, match=message), atomic_file(tmp_path / "out.txt") as part:
        part.write_text("all of it")
    assert not os.listdir(tmp_path)


def test_the_other_name_keeps_the_ending(tmp_path):
    """By which writers choose a format or a compression."""
    with atomic_file(tmp_path / "out.fits.gz") as part:
        assert part.name.endswith("out.fits.gz")
        with gzip.open(part, "wb") as file:
            file.write(b"1")


def test_outputs_that_cannot_be_written_are_refused(tmp_path):
    path = tmp_path / "out.txt"
    check_output(path)
    path.write_text("precious")
    check_output(path, overwrite=True)
    for wrong, overwrite, message in (
        (path, False, "exists already"),
        (tmp_path, True, "is a directory"),
        (tmp_path / "no" / "out.txt", False, "does not exist"),
    ):
        with pytest.raises(FileError, match=message):
            check_output(wrong, overwrite=overwrite)


def written(parts, texts=("one", "two")):
    for part, text in zip(parts, texts, strict=True):
        part.write_text(text)


def listed(folder):
    return {p.name: p.read_text() for p in folder.iterdir()}


@pytest.mark.parametrize("there", [False, True], ids=["new folder", "old folder"])
def test_several_files_appear_together(tmp_path, there):
    folder = tmp_path / "b" / "a" / "out"
    if there:
        folder.mkdir(parents=True)
        (folder / "y").write_text("old")
    with atomic_files([folder / "x", folder / "y"]) as parts:
        written(parts)
        assert not (folder / "x").exists()
    assert listed(folder) == {"x": "one", "y": "two"}
    assert os.listdir(folder.parent) == ["out"]
    assert folder.stat().st_mode & 0o777 == 0o777 & ~current_umask()


def current_umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("there", [False, True], ids=["new folder", "old folder"])
def test_of_several_files_all_or_none_appear(tmp_path, monkeypatch, there):
    folder = tmp_path / "b" / "a" / "out"
    if there:
        folder.mkdir(parents=True)
        (folder / "x").write_text("old")
    before = {"x": "old"} if there else None
    move = os.replace if there else os.rename

    def check():
        if there:
            assert listed(folder) == before
        else:
            assert not os.listdir(tmp_path)

    for raised in (KeyboardInterrupt(), FileError("of a writer")):
        with (
            pytest.raises(type(raised)),
            atomic_files([folder / "x", folder / "y", folder / "z"]) as parts,
        ):
            written(parts[:2])
            raise raised
        check()
    for n_moved in range(3 if there else 1):
        moved = []

        def full(source, target, moved=moved, n_moved=n_moved):
            moved.append(target)
            if len(moved) > n_moved:
                raise OSError(28, "No space left on device")
            move(source, target)

        monkeypatch.setattr(f"os.{move.__name__}", full)
        if not there:
            monkeypatch.setattr("os.rename", full)
        with (
            pytest.raises(FileError, match="cannot be written .No space left"),
            atomic_files([folder / "x", folder / "y", folder / "z"]) as parts,
        ):
            written(parts, ("1", "2", "3"))
        monkeypatch.undo()
        check()


def test_two_folders_at_once(tmp_path):
    (tmp_path / "a").mkdir()
    paths = tmp_path / "a" / "x", tmp_path / "y"
    with atomic_files(paths) as parts:
        written(parts)
    assert [path.read_text() for path in paths] == ["one", "two"]
    assert sorted(os.listdir(tmp_path)) == ["a", "y"]


def test_ctrl_c_waits_until_all_is_moved(tmp_path, monkeypatch):
    move = os.replace

    def interrupted(source, target):
        signal.raise_signal(signal.SIGINT)
        move(source, target)

    monkeypatch.setattr("os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_files([tmp_path / "x", tmp_path / "y"]) as parts:
        written(parts)
    assert listed(tmp_path) == {"x": "one", "y": "two"}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


KILLED = """
import os, sys
from pathlib import Path
from clresample.files import atomic
folder, n_moves = Path(sys.argv[1]), int(sys.argv[2])
moves = []
def dying(move):
    def one(source, target):
        if len(moves) == n_moves:
            os.kill(os.getpid(), 9)
        moves.append(target)
        move(source, target)
    return one
os.rename, os.replace = dying(os.rename), dying(os.replace)
with atomic.atomic_files([folder / name for name in "xyz"]) as parts:
    for part in parts:
        part.write_text("new")
"""


@pytest.mark.parametrize("there", [False, True], ids=["new folder", "old folder"])
@pytest.mark.parametrize("n_moves", range(4))
def test_after_a_kill_the_next_run_clears_up(tmp_path, there, n_moves):
    """Killed before or at any move: nothing, or all once the next run has looked."""
    folder = tmp_path / "out"
    if there:
        folder.mkdir()
        for name in "xy":
            (folder / name).write_text("old")
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(folder), str(n_moves)], cwd=ROOT, check=False
    )
    assert done.returncode == (-9 if there or n_moves == 0 else 0)
    if there and n_moves == 0:
        assert any(name.startswith(".part-") for name in os.listdir(folder))
    check_folder(folder)
    if not there:
        assert os.listdir(tmp_path) == (["out"] if n_moves else [])
    elif n_moves == 0:
        assert listed(folder) == {"x": "old", "y": "old"}
    else:
        assert listed(folder) == {"x": "new", "y": "new", "z": "new"}


def test_what_others_are_writing_is_left_alone(tmp_path):
    alive = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        names = [
            f".part-{HOST}-{alive.pid}-0",
            ".part-elsewhere-1-0",
            f".part-{HOST}-99999999999999999999-0",  # no number of a process
        ]
        for name in names:
            (tmp_path / name).mkdir()
        (tmp_path / f".part-{HOST}-{2**22 + 5}-0").symlink_to(tmp_path)
        for k in range(20):
            (tmp_path / f"file {k}").write_text("")
            (tmp_path / f".part-{HOST}-{2**22 + 7}-{k}").mkdir()  # of the dead
        check_folder(tmp_path)
        assert len(os.listdir(tmp_path)) == 24
    finally:
        alive.communicate(b"\n")
    check_folder(tmp_path)
    assert len(os.listdir(tmp_path)) == 23


def test_devices_pipes_links_and_inputs_are_kept(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "input").write_text("precious")
    (tmp_path / "link").symlink_to("input")
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    os.link(tmp_path / "input", tmp_path / "same")
    for name, said in (
        ("pipe", "is a device, a pipe or a socket"),
        ("link", "is a symbolic link"),
        ("dangling", "is a symbolic link"),
        ("loop", "is a symbolic link"),
        ("same", "is one of the inputs"),
        ("input", "is one of the inputs"),
    ):
        with pytest.raises(FileError, match=said):
            check_output(tmp_path / name, overwrite=True, inputs=[tmp_path / "input"])
    with pytest.raises(FileError, match="/dev/null: is a device, a pipe or a socket"):
        check_output("/dev/null", overwrite=True)
    with pytest.raises(FileError, match="cannot be written .File name too long"):
        check_output(tmp_path / (300 * "x"))


def test_folders_that_cannot_be_written(tmp_path, monkeypatch):
    check_folder(tmp_path / "a" / "b")
    assert not os.listdir(tmp_path)
    (tmp_path / "file").write_text("precious")
    with pytest.raises(FileError, match="file: is a file, not a folder"):
        check_folder(tmp_path / "file" / "out")

    def read_only(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("os.mkdir", read_only)  # root may write wherever the file system can
    with pytest.raises(FileError, match="out: cannot be written .Read-only file system"):
        check_folder(tmp_path / "out")


def test_messages_of_writers_name_the_file_itself(tmp_path):
    with (
        pytest.raises(FileError, match=rf"^{tmp_path}/x: exists already"),
        atomic_files([tmp_path / "x"]) as parts,
    ):
        parts[0].write_text("")
        check_output(parts[0])
