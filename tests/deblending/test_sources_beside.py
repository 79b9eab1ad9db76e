"""Listed sources just outside the images: the default frame has room for them."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from helpers import scenes

from clresample import deblend
from clresample.deblending.blend import Blend
from clresample.measurement.catalogue import Flag, catalogue
from clresample.sky.frame import MARGIN_PART, REACH_FWHM, Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE, SCALE = (40, 44), 0.2
PLAIN = PSF.gaussian(1.4, n_pixels=31)
REACH = REACH_FWHM * float(PLAIN.fwhm_px[0])


def image(data=None):
    data = np.ones(SHAPE) if data is None else data
    return Observation(data, PLAIN, Grid.flat(SHAPE, SCALE), weights=1.0, name="one")


def frame_with(*places, o=None):
    """The frame of a blend with sources at places (y, x) [px of the image], and the image."""
    o = image() if o is None else o
    sources = [ExtendedSource(sky_deg=tuple(map(float, o.grid.sky(*place)))) for place in places]
    return Blend((o,), tuple(sources)).resolve_frame(), o


@pytest.mark.parametrize("on_wcs", [False, True])
@pytest.mark.parametrize("place", [(-2.0, 20.0), (15.0, 43.5), (15.0, 45.5), (41.0, -1.0)])
def test_the_frame_grows_to_sources_beside_the_images(place, on_wcs):
    """On their side alone, by a margin; its pixels stay those of the images."""
    o = image()
    if on_wcs:
        grid = Grid.from_wcs(o.grid.to_wcs(ra_deg=150, dec_deg=2), SHAPE)
        o = Observation(np.ones(SHAPE), PLAIN, grid, weights=1.0, name="one")
    frame, o = frame_with((20.0, 20.0), place, o=o)
    first = o.grid.positions_in(frame.grid, 0.0, 0.0)
    np.testing.assert_allclose(first, np.rint(first), atol=1e-6)
    low, high = -np.rint(first), np.array(frame.shape) - 1 - np.rint(first)
    margin = MARGIN_PART * REACH
    for axis, n in enumerate(SHAPE):
        before, after = place[axis] < -0.5, place[axis] >= n - 0.5
        assert low[axis] == pytest.approx(np.floor(place[axis] - margin) if before else 0, abs=1)
        assert high[axis] == pytest.approx(np.ceil(place[axis] + margin) if after else n - 1, abs=1)
        assert (low[axis] < 0, high[axis] > n - 1) == (before, after)


def test_it_stays_where_it_must():
    """Of sources further away, without any, in the frame's own pixels, with images on these, and
    where all are outside."""
    for place in ((-1.02 * REACH, 20.0), (39.4, 43.4)):
        assert frame_with((20.0, 20.0), place)[0].shape == SHAPE
    assert frame_with((-2.0, 20.0))[0].shape == SHAPE
    beside = ExtendedSource(sky_deg=tuple(map(float, image().grid.sky(-2.0, 20.0))))
    for own in (
        ExtendedSource(position_px=(20, 20)),
        ExtendedSource(position_px=(20, 20), observation="one"),
        ExtendedSource(sky_deg=(0, 0), profile=np.ones(SHAPE)),
    ):
        assert Blend((image(),), (own, beside)).resolve_frame().shape == SHAPE
    frame = Frame(image().grid, scenes.MODEL_PSF)
    inside = ExtendedSource(sky_deg=(0, 0))
    assert Blend((image(),), (inside, beside), frame).resolve_frame() is frame


def test_no_place_in_the_projection_is_no_place_beside_the_frame():
    grid = Grid.from_wcs(image().grid.to_wcs(ra_deg=150, dec_deg=2), SHAPE)
    o = Observation(np.ones(SHAPE), PLAIN, grid, weights=1.0, name="one")
    places = (150.0, 2.0), (330.0, -2.0)  # the second on the other side of the sky
    sources = tuple(ExtendedSource(sky_deg=place) for place in places)
    assert Blend((o,), sources).resolve_frame().shape == SHAPE


def test_positions_are_those_of_each_source():
    """Of all kinds together, whatever their order."""
    grid = Grid.from_wcs(image().grid.to_wcs(ra_deg=150, dec_deg=2), SHAPE)
    o = Observation(np.ones(SHAPE), PLAIN, grid, weights=1.0, name="one")
    coordinate = SkyCoord(150.0003, 2.0002, unit="deg")
    sources = [
        ExtendedSource(sky_deg=(150.0, 2.0)),
        ExtendedSource(position_px=(3, 4)),
        ExtendedSource(sky_deg=coordinate),
        ExtendedSource(position_px=(5, 6), observation="one"),
        ExtendedSource(sky_deg=(150.0001, 1.9999)),
    ]
    frame = Frame(grid, scenes.MODEL_PSF)
    found = frame.positions_of(sources, [o])
    for source, place in zip(sources, found, strict=True):
        np.testing.assert_allclose(source.pixel(grid, [o]), place, atol=1e-9)
    assert frame.positions_of([]).shape == (0, 2)


def test_light_of_a_source_beside_the_image_is_its_own(device):
    """A galaxy near the edge has its flux, where it had taken the other one's."""
    y, x = np.indices(SHAPE)
    places, fluxes, s2 = ((4.0, 20.0), (-1.5, 23.0)), (3000.0, 9000.0), 2.0**2 + 1.4**2
    light = sum(
        f * np.exp(-0.5 * ((y - a) ** 2 + (x - b) ** 2) / s2) / (2 * np.pi * s2)
        for f, (a, b) in zip(fluxes, places, strict=True)
    )
    o = image(light + np.random.default_rng(1).normal(size=SHAPE))
    sources = [ExtendedSource(sky_deg=tuple(map(float, o.grid.sky(*p)))) for p in places]
    result = deblend([o], sources, device=device)
    table = catalogue(result)
    (channel,) = o.channels
    flux, error = table[f"flux_{channel}"].value, table[f"flux_err_{channel}"].value
    assert np.abs(flux - fluxes)[0] < 3 * error[0] < 0.5 * fluxes[0]
    assert abs(flux[1] - fluxes[1]) < 4 * error[1]
    assert Flag(table["flags"][1]) & Flag.NO_COVERAGE and not result.messages
