"""`clresample resample`: what it writes and prints."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from helpers.resample_files import image_of, nan_image, resample

from clresample import PSF, Resampler
from clresample.cli.command import main
from clresample.files.fits import read_image, read_psf
from clresample.sky.grid import Grid


def test_what_is_written(files, capsys, double):
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
    """An oversampled PSF and one off its array's centre are the same PSF once that is said."""
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


@pytest.mark.parametrize("unit", ["MJy/sr", "Jy/beam"])
def test_notes_are_one_line_each(unit, files, capsys):
    fits.writeto("moved.fits", np.pad(fits.getdata("p.fits"), ((4, 0), (0, 2))))
    assert resample(psf="moved.fits") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "note: moved.fits: PSF core off the centre" in line and "--psf-center core" in line
    with fits.open("in.fits") as hdus:
        hdus[0].header["BUNIT"] = unit
        hdus.writeto("surface.fits")
    assert resample("--overwrite", image="surface.fits") == 0
    assert f"BUNIT is {unit}" in capsys.readouterr().err


@pytest.mark.parametrize("unit", [True, 5, "x" * 60])
def test_units_that_are_no_words_or_leave_no_room_are_kept(files, unit):
    with fits.open("in.fits") as hdus:
        hdus[0].header["BUNIT"] = unit
        hdus.writeto("odd.fits")
    assert resample(image="odd.fits") == 0
    assert fits.getheader("out.fits")["BUNIT"] == str(unit)


def test_small_memory_gives_the_same(files, capsys):
    assert resample() == 0
    whole = fits.getdata("out.fits")
    assert resample("--overwrite", memory="700K") == 0
    assert ", 1 tile," not in capsys.readouterr().out.splitlines()[1]
    tiled = fits.getdata("out.fits")
    np.testing.assert_allclose(tiled, whole, rtol=0, atol=1e-5 * whole.max())


def test_nan_pixels_filled_and_gain_allowed_where_asked(files, capsys):
    assert resample(**nan_image(), fill_nan="0") == 0
    assert np.isfinite(fits.getdata("out.fits")).all()
    capsys.readouterr()
    fits.writeto("narrow.fits", PSF.gaussian(0.5, n_pixels=21).images[0])
    assert resample("--overwrite", psf_like="narrow.fits") == 0
    assert "note: p.fits is wider than narrow.fits can show" in capsys.readouterr().err
    assert resample("--overwrite", psf_like="narrow.fits", max_gain="1.5") == 2


def test_plot_beside_the_reference(files):
    pytest.importorskip("matplotlib")
    assert resample(plot="out.png") == 0
    assert (files / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert resample("--overwrite", image="cube.fits", psf_like="q3.fits", plot="out.png") == 0


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
    assert mapping.geometry == "aligned"
    np.testing.assert_array_equal(mapping.offset, 0)
