"""Decoded strips of compressed images: the pixels of the file, decoded once, within a bound."""

import numpy as np
import pytest
from astropy.io import fits

from clresample.fields.strips import (
    MAX_BYTES,
    STRIP_PX,
    FilePlane,
    StripCache,
    _opened,
    read_section,
)
from clresample.sky.box import Box

SHAPE = 3, 150, 90


@pytest.fixture
def cube():
    return np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)


@pytest.fixture(params=[(1, 1, 90), (1, 20, 90), (1, 100, 90), (3, 150, 90)], ids=str)
def packed(request, tmp_path, cube):
    """The cube in tiles of whole rows."""
    path = tmp_path / "rows.fits"
    lossless = {"compression_type": "GZIP_2", "quantize_level": 0}
    fits.CompImageHDU(cube, tile_shape=request.param, **lossless).writeto(path)
    with fits.open(path) as hdus:
        yield hdus[1]


BOXES = [(0, 0, 10, 10), (60, 5, 70, 90), (149, 0, 150, 1), (0, 0, 150, 90), (30, 7, 131, 44)]


def test_strips_hold_the_pixels_of_the_file(packed, cube):
    strips = StripCache()
    for plane in (2, 0):
        for corners in [*BOXES, *BOXES[::-1]]:
            box = Box(*corners)
            np.testing.assert_array_equal(strips.read(packed, plane, box), cube[plane][box.slices])
    assert strips.n_bytes == 2 * cube[0].nbytes


def test_rows_are_decoded_once_and_the_oldest_go(packed, cube):
    class Counted:
        """An HDU that counts the rows it decodes."""

        shape, tile_shape, n_rows = packed.shape, packed.tile_shape, 0

        @property
        def section(self):
            return self

        def __getitem__(self, index):
            self.n_rows += index[1].stop - index[1].start
            return packed.section[index]

    hdu, strips = Counted(), StripCache()
    for corners in BOXES:
        strips.read(hdu, 1, Box(*corners))
    assert hdu.n_rows <= SHAPE[1] + STRIP_PX
    few = StripCache(most=8 * cube[0].nbytes)
    for _ in range(5):  # more than there is room for
        for plane in range(3):
            found = few.read(Counted(), plane, Box(30, 7, 131, 44))
            np.testing.assert_array_equal(found, cube[plane, 30:131, 7:44])
            assert 0 < few.n_bytes <= few.most


def test_strips_take_a_tenth_of_what_a_process_may_hold():
    strips = StripCache()
    strips.set_limit(1 << 30)
    assert strips.most == int(0.1 * (1 << 30)) < MAX_BYTES
    strips.set_limit(64 << 30)
    assert strips.most == MAX_BYTES
    strips.set_limit(None)
    assert strips.most == MAX_BYTES


def test_strips_that_are_cleared_are_decoded_again(packed, cube):
    strips, box = StripCache(), Box(0, 0, 10, 10)
    for _ in range(2):
        np.testing.assert_array_equal(strips.read(packed, 1, box), cube[1][box.slices])
        assert strips.n_bytes > 0
        strips.clear()
        assert strips.n_bytes == 0 and not strips._kept


def test_large_boxes_are_left_to_the_file(packed):
    assert StripCache(most=100_000).read(packed, 0, Box(0, 0, 150, 90)) is None


def test_images_in_cells_are_read_as_they_were(tmp_path, cube):
    path = tmp_path / "cells.fits"
    fits.CompImageHDU(cube[0], tile_shape=(30, 30)).writeto(path)
    with fits.open(path) as hdus:
        assert StripCache().read(hdus[1], None, Box(0, 0, 9, 9)) is None


def test_a_file_written_again_is_read_again(tmp_path, cube):
    path, box = tmp_path / "again.fits", Box(3, 4, 50, 60)
    for image in (cube[0], cube[1]):
        lossless = {"compression_type": "GZIP_2", "quantize_level": 0}
        fits.CompImageHDU(image, **lossless).writeto(path, overwrite=True)
        _opened.cache_clear()
        np.testing.assert_array_equal(FilePlane(path, 1).read(box), image[box.slices])


@pytest.mark.parametrize("card", [None, "BZERO", "BSCALE", "BLANK"])
def test_sections_of_plain_images_hold_the_pixels_of_the_file(tmp_path, card):
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 60000, SHAPE).astype(np.uint16 if card == "BZERO" else np.int16)
    header = fits.Header({card: 2} if card in ("BSCALE", "BLANK") else {})
    path = tmp_path / "plain.fits"
    fits.HDUList([fits.PrimaryHDU(pixels, header), fits.ImageHDU(pixels[1])]).writeto(path)
    with fits.open(path) as hdus, fits.open(path) as read:
        for corners in BOXES:
            box = Box(*corners)
            for i, plane, image in ((0, 2, read[0].data[2]), (1, None, read[1].data)):
                for got in (read_section(hdus[i], plane, box), FilePlane(path, i, plane).read(box)):
                    assert got.shape == box.shape
                    np.testing.assert_array_equal(got, image[box.slices])


def test_sections_of_compressed_images_take_their_own_tiles_alone(tmp_path, monkeypatch):
    """Whole rows of them would be decoded across the image."""
    path, taken = tmp_path / "packed.fits", []

    class Watched:
        def __getitem__(self, index):
            taken.append(index)
            return np.zeros([s.stop - s.start for s in index])

    fits.CompImageHDU(np.zeros((40, 50), np.float32), tile_shape=(8, 8)).writeto(path)
    monkeypatch.setattr(fits.CompImageHDU, "section", property(lambda _: Watched()))
    box = Box(*BOXES[0])
    with fits.open(path) as hdus:
        assert read_section(hdus[1], None, box).shape == box.shape
    assert taken == [box.slices]
