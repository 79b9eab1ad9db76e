"""`clresample resample`: one clear line for each thing that can be wrong, and nothing written."""

import sys
import warnings

import numpy as np
import pytest
from astropy.io import fits
from helpers.resample_files import image_of, nan_image, resample

from clresample import PSF
from clresample.cli.command import main


def no_wcs():
    fits.writeto("flat.fits", np.zeros((20, 20), np.float32))
    return {"image": "flat.fits"}


def no_wcs_reference():
    return {"like": no_wcs()["image"]}


def far_away():
    image_of((40, 30), 0.2, ra_deg=151.0).writeto("far.fits")
    return {"like": "far.fits"}


def wide_psf():
    fits.writeto("wide.fits", PSF.gaussian(5.0, n_pixels=61).images[0])
    return {"psf": "wide.fits"}


def flat_psf():
    fits.writeto("flat.fits", np.ones((21, 21)))
    return {"psf_like": "flat.fits"}


def truncated():
    with open("in.fits", "rb") as whole, open("cut.fits", "wb") as cut:
        cut.write(whole.read()[:6000])
    return {"image": "cut.fits"}


def nan_psf():
    bad = fits.getdata("p.fits")
    bad[0, 0] = np.nan
    fits.writeto("bad.fits", bad)
    return {"psf": "bad.fits"}


def not_fits():
    with open("text.fits", "w") as file:
        file.write("no stars here\n")
    return {"psf": "text.fits"}


@pytest.mark.parametrize(
    "make, message",
    [
        (nan_image, "nan.fits: 3 of 4200 pixels are NaN or infinite"),
        (no_wcs, "flat.fits: HDU 0 PRIMARY has no celestial WCS"),
        (no_wcs_reference, "flat.fits: HDU 0 PRIMARY has no celestial WCS"),
        (far_away, "in.fits as far.fits: grids do not overlap"),
        (wide_psf, "wide.fits is wider than q.fits can show"),
        (flat_psf, "flat.fits: too wide for its 21 x 21 image, or no PSF"),
        (truncated, "cut.fits: truncated"),
        (nan_psf, "bad.fits: images: band 0 has 1 NaN"),
        (not_fits, "text.fits: not a FITS file"),
        (lambda: {"image": "."}, ".: is a directory"),
        (lambda: {"psf": "none.fits"}, "none.fits: no such file"),
        (lambda: {"output": "."}, ".: is a directory"),
        (lambda: {"output": "nowhere/out.fits"}, "nowhere does not exist"),
        (lambda: {"plot": "nowhere/out.png"}, "nowhere does not exist"),
        (lambda: {"output": "x.fits", "plot": "x.fits"}, "both the image and the picture"),
        (lambda: {"psf_like": "q3.fits"}, "q3.fits: has 3 bands, in.fits 1"),
        (lambda: {"image": "cube.fits", "band": "g,r", "psf_like": "q3.fits"}, "3 bands"),
        (lambda: {"image": "cube.fits", "band": "z"}, "cube.fits: no band z"),
        (lambda: {"hdu": "SCI"}, "in.fits: no HDU SCI"),
        (lambda: {"psf_like": "q3.fits", "psf_like_hdu": "0"}, "holds no 2-D or 3-D image"),
        (lambda: {"memory": "1K"}, "memory is 1024 bytes"),
        (lambda: {"memory": "lots"}, "'lots' is not a size"),
        (lambda: {"psf_spacing": "0"}, "'0' is not a positive number"),
        (lambda: {"psf_center": "left"}, "'left' is not core, middle or Y,X"),
        (lambda: {"band": "g,,r"}, "is not a list of bands"),
        (lambda: {"device": "no such device"}, "no such device"),
    ],
)
def test_one_line_status_2_and_nothing_written(files, capsys, make, message):
    changes = make()
    before = sorted(path.name for path in files.iterdir())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resample(**changes) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("clresample resample: ") and message in line
    assert sorted(path.name for path in files.iterdir()) == before


def test_existing_files_are_kept(files, capsys):
    (files / "out.fits").write_text("precious")
    assert resample() == 2
    assert "exists already" in capsys.readouterr().err
    assert (files / "out.fits").read_text() == "precious"
    assert resample("--overwrite") == 0
    (files / "old.png").write_text("precious")
    assert resample(output="new.fits", plot="old.png") == 2
    assert (files / "old.png").read_text() == "precious" and not (files / "new.fits").exists()
    before = (files / "ref.fits").read_bytes()
    assert resample("--overwrite", output="ref.fits") == 2
    assert "is one of the inputs" in capsys.readouterr().err
    assert (files / "ref.fits").read_bytes() == before


def test_help_names_every_file(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["resample", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for word in ("IN.fits", "--psf-like-band", "--shift DY DX", "COVERAGE", "example"):
        assert word in text


def test_missing_option_is_one_line(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["resample", "in.fits"])
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_no_matplotlib(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert resample(plot="out.png") == 2
    assert "pip install matplotlib" in capsys.readouterr().err
    assert not (files / "out.fits").exists()
