"""PSFs that vary over a mosaic: each class against the images that it was made of."""

import pickle

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from clresample import PSF, FunctionPSF, Grid
from clresample.adapters.photutils import psf_of
from clresample.fields.psfs.combined import ConstantPSF, PerBandPSF
from clresample.fields.psfs.gridded import GriddedPSF
from clresample.fields.psfs.psfex import PSFExPSF
from clresample.fields.psfs.read import read_psf_field
from clresample.fields.psfs.sampled import CellPSF, ScatteredPSF
from clresample.files.atomic import FileError

N = 25


def gaussian(sigma, n_pixels=N):
    return PSF.gaussian(sigma, n_pixels=n_pixels).images[0]


def second_moment(psf, band=0):
    image = psf.images[band]
    y = np.arange(len(image)) - (len(image) - 1) / 2
    return (image * y[:, None] ** 2).sum() / image.sum()


@pytest.fixture
def grid():
    flat = Grid.flat((200, 300), 0.2)
    return Grid.from_wcs(flat.to_wcs(ra_deg=150.0, dec_deg=2.0), flat.shape)


def places():
    return np.array([(0.0, 0.0), (0.0, 299.0), (199.0, 0.0), (199.0, 299.0)])


def width(y, x):
    return 1.5 + 0.5 * x / 299 + 0.2 * y / 199


def test_a_cube_gives_its_own_images_and_in_between_their_mean_in_second_moments():
    images = np.stack([gaussian(width(*p)) for p in places()])
    field = ScatteredPSF(images, places())
    for image, (y, x) in zip(images, places(), strict=True):
        np.testing.assert_allclose(field.psf_at(y, x).images[0], image, atol=1e-15)
    ends = [second_moment(field.psf_at(0, x)) for x in (0, 299)]
    between = [second_moment(field.psf_at(0, x)) for x in (299 / 4, 299 / 2)]
    np.testing.assert_allclose(between, [ends[0] + t * (ends[1] - ends[0]) for t in (0.25, 0.5)])
    # and so the width follows to second order in how much it changes: w + (0.35)^2 / (2 w)
    middle = np.sqrt(second_moment(field.psf_at(99.5, 149.5)) - 1 / 12)
    assert abs(middle - width(99.5, 149.5)) < 0.035


def test_a_cube_takes_the_nearest_image_outside_and_with_too_few_places():
    images = np.stack([gaussian(width(*p)) for p in places()])
    outside = ScatteredPSF(images, places()).psf_at(-50, -80)
    np.testing.assert_allclose(outside.images[0], images[0])
    for few in ([0, 1], [0, 0, 1]):  # two, and three on a line
        field = ScatteredPSF(images[few], places()[few])
        np.testing.assert_allclose(field.psf_at(30, 250).images[0], images[1])


def test_a_cube_refuses_positions_that_do_not_go_with_its_images():
    with pytest.raises(ValueError, match=r"positions has the shape \(4, 2\), must be \(3, 2\)"):
        ScatteredPSF(np.ones((3, 5, 5)), places())
    with pytest.raises(ValueError, match="finite"):
        ScatteredPSF(np.ones((4, 5, 5)), places()).psf_at(np.nan, 0)


def test_cells_are_constant_inside_and_an_empty_one_takes_its_neighbours():
    images = np.stack([[gaussian(1.5 + 0.1 * (3 * j + i)) for i in range(3)] for j in range(2)])
    images[0, 1] = np.nan
    field = CellPSF(images, (100, 100))
    np.testing.assert_allclose(field.psf_at(99.4, 0).images[0], images[0, 0])
    np.testing.assert_allclose(field.psf_at(99.6, 0).images[0], images[1, 0])
    np.testing.assert_allclose(field.psf_at(80, 150).images[0], images[1, 1])
    np.testing.assert_allclose(field.psf_at(-10, 400).images[0], images[0, 2])
    with pytest.raises(ValueError, match="all 6 cells are empty"):
        CellPSF(np.zeros((2, 3, 5, 5)), 10)


def psfex_file(path):
    """A PSFEx file of degree 1: a constant image and its slope in x, 2x oversampled."""
    base = PSF.gaussian(3.0, n_pixels=33).images[0]
    slope = PSF.gaussian(4.0, n_pixels=33).images[0] - base
    mask = np.zeros((1, 3, 33, 33), np.float32)
    mask[0, 0], mask[0, 1] = base, slope
    column = fits.Column("PSF_MASK", f"{3 * 33 * 33}E", dim="(33,33,3)", array=mask)
    hdu = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    hdu.header.update(
        {"POLNAXIS": 2, "POLGRP1": 1, "POLNAME1": "X_IMAGE", "POLZERO1": 151.0, "POLSCAL1": 300.0}
        | {"POLGRP2": 1, "POLNAME2": "Y_IMAGE", "POLZERO2": 101.0, "POLSCAL2": 200.0}
        | {"POLNGRP": 1, "POLDEG1": 1, "PSF_SAMP": 0.5, "PSFNAXIS": 3}
        | {"PSFAXIS1": 33, "PSFAXIS2": 33, "PSFAXIS3": 3}
    )
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    return base, slope


def test_psfex_polynomials_are_taken_at_pixels_that_count_from_one(tmp_path):
    pytest.importorskip("galsim")
    base, slope = psfex_file(tmp_path / "x.psf")
    field = PSFExPSF(tmp_path / "x.psf")
    psf = field.psf_at(100, 150)  # x = 151, y = 101 of PSFEx
    assert psf.spacing == 0.5
    np.testing.assert_allclose(psf.images[0], base, atol=1e-8)
    np.testing.assert_allclose(field.psf_at(100, 225).images[0], base + 0.25 * slope, atol=1e-8)
    again = pickle.loads(pickle.dumps(field))
    np.testing.assert_array_equal(again.psf_at(3, 4).images, field.psf_at(3, 4).images)
    with pytest.raises(FileError, match="no such file"):
        PSFExPSF(tmp_path / "y.psf")


def piff_file(path):
    """A Piff file of Gaussians that widen along x, on pixels of 0.2 arcsec that count from 1."""
    galsim, piff = pytest.importorskip("galsim"), pytest.importorskip("piff")
    rng, wcs, stars = np.random.default_rng(0), galsim.PixelScale(0.2), []
    for x, y in rng.uniform(30, 970, (20, 2)):
        star = piff.Star.makeTarget(x=x, y=y, wcs=wcs, stamp_size=25)
        profile = galsim.Gaussian(sigma=0.3 + 1e-4 * x)
        profile.drawImage(star.image, center=galsim.PositionD(x, y))
        star.data.weight = galsim.Image(
            np.ones((25, 25)), xmin=star.image.xmin, ymin=star.image.ymin
        )
        stars.append(star)
    model = piff.SimplePSF(piff.GSObjectModel(galsim.Gaussian(sigma=1.0)), piff.Polynomial(order=1))
    model.fit(stars, {3: wcs}, None)
    model.write(str(path))


def test_piff_is_drawn_at_pixels_that_count_from_one(tmp_path, grid):
    pytest.importorskip("piff")
    path = tmp_path / "x.piff"
    piff_file(path)
    field = read_psf_field(path, "piff", grid, stamp_px=31)
    for x in (99.0, 899.0):
        psf = field.psf_at(500, x)
        assert psf.images.shape == (1, 31, 31)
        wanted = PSF.gaussian((0.3 + 1e-4 * (x + 1)) / 0.2, n_pixels=31).images
        np.testing.assert_allclose(psf.images, wanted, atol=2e-4 * wanted.max())
    again = pickle.loads(pickle.dumps(field))
    np.testing.assert_array_equal(again.psf_at(3, 4).images, field.psf_at(3, 4).images)
    with pytest.raises(FileError, match="chip is 7, the file has 3"):
        read_psf_field(path, "piff", grid, detector=7)
    with pytest.raises(ValueError, match="stamp_px is 30, must be an odd number"):
        read_psf_field(path, "piff", grid, stamp_px=30)
    (tmp_path / "bad.piff").write_text("no")
    with pytest.raises(FileError, match="no Piff file"):
        read_psf_field(tmp_path / "bad.piff", "piff", grid)


class Gridded:
    """The attributes of photutils' GriddedPSFModel that are read, of PSFs on a 2 x 3 grid."""

    oversampling = np.array([2, 2])
    grid_xypos = [(x, y) for x in (10.0, 50.0, 90.0) for y in (20.0, 80.0)]
    data = np.stack([gaussian(2 * (1 + 0.01 * x + 0.002 * y), 41) for x, y in grid_xypos])


def test_gridded_psfs_are_interpolated_along_rows_and_columns():
    field = GriddedPSF.of_model(Gridded())
    for image, (x, y) in zip(Gridded.data, Gridded.grid_xypos, strict=True):
        np.testing.assert_allclose(field.psf_at(y, x).images[0], image, atol=1e-14)
    assert field.psf_at(0, 0).spacing == 0.5
    np.testing.assert_array_equal(field.psf_at(-5, 200).images, field.psf_at(20, 90).images)
    corners = [field.psf_at(y, x).images for y in (20, 80) for x in (50, 90)]
    mean = np.tensordot([0.1875, 0.0625, 0.5625, 0.1875], corners, 1)
    np.testing.assert_allclose(field.psf_at(65, 60).images, mean, atol=1e-15)


def test_gridded_psfs_that_make_no_grid_are_refused():
    model = Gridded()
    model.grid_xypos = [*Gridded.grid_xypos[:-1], (91.0, 80.0)]
    with pytest.raises(ValueError, match="6 places for 6 PSFs, on 2 rows and 4 columns"):
        GriddedPSF.of_model(model)
    model.oversampling = (2, 4)
    with pytest.raises(ValueError, match="oversampling is"):
        GriddedPSF.of_model(model)
    with pytest.raises(ValueError, match="model is int, must be a GriddedPSFModel"):
        GriddedPSF.of_model(3)
    with pytest.raises(ValueError, match=r"x is \[2.0, 1.0\]"):
        GriddedPSF(np.ones((1, 2, 5, 5)), [0.0], [2.0, 1.0])


def stdpsf_file(path):
    """The PSFs of Gridded as STDPSF has them: four samples a pixel, positions in the header."""
    order = sorted(range(6), key=lambda i: Gridded.grid_xypos[i][::-1])
    hdu = fits.PrimaryHDU(np.stack([Gridded.data[i] for i in order]).astype(np.float32))
    hdu.header.update({"NXPSFS": 3, "NYPSFS": 2, "INSTRUME": "ACS"})
    hdu.header.update({f"IPSFX{i + 1:02}": int(x) + 1 for i, x in enumerate((10, 50, 90))})
    hdu.header.update({f"JPSFY{i + 1:02}": int(y) + 1 for i, y in enumerate((20, 80))})
    hdu.writeto(path)


def test_photutils_reads_files_of_gridded_psfs(tmp_path, grid):
    psf = pytest.importorskip("photutils.psf")
    stdpsf_file(tmp_path / "STDPSF_WFC3UV_F814W.fits")
    field = read_psf_field(tmp_path / "STDPSF_WFC3UV_F814W.fits", "gridded", grid)
    model = psf.GriddedPSFModel.read(str(tmp_path / "STDPSF_WFC3UV_F814W.fits"))
    for y, x in ((20.0, 50.0), (47.0, 33.0), (60.0, 88.0)):
        wanted = psf_of(model, position_px=(y, x), n_pixels=41 / 4)
        np.testing.assert_allclose(field.psf_at(y, x).images, wanted.images, atol=1e-6)
        assert field.psf_at(y, x).spacing == wanted.spacing
    (tmp_path / "bad.fits").write_text("no")
    with pytest.raises(FileError, match="no file of gridded PSFs"):
        read_psf_field(tmp_path / "bad.fits", "gridded", grid)


def test_bands_of_fields_with_smaller_stamps_keep_their_centres():
    small, large = ConstantPSF(PSF(gaussian(1.0, 11))), ConstantPSF(PSF(gaussian(2.0, 25)))
    psf = PerBandPSF([small, large]).psf_at(0, 0)
    assert psf.n_bands == 2
    np.testing.assert_allclose(psf.images[0, 7:18, 7:18], gaussian(1.0, 11))
    np.testing.assert_array_equal(psf.center, [[12, 12], [12, 12]])
    other = ConstantPSF(PSF(gaussian(2.0, 25), spacing=0.5))
    with pytest.raises(ValueError, match="PSFs have sample spacings"):
        PerBandPSF([small, other]).psf_at(0, 0)


def test_a_function_is_asked_with_row_and_column():
    field = FunctionPSF(lambda y, x: gaussian(1.5 + y / 100))
    assert second_moment(field.psf_at(100, 0)) > second_moment(field.psf_at(0, 100)) + 1
    with pytest.raises(ValueError, match="2 bands"):
        FunctionPSF(lambda y, x: np.stack([gaussian(1.0)] * 2)).psf_at(0, 0)


def test_files_of_images_cubes_and_cells(tmp_path, grid):
    images = np.stack([gaussian(width(*p)) for p in places()]).astype(np.float32)
    fits.PrimaryHDU(images[:1]).writeto(tmp_path / "one.fits")
    one = read_psf_field(tmp_path / "one.fits", "image", grid)
    np.testing.assert_allclose(one.psf_at(5, 5).images[0], images[0], rtol=1e-6)

    for name, table in (
        ("pixels", Table({"x": places()[:, 1], "y": places()[:, 0]})),
        ("sky", Table(dict(zip(("ra", "dec"), grid.sky(*places().T), strict=True)))),
    ):
        positions = fits.table_to_hdu(table)
        positions.name = "POSITIONS"
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(images), positions]
        fits.HDUList(hdus).writeto(tmp_path / f"{name}.fits")
        cube = read_psf_field(tmp_path / f"{name}.fits", "cube", grid)
        np.testing.assert_allclose(cube.positions, places(), atol=1e-6)

    fits.PrimaryHDU(images.reshape(2, 2, N, N)).writeto(tmp_path / "cells.fits")
    cells = read_psf_field(tmp_path / "cells.fits", "cells", grid, cell_px=(100, 150))
    np.testing.assert_allclose(cells.psf_at(150, 200).images[0], images[3], rtol=1e-6)
    with pytest.raises(FileError, match="POSITIONS"):
        read_psf_field(tmp_path / "cells.fits", "cube", grid)
    with pytest.raises(ValueError, match="psf_format is 'pif'"):
        read_psf_field(tmp_path / "cells.fits", "pif", grid)


def mer_file(path, grid, shift=1000.0):
    """A CATALOG-PSF as Euclid's MER writes them, its x and y of another mosaic."""
    size, sheet = 21, np.zeros((44, 44), np.float32)
    rows = {name: [] for name in ("x", "y", "x_center", "y_center", "Ra", "Dec")}
    for k, (y, x) in enumerate(places()):
        y0, x0 = 22 * (k // 2), 22 * (k % 2)
        sheet[y0 : y0 + size, x0 : x0 + size] = gaussian(width(y, x), size)
        ra, dec = grid.sky(y, x)
        values = (x + shift, y + shift, x0 + size // 2 + 1, y0 + size // 2 + 1, ra, dec)
        for name, value in zip(rows, values, strict=True):
            rows[name].append(float(value))
    image = fits.ImageHDU(sheet)
    image.header["STMPSIZE"] = size
    fits.HDUList([fits.PrimaryHDU(), image, fits.table_to_hdu(Table(rows))]).writeto(path)


def test_a_mer_sheet_is_cut_into_stamps_placed_by_the_sky(tmp_path, grid):
    mer_file(tmp_path / "mer.fits", grid)
    field = read_psf_field(tmp_path / "mer.fits", "euclid-mer", grid)
    np.testing.assert_allclose(field.positions, places(), atol=1e-6)
    for y, x in places():
        expected = gaussian(width(y, x), 21)
        np.testing.assert_allclose(field.psf_at(y, x).images[0], expected, atol=1e-7)
    with fits.open(tmp_path / "mer.fits", mode="update") as hdus:
        hdus[2].data["x_center"][0] = 5
    with pytest.raises(FileError, match="not on the sheet"):
        read_psf_field(tmp_path / "mer.fits", "euclid-mer", grid)
