"""Runs begun by versions with other names.

Refused in one line before anything is read or written.
"""

import json

import pytest

from clresample.fields.execution.folder import open_folder
from clresample.fields.options import FieldOptions, RunProgress
from clresample.files.atomic import FileError
from clresample.sky.grid import Grid


def opened(folder, **given):
    given = {"resume": True, "overwrite": False} | given
    return open_folder(
        folder, [], Grid.flat((9, 9), 0.1), FieldOptions(), progress=RunProgress(), **given
    )


@pytest.mark.parametrize("resume", [False, True])
def test_a_run_of_another_format_is_refused_and_kept(tmp_path, resume):
    work = tmp_path / "work"
    work.mkdir()
    (work / "run.json").write_text(json.dumps({"settings": "..."}))
    with pytest.raises(FileError) as error:
        opened(tmp_path, resume=resume)
    assert "holds a run of format 1, this version goes on with 14: --overwrite" in str(error.value)
    assert "\n" not in str(error.value)
    assert [path.name for path in work.iterdir()] == ["run.json"]


def test_a_run_of_another_format_is_overwritten_where_that_is_asked_for(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "run.json").write_text(json.dumps({"format": 1}))
    opened(tmp_path, overwrite=True)
    assert json.loads((tmp_path / "work" / "run.json").read_text())["format"] == 14
    opened(tmp_path)  # its own goes on
