"""The demonstration runs, is right, and says where its files are."""

import sys

import numpy as np
import pytest

from clresample.cli import demo


def test_demo_writes_what_it_names(tmp_path, capsys):
    pytest.importorskip("galsim")
    pytest.importorskip("matplotlib")
    assert demo.main([str(tmp_path / "made")]) == 0
    printed = capsys.readouterr().out
    files = sorted((tmp_path / "made").iterdir())
    assert [file.name for file in files] == [
        "catalogue.ecsv",
        "catalogue.fits",
        "deblended.png",
        "euclid.fits",
        "resampled.png",
        "result.fits",
        "rubin.fits",
        "rubin_truth.fits",
    ]
    assert all(str(file) in printed for file in files)
    assert " ms on " in printed
    quality = float(printed.split("SDR ")[-1].split()[0])
    assert quality > 50  # dB; 53.6 where this was written
    rows = [line.split() for line in printed.splitlines()]
    galaxies = [row for row in rows if len(row) == 6 and row[0] in "123456"]
    median = next(row for row in rows if row and row[0] == "median")
    rubin, euclid, joint = np.array(galaxies, float)[:, 3:].T
    assert len(galaxies) == 6
    np.testing.assert_allclose(
        [float(value) for value in median[1:]],
        [np.median(v) for v in (rubin, euclid, joint)],
        atol=0.06,
    )
    # 11.7, 12.3 and 13.0 dB where this was written
    assert np.median(joint) > max(np.median(rubin), np.median(euclid)) and np.median(joint) > 12.5


def test_demo_names_what_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "galsim", None)
    assert demo.main([str(tmp_path)]) == 2
    assert "pip install galsim" in capsys.readouterr().err
