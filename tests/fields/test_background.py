"""Levels of cells are those of the sky between the sources."""

import numpy as np
import pytest

from clresample.fields.background import clean_level, find_background
from clresample.sky.box import Box

SIDE = 256
EVERYWHERE = np.ones((SIDE, SIDE), bool)


def _field(spacing, seed=0):
    """Noise of sigma 1, and galaxies of peaks 5 to 100 in a loose grid, with wings r^-3."""
    rng = np.random.default_rng(seed)
    image, (y, x) = rng.normal(size=(SIDE, SIDE)), np.indices((SIDE, SIDE))
    for row in range(spacing // 2, SIDE, spacing):
        for column in range(spacing // 2, SIDE, spacing):
            dy, dx = rng.uniform(-5, 5, 2)
            r2 = (y - row - dy) ** 2 + (x - column - dx) ** 2
            image += 10 ** rng.uniform(0.7, 2) * (1 + r2 / 4) ** -1.5
    return image


@pytest.mark.parametrize("spacing", [SIDE * 4, 64, 46], ids=["empty", "few", "many"])
@pytest.mark.parametrize("tilt", [0, 0.01])
def test_the_level_of_a_cell_is_that_between_its_sources(spacing, tilt):
    slope = tilt * (np.indices((SIDE, SIDE))[1] - (SIDE - 1) / 2)
    levels = [clean_level(_field(spacing, seed) + slope - 0.3, EVERYWHERE) for seed in range(3)]
    assert abs(np.mean(levels) + 0.3) < 0.025


def test_a_subtracted_surface_has_no_light_of_galaxies():
    image = _field(46) + 7
    surface = find_background(
        lambda box: image[box.slices], lambda box: np.ones(box.shape, bool), image.shape
    ).read(Box(0, 0, SIDE, SIDE))
    assert abs(surface.mean() - 7) < 0.03


def test_pixels_that_are_masked_or_none_are_no_part_of_a_level():
    image, usable = _field(64), EVERYWHERE.copy()
    level = clean_level(image, usable)
    image[:, 100:130], usable[40:61] = np.nan, False
    image[40:61] = 1e6
    assert abs(clean_level(image, usable) - level) < 0.02


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_levels_have_the_unit_of_the_image(scale):
    image = _field(64)[:99, :50]
    usable = EVERYWHERE[:99, :50]
    expected = scale * clean_level(image, usable)
    assert clean_level(scale * image, usable) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("side", [7, 20])
def test_cells_with_few_blocks_have_the_clipped_median(side):
    image = np.random.default_rng(1).normal(3, 1, (side, side))
    assert abs(clean_level(image, np.ones(image.shape, bool)) - 3) < 0.5
    assert clean_level(np.full((side, side), 2.0), np.ones((side, side), bool)) == 2
