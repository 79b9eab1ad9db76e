"""Fixtures of the command's tests: folders with files to run it on."""

import pytest
from helpers.resample_files import write_files
from helpers.tiny_scene import write_scene

from clresample import get_device


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder, the current one, of an image, a reference, and their PSFs."""
    monkeypatch.chdir(tmp_path)
    write_files()
    return tmp_path


@pytest.fixture
def scene(tmp_path):
    """A folder with a scene file that can be fitted."""
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture
def double():
    """Skips a test where the device that the command takes has no double precision."""
    if not get_device().has_fp64:
        pytest.skip(f"{get_device().name} has no double precision")
