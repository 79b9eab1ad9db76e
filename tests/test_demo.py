"""The demonstration runs, is right, and says where its files are."""

import sys

import pytest

from clresample import demo


def test_demo_writes_what_it_names(tmp_path, capsys):
    pytest.importorskip("galsim")
    pytest.importorskip("matplotlib")
    assert demo.main([str(tmp_path / "made")]) == 0
    printed = capsys.readouterr().out
    files = sorted((tmp_path / "made").iterdir())
    assert [file.name for file in files] == [
        "demo.png",
        "euclid.fits",
        "rubin.fits",
        "rubin_truth.fits",
    ]
    assert all(str(file) in printed for file in files)
    assert " ms on " in printed
    quality = float(printed.split("SDR ")[1].split()[0])
    assert quality > 50  # dB; 53.6 where this was written


def test_demo_tells_what_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "galsim", None)
    assert demo.main([str(tmp_path)]) == 2
    assert "pip install 'clresample[sim]'" in capsys.readouterr().err
