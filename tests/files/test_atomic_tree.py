"""Folders whose files appear together, and folders that are gone at once."""

import os
import shutil
import subprocess
import sys

import pytest
from helpers.checkout import ROOT

from clresample.files.atomic import FileError, atomic_file, atomic_tree, check_folder, remove_tree


def listed(folder):
    """Content of a folder {name: text}, without unfinished files."""
    files = {str(p.relative_to(folder)): p for p in folder.rglob("*") if p.is_file()}
    return {name: p.read_text() for name, p in files.items() if not name.startswith(".")}


def written(folder, text):
    (folder / "a").mkdir(exist_ok=True)
    for name in ("x", "a/y", "a/z"):
        with atomic_file(folder / name) as part:
            part.write_text(text)


@pytest.mark.parametrize("there", [False, True], ids=["new folder", "old folder"])
def test_a_tree_appears_at_its_end(tmp_path, there):
    folder = tmp_path / "b" / "out"
    if there:
        folder.mkdir(parents=True)
        written(folder, "old")
        (folder / "other").write_text("kept")
    before = listed(folder)
    with pytest.raises(KeyboardInterrupt), atomic_tree(folder) as part:
        written(part, "new")
        raise KeyboardInterrupt
    assert listed(folder) == before and folder.exists() == there
    with atomic_tree(folder) as part:
        written(part, "new")
        assert listed(folder) == before if there else not folder.exists()
    assert listed(folder) == before | {"x": "new", "a/y": "new", "a/z": "new"}
    assert not [name for name in os.listdir(folder) if name.startswith(".")]


def test_a_tree_that_cannot_be_moved_goes_back(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    folder.mkdir()
    written(folder, "old")
    move, moved = os.replace, []

    def full(source, target):
        if len(moved) == 2:
            raise OSError(28, "No space left on device")
        moved.append(target)
        move(source, target)

    with (
        pytest.raises(FileError, match="out: cannot be written .No space left"),
        atomic_tree(folder) as part,
    ):
        written(part, "new")
        (part / "a" / "more").write_text("new")  # the first that is moved
        monkeypatch.setattr("os.replace", full)
    assert len(moved) == 2
    assert listed(folder) == {"x": "old", "a/y": "old", "a/z": "old"}


def test_files_that_are_there_are_kept_unless_asked_for(tmp_path):
    written(tmp_path, "old")
    with (
        pytest.raises(FileError, match=rf"^{tmp_path}/a/y: exists already"),
        atomic_tree(tmp_path, overwrite=False) as part,
    ):
        written(part, "new")
    assert set(listed(tmp_path).values()) == {"old"}


def test_messages_name_the_place_itself(tmp_path):
    with (
        pytest.raises(FileError, match=rf"^{tmp_path}/x: no good"),
        atomic_tree(tmp_path) as part,
    ):
        raise FileError(f"{part}/x: no good")


DYING = """
import os, sys
from pathlib import Path
from clresample.files import atomic
def die(*_):
    os.kill(os.getpid(), 9)
folder = Path(sys.argv[2])
if sys.argv[1] == "forget":
    atomic.shutil.rmtree = die
    atomic.remove_tree(folder)
moves, move = [], os.replace
def dying(source, target):
    if len(moves) == 1:
        die()
    moves.append(target)
    move(source, target)
with atomic.atomic_tree(folder) as part:
    (part / "a").mkdir()
    for name in ("a/y", "x"):
        (part / name).write_text("new")
    os.replace = dying
"""


def dies(what, folder):
    done = subprocess.run([sys.executable, "-c", DYING, what, str(folder)], cwd=ROOT, check=False)
    assert done.returncode == -9


def test_a_killed_tree_is_completed(tmp_path):
    (tmp_path / "x").write_text("old")
    dies("tree", tmp_path)
    assert (tmp_path / "x").read_text() == "old"
    check_folder(tmp_path)
    assert listed(tmp_path) == {"x": "new", "a/y": "new"}
    assert sorted(os.listdir(tmp_path)) == ["a", "x"]


def test_a_folder_that_is_forgotten_is_gone_at_once(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    written(tmp_path / "work", "old")
    seen = []
    remove = shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", lambda f: seen.append(os.listdir(tmp_path)) or remove(f))
    remove_tree(tmp_path / "work")
    assert "work" not in seen[0] and not os.listdir(tmp_path)
    monkeypatch.undo()
    (tmp_path / "work").mkdir()
    dies("forget", tmp_path / "work")
    assert len(os.listdir(tmp_path)) == 1
    check_folder(tmp_path)
    assert not os.listdir(tmp_path)
