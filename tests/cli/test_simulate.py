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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--size", "5"], "--size is 5, must be 32 or more"),
        (["--bands", "q"], "--bands is 'q', must be some of u,g,r,i,z,y"),
    ],
)
def test_a_value_out_of_range_is_named_by_its_option(tmp_path, capsys, words, message):
    assert main(["simulate", "field", "-o", str(tmp_path / "new"), *words]) == 2
    assert message in capsys.readouterr().err


def test_other_files_are_kept_unless_asked_for(tmp_path, capsys):
    (tmp_path / "euclid.fits").write_text("precious")
    words = [*WORDS, "-o", str(tmp_path)]
    assert main(words) == 2
    assert "euclid.fits: exists already" in capsys.readouterr().err
    assert (tmp_path / "euclid.fits").read_text() == "precious"
    assert os.listdir(tmp_path) == ["euclid.fits"]
    assert main([*words, "--overwrite"]) == 0
    assert (tmp_path / "euclid.fits").stat().st_size > 2880
