"""Files are whole or absent, and outputs are refused before a long computation."""

import gzip
import os

import pytest

from clresample.files.whole_file import FileError, check_output, whole_file


def test_the_file_appears_when_all_is_written(tmp_path):
    path = tmp_path / "out.txt"
    with whole_file(path) as part:
        part.write_text("one")
        assert part.parent == tmp_path and not path.exists()
    assert path.read_text() == "one"
    with whole_file(path) as part:
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
        with pytest.raises(seen), whole_file(path) as part:
            part.write_text("half a fi")
            raise raised
        assert os.listdir(tmp_path) == ["old.txt"]
        assert (tmp_path / "old.txt").read_text() == "precious"


def test_a_full_disk_is_one_line_that_names_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    message = r"out\.txt: cannot be written \(No space left on device\)"
    with pytest.raises(FileError, match=message), whole_file(tmp_path / "out.txt") as part:
        part.write_text("all of it")
    assert not os.listdir(tmp_path)


def test_the_other_name_keeps_the_ending(tmp_path):
    """By which writers choose a format or a compression."""
    with whole_file(tmp_path / "out.fits.gz") as part:
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
