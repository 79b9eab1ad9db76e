"""`clresample resample`: what it writes, and one clear line for each thing that can be wrong."""

import sys
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from clresample import PSF, Resampler
from clresample.cli.command import main
from clresample.files.fits import read_image, read_psf
from clresample.sky.grid import Grid


def wcs_header(shape, scale_arcsec, *, ra_deg=150.0, angle_deg=0.0):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [ra_deg, 2.0]
    wcs.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    wcs.wcs.cd = np.array([[-c, s], [s, c]]) * scale_arcsec / 3600
    return wcs.to_header()


def image_of(shape, scale_arcsec, bands=(), **place):
    """A dark image with a few round sources, as an HDU; a cube where bands are named."""
    y, x = np.indices(shape)
    sources = sum(
        np.exp(-((y - a * shape[0]) ** 2 + (x - b * shape[1]) ** 2) / 12)
        for a, b in ((0.4, 0.5), (0.6, 0.3), (0.5, 0.7))
    )
    header = wcs_header(shape, scale_arcsec, **place)
    header["BUNIT"] = "count"
    for i, name in enumerate(bands):
        header[f"BAND{i + 1}"] = name
    factors = np.arange(1, len(bands) + 1)[:, None, None] if bands else 1
    return fits.PrimaryHDU((sources * factors).astype(np.float32), header)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder, the current one, of an image, a reference, and their PSFs."""
    monkeypatch.chdir(tmp_path)
    image_of((60, 70), 0.1).writeto("in.fits")
    image_of((60, 70), 0.1, "gri").writeto("cube.fits")
    image_of((40, 30), 0.2, angle_deg=10).writeto("ref.fits")
    fits.PrimaryHDU(PSF.gaussian(1.4, n_pixels=21).images[0]).writeto("p.fits")
    fits.PrimaryHDU(PSF.gaussian(1.5, n_pixels=21).images[0]).writeto("q.fits")
    three = PSF.gaussian([1.5, 1.6, 1.7], n_pixels=21).images
    header = fits.Header([(f"BAND{i + 1}", name) for i, name in enumerate("gri")])
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(three, header, name="PSF")]).writeto("q3.fits")
    return tmp_path


ARGUMENTS = {
    "image": "in.fits",
    "--psf": "p.fits",
    "--like": "ref.fits",
    "--psf-like": "q.fits",
    "-o": "out.fits",
}


def resample(*more, **changes):
    """Exit status of `clresample resample` with the files of the fixture, some of them changed."""
    arguments = ARGUMENTS | {
        f"--{k.replace('_', '-')}" if k != "image" else k: v for k, v in changes.items()
    }
    if "--output" in arguments:
        del arguments["-o"]
    image = arguments.pop("image")
    argv = [word for pair in arguments.items() for word in pair]
    try:
        return main(["resample", image, *argv, *more])
    except SystemExit as stop:  # argparse's own refusals
        return stop.code


def test_what_is_written(files, capsys):
    assert resample("--shift", "0.25", "-1.5", "--dtype", "float64") == 0
    printed = capsys.readouterr()
    assert "out.fits: 40 x 30 pixels" in printed.out and printed.err == ""
    image, ref = read_image("in.fits"), read_image("ref.fits")
    op = Resampler(
        image.grid,
        read_psf("p.fits"),
        ref.grid,
        read_psf("q.fits"),
        dtype=np.float64,
        shift=(0.25, -1.5),
    )
    with fits.open("out.fits") as hdus:
        data, header, coverage = hdus[0].data, hdus[0].header, hdus["COVERAGE"]
        assert data.dtype == ">f8"
        assert np.linalg.norm(data - op(image.data)[0]) < 1e-5 * np.linalg.norm(data)
        np.testing.assert_array_equal(coverage.data, op.covered)
        assert 0 < coverage.data.mean() < 1
        there = [WCS(h, naxis=2).pixel_to_world_values(3, 5) for h in (header, coverage.header)]
        expected = ref.grid.wcs.pixel_to_world_values(3, 5)
        np.testing.assert_allclose(there, [expected, expected], rtol=0, atol=1e-10)
        assert header["BUNIT"] == "count" and "BAND1" not in header
        assert (header["CLSHIFTY"], header["CLSHIFTX"]) == (0.25, -1.5)
        named = {header[key] for key in header if key.startswith("CLFILE")}
        assert named == {"in.fits", "p.fits", "ref.fits", "q.fits"}


def test_flux_per_pixel_is_kept(files):
    image_of((80, 80), 0.2, angle_deg=10).writeto("wide.fits")
    assert resample(like="wide.fits") == 0
    flux = fits.getdata("in.fits").sum()
    assert abs(fits.getdata("out.fits").sum() / flux - 1) < 1e-3  # wings beyond the input's edge


def test_bands_and_hdus_by_name_and_number(files):
    assert (
        resample(
            image="cube.fits", band="r", psf_like="q3.fits", psf_like_hdu="PSF", psf_like_band="r"
        )
        == 0
    )
    by_name = fits.getdata("out.fits")
    assert fits.getheader("out.fits")["BAND1"] == "r"
    assert (
        resample(
            "--overwrite",
            image="cube.fits",
            hdu="0",
            band="1",
            psf_like="q3.fits",
            psf_like_hdu="1",
            psf_like_band="1",
            psf_hdu="0",
            psf_band="0",
            like_hdu="PRIMARY",
            like_band="0",
        )
        == 0
    )
    np.testing.assert_array_equal(fits.getdata("out.fits"), by_name)
    assert resample("--overwrite", image="cube.fits", psf_like="q3.fits") == 0
    cube = fits.getdata("out.fits")
    assert cube.shape == (3, 40, 30)
    np.testing.assert_allclose(cube[1], by_name, rtol=0, atol=1e-6 * by_name.max())
    assert [fits.getheader("out.fits")[f"BAND{i}"] for i in (1, 2, 3)] == list("gri")
    assert resample("--overwrite", image="cube.fits", band="i,g") == 0  # one PSF for all bands
    np.testing.assert_allclose(
        *(b / (3, 1)[i] for i, b in enumerate(fits.getdata("out.fits"))), rtol=0, atol=1e-6
    )


def test_psf_sampling_and_centre(files):
    """An oversampled PSF and one off its array's centre are the same PSF when told so."""
    assert resample() == 0
    plain = fits.getdata("out.fits")
    fine = PSF.gaussian(1.4, n_pixels=41, spacing=0.5).images[0]
    fits.writeto("fine.fits", fine)
    assert resample("--overwrite", psf="fine.fits", psf_spacing="0.5") == 0
    np.testing.assert_allclose(fits.getdata("out.fits"), plain, rtol=0, atol=1e-5 * plain.max())
    fits.writeto("moved.fits", np.pad(fits.getdata("p.fits"), ((4, 0), (0, 2))))
    for centre in ("core", "14,10"):
        assert resample("--overwrite", psf="moved.fits", psf_center=centre) == 0
        moved = fits.getdata("out.fits")
        np.testing.assert_allclose(moved, plain, rtol=0, atol=1e-4 * plain.max())


def test_notes_are_one_line_each(files, capsys):
    fits.writeto("moved.fits", np.pad(fits.getdata("p.fits"), ((4, 0), (0, 2))))
    assert resample(psf="moved.fits") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "note: moved.fits: PSF core off the centre" in line and "--psf-center core" in line
    with fits.open("in.fits") as hdus:
        hdus[0].header["BUNIT"] = "MJy/sr"
        hdus.writeto("surface.fits")
    assert resample("--overwrite", image="surface.fits") == 0
    assert "BUNIT is MJy/sr" in capsys.readouterr().err


def test_small_memory_gives_the_same(files, capsys):
    assert resample() == 0
    whole = fits.getdata("out.fits")
    assert resample("--overwrite", memory="700K") == 0
    assert ", 1 tile," not in capsys.readouterr().out.splitlines()[1]
    tiled = fits.getdata("out.fits")
    np.testing.assert_allclose(tiled, whole, rtol=0, atol=1e-5 * whole.max())


def nan_image():
    with fits.open("in.fits") as hdus:
        hdus[0].data[3, 4:7] = np.nan
        hdus.writeto("nan.fits")
    return {"image": "nan.fits"}


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
        (lambda: {"memory": "lots"}, "'lots' is no size"),
        (lambda: {"psf_spacing": "0"}, "'0' is no number above 0"),
        (lambda: {"psf_center": "left"}, "'left' is not core, middle or Y,X"),
        (lambda: {"band": "g,,r"}, "is no list of bands"),
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


def test_nan_pixels_filled_and_gain_allowed_where_asked(files, capsys):
    assert resample(**nan_image(), nan="0") == 0
    assert np.isfinite(fits.getdata("out.fits")).all()
    capsys.readouterr()
    fits.writeto("narrow.fits", PSF.gaussian(0.5, n_pixels=21).images[0])
    assert resample("--overwrite", psf_like="narrow.fits") == 0
    assert "note: p.fits is wider than narrow.fits can show" in capsys.readouterr().err
    assert resample("--overwrite", psf_like="narrow.fits", max_gain="1.5") == 2


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


def test_plot_beside_the_reference(files):
    pytest.importorskip("matplotlib")
    assert resample(plot="out.png") == 0
    assert (files / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert resample("--overwrite", image="cube.fits", psf_like="q3.fits", plot="out.png") == 0


def test_no_matplotlib(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert resample(plot="out.png") == 2
    assert "pip install 'clresample[plot]'" in capsys.readouterr().err
    assert not (files / "out.fits").exists()


def test_real_images(data, tmp_path):
    """HST as HSC sees it; 0.998 is what the WCS's disagreement of an HST pixel leaves corrected."""
    folder = data / "hst_hsc"
    status = main(
        [
            "resample",
            str(folder / "hst_f814w.fits"),
            "--psf",
            str(folder / "psf_hst_f814w.fits"),
            "--psf-center",
            "core",
            "--like",
            str(folder / "hsc_grizy.fits"),
            "--like-band",
            "3",
            "--psf-like",
            str(folder / "psf_hsc_grizy.fits"),
            "--psf-like-band",
            "3",
            "--shift",
            "-0.95",
            "-1.02",
            "-o",
            str(tmp_path / "out.fits"),
        ]
    )
    assert status == 0
    center = slice(5, 45), slice(5, 45)
    ours = fits.getdata(tmp_path / "out.fits")[center]
    theirs = fits.getdata(folder / "hsc_grizy.fits")[3][center]
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.998


def test_grids_are_of_the_reference(files):
    """The output read back lies exactly on the reference's pixels."""
    assert resample() == 0
    mapping = read_image("out.fits").grid.map_to(read_image("ref.fits").grid)
    assert isinstance(read_image("out.fits").grid, Grid)
    assert mapping.kind == "aligned"
    np.testing.assert_array_equal(mapping.offset, 0)
