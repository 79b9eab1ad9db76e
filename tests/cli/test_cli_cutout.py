"""`clresample cutout` after a single fit."""

import numpy as np
import pytest
from helpers.blends import SCALE, observe, two_sources

from clresample import read_cutouts
from clresample.cli import main
from clresample.files.results import write_result
from clresample.sky.grid import Grid


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(2)
    data = rng.normal(size=(2, 60, 70))
    o = observe(Grid.flat((60, 70), SCALE), ("g", "r"), data=data, name="one")
    result = two_sources(observations=[o])
    (tmp_path / "out").mkdir()
    write_result(tmp_path / "out" / "result.fits", result)
    return tmp_path / "out", result


def test_sources_are_cut_out_by_number_from_the_folder_or_the_file(folder, tmp_path, capsys):
    out, result = folder
    for where in (out, out / "result.fits"):
        path = tmp_path / "cut.fits"
        assert main(["cutout", str(where), "--id", "1,0", "-o", str(path), "--overwrite"]) == 0
        assert capsys.readouterr().out == f"2 cutouts of 2 sources: {path}\n"
        found = read_cutouts(path)
        for cut, i in zip(found, (1, 0), strict=True):
            expected = result.cutout(i, 0)
            np.testing.assert_allclose(cut.data, expected.data, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(cut.psf, expected.psf, rtol=1e-6, atol=1e-9)
            sigma = expected.uncertainty.array
            np.testing.assert_allclose(cut.uncertainty.array, sigma, rtol=1e-6)
            assert cut.unit == expected.unit and (cut.mask == expected.mask).all()
            lon, lat = cut.wcs.all_pix2world(3, 2, 0)
            np.testing.assert_allclose(expected.wcs.all_pix2world(3, 2, 0), (lon, lat))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--id", "7"], "source is 7, must be a number from 0 to 1"),
        (["--id", "0", "--group"], "--group goes with the folder of a field"),
        (["--id", "0", "--observation", "z"], "observation is 'z'"),
        (["--id", "0", "--unit", "uJy"], "has no zero_points"),
    ],
)
def test_mistakes_are_told_in_one_line(folder, tmp_path, capsys, more, message):
    path = tmp_path / "cut.fits"
    assert main(["cutout", str(folder[0]), "-o", str(path), *more]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("clresample cutout: ") and told.err.count("\n") == 1
    assert message in told.err and not path.exists()
    assert main(["cutout", str(tmp_path / "none.fits"), "--id", "0", "-o", str(path)]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_file_that_is_read_is_not_written(folder, capsys):
    path = folder[0] / "result.fits"
    assert main(["cutout", str(path), "--id", "0", "-o", str(path), "--overwrite"]) == 2
    assert "is one of the inputs" in capsys.readouterr().err


def test_files_without_cutouts_are_refused(folder):
    with pytest.raises(ValueError, match="holds no cutouts"):
        read_cutouts(folder[0] / "result.fits")
