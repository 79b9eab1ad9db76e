"""Files on which astropy writes over memory or never ends: refused before it reads pixels."""

import bz2
import gzip
import io
import lzma
import zipfile

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from helpers.headers import header

from clresample.files.atomic import FileError
from clresample.files.fits import open_fits, read_image, read_pixels, read_psf
from clresample.files.headers import MAX_CARDS, check_headers
from clresample.files.source_table import read_sources


def compressed(path, shape, tile, kind="HCOMPRESS_1"):
    """Whole numbers, which this compression keeps."""
    data = np.random.default_rng(3).integers(0, 1000, shape).astype(np.int32)
    hdu = fits.CompImageHDU(data, header(shape[-2:]), compression_type=kind, tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    return data


def claim(path, key, value):
    """Another number for a card of the file's header."""
    raw = path.read_bytes()
    at = raw.index(f"{key:8}=".encode())
    card = f"{key:8}= {value:>20}".ljust(80).encode()
    path.write_bytes(raw[:at] + card + raw[at + 80 :])


@pytest.mark.parametrize("kind", ["HCOMPRESS_1", "RICE_1"])
@pytest.mark.parametrize(
    "shape, tile", [((30, 40), (30, 40)), ((30, 41), (16, 12)), ((2, 20, 30), (1, 16, 16))]
)
def test_whole_files_are_read(tmp_path, shape, tile, kind):
    data = compressed(tmp_path / "c.fits", shape, tile, kind)
    np.testing.assert_array_equal(read_image(tmp_path / "c.fits").data.reshape(shape), data)


@pytest.mark.parametrize("key, value", [("ZNAXIS1", 7), ("ZNAXIS2", 4)])
@pytest.mark.parametrize("read", [read_image, read_psf])
def test_tiles_larger_than_the_header_says_are_refused(tmp_path, key, value, read):
    compressed(tmp_path / "c.fits", (13, 13), (13, 13))
    claim(tmp_path / "c.fits", key, value)
    with pytest.raises(FileError, match=r"c.fits: HDU COMPRESSED_IMAGE is damaged: tile 0 is not"):
        read(tmp_path / "c.fits")
    with pytest.raises(FileError, match="is damaged"), open_fits(tmp_path / "c.fits") as hdus:
        read_pixels(tmp_path / "c.fits", hdus[1])


def test_a_tile_at_the_end_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / "c.fits"
    compressed(path, (26, 13), (13, 13))
    claim(path, "ZNAXIS2", 20)
    with pytest.raises(FileError, match="tile 1 is not of the 91 pixels"):
        read_image(path)


def shape_claims():
    """Cards that no file has, what is said of them, and the HDU that holds them."""
    for hdu in (0, 1):
        yield hdu, "NAXIS", "99999999999", "not in 0 to 999"  # astropy counts up to it
        yield hdu, "NAXIS", "1000", "not in 0 to 999"
        yield hdu, "NAXIS", "-2", "not in 0 to 999"
        yield hdu, "NAXIS", "1E9", "not a whole number"
        yield hdu, "NAXIS", "4", "no NAXIS3"
        yield hdu, "NAXIS1", "-1", "not in 0"
        yield hdu, "NAXIS1", "99999999999999999999", "not in 0"
        yield hdu, "NAXIS1", "4000000000000000000", "bytes of data by its header"
        yield hdu, "NAXIS2", "'a'", "not a whole number"
        yield hdu, "BITPIX", "999999", "not in -64 to 64"
        # data of a negative size: the next header would begin before this one
        yield hdu, "GCOUNT", "-5", "not in 0"
        yield hdu, "PCOUNT", "-500000", "not in 0"
        yield hdu, "GCOUNT", "9223372036854775807", "bytes of data by its header"
        yield hdu, "WCSAXES", "1000000000", "not in -inf to 999"
        yield hdu, "A_ORDER", "30000", "not in -inf to 9"  # 450 million names looked up
        yield hdu, "BP_ORDER", "3.0E4", "not in -inf to 9"
        yield hdu, "naxis", "99999999999", "not in 0 to 999"
    yield 2, "TFIELDS", "2000000000", "not in 0 to 999"  # a dictionary for each
    yield 2, "ZNAXIS", "99999999999", "not in 0 to 999"


def many(path):
    """An image, another, and a table."""
    pixels = np.ones((11, 11))
    full = header(pixels.shape, GCOUNT=1, PCOUNT=0, WCSAXES=2, A_ORDER=0, BP_ORDER=0)
    table = fits.BinTableHDU(Table({"x": [1.0]}))
    table.header["ZNAXIS"] = 2
    hdus = [fits.PrimaryHDU(pixels), fits.ImageHDU(pixels), table]
    for hdu in hdus[:2]:
        hdu.header.update(full)
    fits.HDUList(hdus).writeto(path, output_verify="ignore")


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzip"])
@pytest.mark.parametrize("hdu, key, value, said", list(shape_claims()))
def test_numbers_that_no_header_has_are_refused(tmp_path, hdu, key, value, said, zipped):
    path = tmp_path / "p.fits"
    many(path)
    assert read_image(path).data.shape == (1, 11, 11)
    with fits.open(path) as hdus:
        place = hdus[hdu].fileinfo()["hdrLoc"]
    raw = path.read_bytes()
    at = raw.index(f"{key.upper():8}=".encode(), place)
    raw = raw[:at] + f"{key:8}= {value:>20}".ljust(80).encode() + raw[at + 80 :]
    path.write_bytes(gzip.compress(raw) if zipped else raw)
    for read in (read_image, read_psf, read_sources):
        with pytest.raises(FileError, match=f"p.fits: damaged, HDU {hdu} has .*{said}"):
            read(path)


@pytest.mark.parametrize(
    "pack", [bz2.compress, lzma.compress, lambda raw: in_archive(raw)], ids=["bzip2", "xz", "zip"]
)
def test_compressed_files_are_looked_into(tmp_path, pack):
    path = tmp_path / "p.fits"
    many(path)
    raw = path.read_bytes()
    path.write_bytes(pack(raw))
    assert read_image(path).data.shape == (1, 11, 11)
    right, wrong = (f"NAXIS   = {n:>20}".encode() for n in (2, 99999999999))
    path.write_bytes(pack(raw.replace(right, wrong)))
    with pytest.raises(FileError, match="HDU 0 has NAXIS = 99999999999, not in 0 to 999"):
        read_image(path)


def in_archive(raw):
    """A ZIP file of one member."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("p.fits", raw)
    return file.getvalue()


def test_a_number_that_stands_twice_is_refused(tmp_path):
    """Astropy would take one or the other, depending on the way it reads."""
    path = tmp_path / "p.fits"
    many(path)
    claim(path, "EXTEND", "T")
    twice = path.read_bytes().replace(
        b"EXTEND  =                    T", b"NAXIS1  =                   10"
    )
    path.write_bytes(twice)
    with pytest.raises(FileError, match="HDU 0 has NAXIS1 = 10 and 11"):
        read_image(path)


def test_more_tiles_than_the_table_holds_are_refused(tmp_path):
    compressed(tmp_path / "c.fits", (13, 13), (13, 13), "RICE_1")
    claim(tmp_path / "c.fits", "ZNAXIS1", 10**12)  # a list of the tiles alone would be 8 TB
    claim(tmp_path / "c.fits", "ZTILE1", 1)
    with pytest.raises(FileError, match="HDU 1 holds 1 tiles of an image of 1000000000000"):
        read_image(tmp_path / "c.fits")


def test_a_header_without_an_end_is_not_looked_for_without_end(tmp_path):
    path = tmp_path / "p.fits"
    fits.PrimaryHDU(np.ones((11, 11))).writeto(path)
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"END" + b" " * 77, b" " * 80)[:2880] + b" " * 80 * MAX_CARDS)
    with pytest.raises(FileError, match=f"HDU 0 has a header of more than {MAX_CARDS} cards"):
        read_psf(path)


def test_random_groups_are_passed_over(tmp_path):
    """Their first axis has no pixel and does not count: the next header is behind their data."""
    path = tmp_path / "p.fits"
    pixels = np.ones((3, 1, 1, 4, 5), "f4")
    data = fits.GroupData(pixels, bitpix=-32, parnames=["t"], pardata=[np.arange(3.0)])
    groups = fits.GroupsHDU(data)
    fits.HDUList([groups, fits.ImageHDU(np.ones((9, 9)))]).writeto(path)
    assert read_psf(path).images.shape == (1, 9, 9)
    claim_in_last = path.read_bytes().rfind(b"NAXIS   =")
    raw = bytearray(path.read_bytes())
    raw[claim_in_last + 10 : claim_in_last + 30] = b"99999999999".rjust(20)
    path.write_bytes(raw)
    with pytest.raises(FileError, match="HDU 1 has NAXIS = 99999999999"):
        read_psf(path)


@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["plain", "gzip"])
@pytest.mark.parametrize(
    "hdu, card, said",
    [
        (0, "TDIM1   =                    1", "begins with a header without SIMPLE"),
        (0, "SIMPLE  =                    F", "damaged, HDU 0 says that it is not FITS"),
        (1, "SIMPLE  =                    F", "damaged, HDU 1 says that it is not FITS"),
    ],
)
def test_headers_of_no_known_kind_are_refused(tmp_path, pack, hdu, card, said):
    """astropy reads those of compressed files again and again, without end."""
    path = tmp_path / "t.fits"
    table = fits.BinTableHDU(Table({"y": [4.0], "x": [4.0]}))
    fits.HDUList([fits.PrimaryHDU(np.ones((3, 3))), table]).writeto(path)
    with fits.open(path) as hdus:
        at = hdus[hdu].fileinfo()["hdrLoc"]
    raw = path.read_bytes()
    path.write_bytes(pack(raw[:at] + card.ljust(80).encode() + raw[at + 80 :]))
    for read in (read_image, read_psf, read_sources):
        with pytest.raises(FileError, match=rf"t\.fits: .*{said}"):
            read(path)


def test_a_compressed_text_is_no_header(tmp_path):
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress(b"y,x\n4.0,5.0\n"))
    check_headers(path)
