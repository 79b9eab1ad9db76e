"""Files on which astropy writes over memory or never ends: refused before it reads pixels."""

import numpy as np
import pytest
from astropy.io import fits
from helpers.headers import header

from clresample.files.fits import open_fits, read_image, read_pixels, read_psf
from clresample.files.whole_file import FileError


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


@pytest.mark.parametrize("key, value", [("ZNAXIS1", 7), ("ZNAXIS2", 4), ("ZTILE1", 11)])
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


def test_data_of_a_negative_size_are_refused(tmp_path):
    """The next header would begin where this one does: astropy reads it again and again."""
    path = tmp_path / "p.fits"
    fits.PrimaryHDU(np.ones((11, 11))).writeto(path)
    negative = b"GCOUNT  =                   -5"
    path.write_bytes(path.read_bytes().replace(b"EXTEND  =                    T", negative))
    with pytest.raises(FileError, match="damaged, HDU 0 has data of a negative size"):
        read_psf(path)
