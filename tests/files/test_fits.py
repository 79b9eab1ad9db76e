"""FITS files in and out: what is read, what is refused and how, what is written."""

import gzip
import os

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from helpers.headers import OBSERVED, cd_header, header, observed_headers, with_tables

from clresample.files.atomic import FileError
from clresample.files.fits import read_image, read_psf, write_fits
from clresample.sky.grid import Grid
from clresample.sky.psf_checks import PSFWarning

RNG = np.random.default_rng(21)
PIXELS = RNG.normal(size=(3, *OBSERVED)).astype(np.float32)
FLAT = Grid.flat(OBSERVED, 0.2, angle_deg=20, flip=True)


def stored(path, data, cards=None, **more):
    """A FITS file of one image."""
    hdu = fits.PrimaryHDU(data)
    for key, value in (cards or {}).items():
        if key != "NAXIS" and not key.startswith("NAXIS"):
            hdu.header[key] = value
    hdu.header.update(more)
    hdu.writeto(path)
    return path


@pytest.fixture
def cube(tmp_path):
    """Three bands g, r, i with a plain WCS."""
    return stored(tmp_path / "cube.fits", PIXELS, header(OBSERVED), BAND1="g", BAND2="r", BAND3="i")


def refusal(function, *args, **kwargs):
    """The one line of a refusal."""
    with pytest.raises(FileError) as error:
        function(*args, **kwargs)
    text = str(error.value)
    assert "\n" not in text and isinstance(error.value, ValueError)
    return text


@pytest.mark.parametrize("cards", [pytest.param(c, id=name) for name, c in observed_headers()])
def test_image_and_grid_are_those_of_the_file(tmp_path, cards):
    n_bands = cards.get("NAXIS3", 1)
    data = np.stack([PIXELS[0] + i for i in range(n_bands)])
    path = stored(tmp_path / "a.fits", data if n_bands > 1 else data[0], cards)
    read, grid, head, bands = read_image(path)
    assert bands == tuple(str(i) for i in range(n_bands))
    np.testing.assert_array_equal(read, data)
    assert grid.shape == OBSERVED and head["CRVAL1"] == cards["CRVAL1"]
    truth = Grid.from_wcs(WCS(cards), OBSERVED)
    n, m = np.indices(OBSERVED)
    np.testing.assert_allclose(grid.sky(n, m), truth.sky(n, m), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("dtype", "read_as"),
    [(">f4", "f4"), (">f8", "f8"), (">i2", "f4"), (">i4", "f8"), ("u1", "f4"), ("u2", "f4")],
)
def test_pixels_are_native_floats(tmp_path, dtype, read_as):
    data = np.arange(48).reshape(6, 8).astype(dtype)  # u2 is stored with BZERO
    image = read_image(stored(tmp_path / "a.fits", data, header((6, 8))))
    assert image.data.dtype == np.dtype(read_as) and image.data.dtype.isnative
    assert image.data.flags.c_contiguous
    np.testing.assert_array_equal(image.data[0], data)


@pytest.mark.parametrize(
    ("bands", "chosen"),
    [(None, [0, 1, 2]), (1, [1]), ("i", [2]), ("2", [2]), (["i", "g"], [2, 0]), ([0, "r"], [0, 1])],
)
def test_bands_by_number_or_name(cube, bands, chosen):
    image = read_image(cube, bands=bands)
    np.testing.assert_array_equal(image.data, PIXELS[chosen])
    assert image.bands == tuple("gri"[i] for i in chosen)
    with pytest.warns(PSFWarning):
        psf = read_psf(stored(cube.with_name("psf.fits"), np.abs(PIXELS)), bands=[0, 2])
    assert psf.n_bands == 2


def test_a_name_goes_before_a_number(tmp_path):
    path = stored(tmp_path / "a.fits", PIXELS, header(OBSERVED), BAND1="2", BAND2="1", BAND3="0")
    np.testing.assert_array_equal(read_image(path, bands="2").data[0], PIXELS[0])
    path = stored(tmp_path / "b.fits", PIXELS[0], header(OBSERVED), FILTER="F814W")
    assert read_image(path, bands="F814W").bands == ("F814W",)


def test_hdus_by_number_or_name(tmp_path):
    path = tmp_path / "a.fits"
    table = fits.BinTableHDU.from_columns([fits.Column("x", "D", array=[1.0])], name="CAT")
    images = [fits.ImageHDU(PIXELS[i], header(OBSERVED), name="SCI", ver=i + 1) for i in range(2)]
    kind = {"compression_type": "GZIP_1", "quantize_level": 0}  # lossless
    packed = fits.CompImageHDU(PIXELS[2], header(OBSERVED), name="PACKED", **kind)
    fits.HDUList([fits.PrimaryHDU(), table, *images, packed]).writeto(path)
    cases = {None: 0, 2: 0, "SCI": 0, "sci,2": 1, 3: 1, "3": 1, "PACKED": 2, ("SCI", 2): 1}
    for hdu, i in cases.items():
        np.testing.assert_array_equal(read_image(path, hdu=hdu).data[0], PIXELS[i])
    assert "holds no" in refusal(read_image, path, hdu="CAT")
    assert "holds no" in refusal(read_image, path, hdu=0)
    for hdu in ("NONE", 9, "SCI,3"):
        assert "2 SCI, 3 SCI" in refusal(read_image, path, hdu=hdu)


def test_a_band_axis_in_front_is_moved(tmp_path):
    """FITS axes (band, RA, Dec): the array's last axis is the band."""
    cards = header(OBSERVED, NAXIS=3, WCSAXES=3)
    for key in ("CTYPE", "CRPIX", "CRVAL", "CDELT"):
        for i in (2, 1):
            cards[f"{key}{i + 1}"] = cards[f"{key}{i}"]
        del cards[f"{key}1"]
    cards["CTYPE1"] = "FREQ"
    path = stored(tmp_path / "a.fits", np.moveaxis(PIXELS, 0, -1), cards)
    image = read_image(path)
    np.testing.assert_array_equal(image.data, PIXELS)
    truth = Grid.from_wcs(WCS(header(OBSERVED)), OBSERVED)
    np.testing.assert_allclose(image.grid.sky(3, 5), truth.sky(3, 5), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["PC+CDELT", "CD", "SIP", "TPV"])
def test_a_cube_may_be_distorted(tmp_path, kind):
    cards = dict(observed_headers())[kind].copy()
    truth = Grid.from_wcs(WCS(cards), OBSERVED)
    cards.update(CTYPE3="FREQ", CRPIX3=1.0, CRVAL3=1e9, CUNIT3="Hz")
    cards["CD3_3" if "CD1_1" in cards else "CDELT3"] = 1e6
    image = read_image(stored(tmp_path / "a.fits", PIXELS, cards))
    n, m = np.indices(OBSERVED)
    np.testing.assert_allclose(image.grid.sky(n, m), truth.sky(n, m), rtol=0, atol=1e-12)
    path = stored(tmp_path / "b.fits", PIXELS, cards, PC1_3=0.1, PC3_1=0.2)
    assert "WCS" in refusal(read_image, path).upper()  # the sky differs from band to band


def test_bad_pixels_are_counted(tmp_path):
    data = PIXELS.copy()
    data[0, 3, 4], data[2, 1, 1:3] = np.nan, np.inf
    assert read_image(stored(tmp_path / "a.fits", data, header(OBSERVED))).n_invalid == 3


def test_files_that_are_no_images(tmp_path, cube):
    assert "is a directory" in refusal(read_image, tmp_path)
    assert "no such file" in refusal(read_image, tmp_path / "none.fits")
    whole = cube.read_bytes()
    bad = {
        "empty": b"",
        "text": b"no image at all\n" * 500,
        "header": whole[:1500],
        "headless": whole[2880:],
        "short": whole[:10000],
        "pixels": whole[:2880],
        "short.gz": gzip.compress(whole)[:9000],
    }
    for name, content in bad.items():
        path = tmp_path / (name if name.endswith("gz") else f"{name}.fits")
        path.write_bytes(content)
        text = refusal(read_image, path)
        assert text.startswith(f"{path}: ")
        assert "truncated" in text or name not in ("short", "pixels")
        refusal(read_psf, path)
    fits.PrimaryHDU().writeto(tmp_path / "none.fits")
    assert "no HDU holds" in refusal(read_image, tmp_path / "none.fits")
    for shape in ((4,), (2, 2, 4, 4)):
        path = stored(tmp_path / f"{len(shape)}.fits", np.ones(shape, np.float32))
        assert "no HDU holds" in refusal(read_image, path)


def test_only_padding_missing_is_no_loss(tmp_path, cube):
    whole = cube.read_bytes()
    end = 2880 + PIXELS.nbytes
    assert end < len(whole)
    path = tmp_path / "unpadded.fits"
    path.write_bytes(whole[:end])
    np.testing.assert_array_equal(read_image(path).data, PIXELS)


def test_headers_without_a_usable_wcs(tmp_path):
    wrong = {
        "none": {},
        "linear": {"CTYPE1": "X", "CTYPE2": "Y"},
        "half": {"CTYPE1": "RA---TAN", "CTYPE2": "FREQ"},
        "scale": header(OBSERVED, CDELT1=0.0),
        "singular": cd_header(OBSERVED, np.ones((2, 2))),
        "projection": header(OBSERVED, ctype="QQQ"),
    }
    for name, cards in wrong.items():
        path = stored(tmp_path / f"{name}.fits", PIXELS[0], cards)
        text = refusal(read_image, path)
        assert text.startswith(f"{path}: ") and "WCS" in text.upper()


def test_bands_that_are_not_there(cube):
    for bands in ("z", 3, -1, ["g", "y"]):
        assert "0 = g, 1 = r, 2 = i" in refusal(read_image, cube, bands=bands)
    assert "none" in refusal(read_image, cube, bands=[])


def test_samples_that_are_no_psf(tmp_path):
    path = stored(tmp_path / "a.fits", -np.ones((5, 5)))
    assert "sum" in refusal(read_psf, path)
    assert "spacing" in refusal(read_psf, path, spacing=0)


@pytest.mark.parametrize("kind", ["CD", "CROTA", "SIP", "TPV", "cube", "tables", "flat"])
def test_what_is_written_reads_back(tmp_path, kind):
    wcs = with_tables() if kind == "tables" else dict(observed_headers()).get(kind)
    grid = (
        FLAT if kind == "flat" else Grid.from_wcs(WCS(wcs) if kind != "tables" else wcs, OBSERVED)
    )
    coverage = RNG.random(OBSERVED) > 0.3
    path = tmp_path / "out.fits"
    write_fits(path, PIXELS, grid, bands=["g", "r", "i"], coverage=coverage)
    image = read_image(path)
    np.testing.assert_array_equal(image.data, PIXELS)
    assert image.data.dtype == np.float32 and image.bands == ("g", "r", "i")
    placed = Grid.from_wcs(grid.to_wcs(), OBSERVED)
    n, m = np.indices(OBSERVED)
    np.testing.assert_allclose(image.grid.sky(n, m), placed.sky(n, m), rtol=0, atol=1e-11)
    found = read_image(path, hdu="COVERAGE")
    np.testing.assert_array_equal(found.data[0], coverage)
    if kind != "tables":  # their HDUs go with the image
        np.testing.assert_array_equal(found.grid.map_to(image.grid).matrix, np.eye(2))
    write_fits(path, PIXELS[1].astype(float), grid, bands=["r"], overwrite=True)
    image = read_image(path)
    assert image.data.dtype == np.float64 and image.bands == ("r",)
    assert fits.getheader(path)["NAXIS"] == 2
    assert os.listdir(tmp_path) == ["out.fits"]


def test_provenance_and_units(tmp_path):
    path = tmp_path / "out.fits"
    inputs = {"image": "/far/away/in.fits", "PSF": "b" * 80 + ".fits", "like": "réf.fits"}
    device = "pthread AMD EPYC\u2122"
    write_fits(
        path, PIXELS[0], FLAT, unit="nJy", device=device, inputs=inputs, shift_px=(-1.54, 0.25)
    )
    cards = fits.getheader(path)
    assert cards["CREATOR"].startswith("clresample ")
    assert (cards["CLDTYPE"], cards["CLDEVICE"]) == ("float32", "pthread AMD EPYC?")
    assert (cards["CLSHIFTY"], cards["CLSHIFTX"]) == (-1.54, 0.25)
    assert cards["BUNIT"] == "nJy"
    assert [cards[f"CLFILE{i}"] for i in (1, 2, 3)] == ["in.fits", "b" * 80 + ".fits", "r?f.fits"]
    assert cards.comments["CLFILE1"] == "image"
    with fits.open(path, checksum=True) as hdus:  # warns, and so fails, were a checksum wrong
        hdus.verify("exception")


def test_an_output_is_whole_or_absent(tmp_path, monkeypatch):
    path = tmp_path / "out.fits"
    path.write_bytes(b"precious")
    assert "exists" in refusal(write_fits, path, PIXELS, FLAT)

    def full(hdus, name, **kwargs):
        with open(name, "wb") as part:
            part.write(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fits.HDUList, "writeto", full)
    assert "No space" in refusal(write_fits, path, PIXELS, FLAT, overwrite=True)
    assert path.read_bytes() == b"precious"
    assert os.listdir(tmp_path) == ["out.fits"]


def test_a_compressed_output_is_compressed(tmp_path):
    path = tmp_path / "out.fits.gz"
    write_fits(path, PIXELS, FLAT)
    assert path.read_bytes()[:2] == b"\x1f\x8b"
    np.testing.assert_array_equal(read_image(path).data, PIXELS)


def test_shapes_that_disagree(tmp_path):
    path = tmp_path / "out.fits"
    wrong = [
        ((PIXELS[:, 1:],), {}),
        ((PIXELS[0, 0],), {}),
        ((PIXELS,), {"bands": ["g"]}),
        ((PIXELS,), {"coverage": np.ones((2, 2))}),
    ]
    for args, kwargs in wrong:
        with pytest.raises(ValueError, match="shape|names"):
            write_fits(path, *args, FLAT, **kwargs)
    assert not path.exists()


def test_real_files(data):
    folder = data / "hst_hsc"
    hst, hsc = read_image(folder / "hst_f814w.fits"), read_image(folder / "hsc_grizy.fits", bands=2)
    assert (hst.data.shape, hsc.data.shape) == ((1, 250, 250), (1, 50, 50))
    assert (hst.n_invalid, hsc.n_invalid) == (0, 0)
    whole = fits.getdata(folder / "hsc_grizy.fits")
    np.testing.assert_array_equal(hsc.data[0], whole[2])
    with pytest.warns(PSFWarning, match=r"\(\+1.21, \+0.79\)"):
        read_psf(folder / "psf_hst_f814w.fits")
    psf = read_psf(folder / "psf_hst_f814w.fits", center="core")
    np.testing.assert_allclose(psf.center, [(90, 90)], atol=0.25)
    assert "no celestial WCS" in refusal(read_image, folder / "psf_hst_f814w.fits")
