"""Fixtures of the command's tests: folders with files to run it on."""

import pytest
from helpers.resample_files import write_files


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder, the current one, of an image, a reference, and their PSFs."""
    monkeypatch.chdir(tmp_path)
    write_files()
    return tmp_path
