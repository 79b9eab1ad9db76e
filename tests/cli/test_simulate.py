"""`clresample simulate`: its files appear together and replace none unasked."""

import os

import pytest
from astropy.table import Table

from clresample.cli import main

pytest.importorskip("galsim")
WORDS = ["simulate", "field", "--size", "96", "--bands", "i"]


@pytest.mark.parametrize("form", ["plain", "survey"])
def test_a_disk_that_is_full_at_the_end_leaves_nothing(tmp_path, monkeypatch, capsys, form):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Table, "write", full)
    (tmp_path / "there").mkdir()
    for name in ("new", "there"):
        assert main([*WORDS, "--format", form, "-o", str(tmp_path / name)]) == 2
        assert "cannot be written (No space left" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["there"] and not os.listdir(tmp_path / "there")


def test_other_files_are_kept_unless_asked_for(tmp_path, capsys):
    (tmp_path / "euclid.fits").write_text("precious")
    words = [*WORDS, "-o", str(tmp_path)]
    assert main(words) == 2
    assert "euclid.fits: exists already" in capsys.readouterr().err
    assert (tmp_path / "euclid.fits").read_text() == "precious"
    assert os.listdir(tmp_path) == ["euclid.fits"]
    assert main([*words, "--overwrite"]) == 0
    assert (tmp_path / "euclid.fits").stat().st_size > 2880
