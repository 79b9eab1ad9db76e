"""Sources beside the end of one band's image, of which it has a few far pixels or none."""

import numpy as np
import pytest

from clresample import (
    PSF,
    ExtendedSource,
    Grid,
    Observation,
    PointSource,
    Settings,
    catalogue,
    deblend,
)
from clresample.measurement.catalogue import Flag

SIZE, CENTER = 41, (20.1, 19.8)
Y, X = np.mgrid[:SIZE, :SIZE]


def star(fwhm, center=CENTER):
    """A Moffat star of flux 1."""
    scale = fwhm / (2 * np.sqrt(2 ** (1 / 3.0) - 1))
    image = (1 + ((Y - center[0]) ** 2 + (X - center[1]) ** 2) / scale**2) ** -3.0
    return image / image.sum()


def scene(end, channels):
    """A star of flux 2e4 in three bands; the first one is observed left of the column `end`."""
    rng, fwhm = np.random.default_rng(3), [3.0, 3.4, 3.8]
    data = np.array([2e4 * star(f) + rng.normal(size=(SIZE, SIZE)) * 4 for f in fwhm])
    data[0, :, end:] = np.nan
    psf = np.array([star(f, (20, 20)) for f in fwhm])[channels]
    grid = Grid.flat((SIZE, SIZE), 0.2)
    return Observation(data[channels], PSF(psf), grid, variance=16.0)


@pytest.mark.parametrize("end", [2, 5, 8])
def test_a_few_far_pixels_of_a_band_leave_the_fit_alone(end):
    source = [ExtendedSource(position_px=CENTER)]
    with_band, without = (
        deblend([scene(end, channels)], source) for channels in ([0, 1, 2], [1, 2])
    )
    assert with_band.status == without.status
    assert len(with_band.losses) < 2 * len(without.losses)
    assert with_band.components[0].spectrum[0] == 0
    np.testing.assert_allclose(
        with_band.components[0].spectrum[1:], without.components[0].spectrum, rtol=0.02
    )


def test_a_star_without_a_band_is_not_saturated():
    source = [PointSource(position_px=CENTER, free_position=True)]
    table = catalogue(deblend([scene(0, [0, 1, 2])], source, settings=Settings(max_iter=20)))
    assert not table["flags"][0] & Flag.SATURATED
