"""Listed sources just outside the images: the default frame has room for them."""

import numpy as np
import pytest
from helpers import scenes

from clresample import deblend
from clresample.deblending.blend import BESIDE_FWHM, MARGIN_FWHM, Blend
from clresample.measurement.catalogue import Flag, catalogue
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE, SCALE = (40, 44), 0.2
PLAIN = PSF.gaussian(1.4, n_pixels=31)
REACH = BESIDE_FWHM * float(PLAIN.fwhm_px[0])


def image(data=None):
    data = np.ones(SHAPE) if data is None else data
    return Observation(data, PLAIN, Grid.flat(SHAPE, SCALE), weights=1.0, name="one")


def frame_with(*places, named=False, **given):
    """The frame of a blend with sources at places (y, x) [px of the image]."""
    o = image()
    sky = [o.grid.sky(*place) for place in places]
    one = {"observation": "one"}
    pairs = zip(places, sky, strict=True)
    sources = [
        ExtendedSource(position_px=p, **one) if named else ExtendedSource(sky_deg=tuple(s), **given)
        for p, s in pairs
    ]
    return Blend((o,), tuple(sources)).resolve_frame(), o


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("place", [(-2.0, 20.0), (15.0, 45.5), (41.0, -1.0)])
def test_the_frame_grows_to_sources_beside_the_images(place, named):
    """On their side alone, by a margin; its pixels stay those of the images."""
    frame, o = frame_with((20.0, 20.0), place, named=named)
    first = o.grid.positions_in(frame.grid, 0.0, 0.0)
    np.testing.assert_allclose(first, np.rint(first), atol=1e-9)
    low, high = -first, np.array(frame.shape) - 1 - first
    margin = MARGIN_FWHM * PLAIN.fwhm_px[0]
    for axis, n in enumerate(SHAPE):
        before, after = place[axis] < -0.5, place[axis] > n - 0.5
        assert low[axis] == pytest.approx(np.floor(place[axis] - margin) if before else 0)
        assert high[axis] == pytest.approx(np.ceil(place[axis] + margin) if after else n - 1)


def test_it_stays_where_it_must():
    """Of sources further away, without any, in the frame's own pixels, and with its own image."""
    for place in ((-1.02 * REACH, 20.0), (39.4, 43.4), (np.nan, np.nan)):
        o = image()
        inside = ExtendedSource(position_px=(20, 20), observation="one")
        sky = o.grid.sky(*place) if np.isfinite(place).all() else (1e6, 1e6)
        blend = Blend((o,), (inside, ExtendedSource(sky_deg=tuple(map(float, sky)))))
        assert blend.resolve_frame().shape == SHAPE
    beside = ExtendedSource(sky_deg=tuple(image().grid.sky(-2.0, 20.0)))
    own = ExtendedSource(position_px=(20, 20))
    assert Blend((image(),), (own, beside)).resolve_frame().shape == SHAPE
    drawn = ExtendedSource(sky_deg=(0, 0), profile=np.ones(SHAPE))
    assert Blend((image(),), (drawn, beside)).resolve_frame().shape == SHAPE
    frame = Frame(image().grid, scenes.MODEL_PSF)
    assert Blend((image(),), (beside,), frame).resolve_frame() is frame


def test_light_of_a_source_beside_the_image_is_its_own(device):
    """A galaxy near the edge has its flux, where it had taken the other one's."""
    y, x = np.indices(SHAPE)
    places, fluxes, s2 = ((4.0, 20.0), (-1.5, 23.0)), (3000.0, 9000.0), 2.0**2 + 1.4**2
    light = sum(
        f * np.exp(-0.5 * ((y - a) ** 2 + (x - b) ** 2) / s2) / (2 * np.pi * s2)
        for f, (a, b) in zip(fluxes, places, strict=True)
    )
    o = image(light + np.random.default_rng(1).normal(size=SHAPE))
    sources = [ExtendedSource(sky_deg=tuple(o.grid.sky(*place))) for place in places]
    result = deblend([o], sources, device=device)
    table = catalogue(result)
    (channel,) = o.channels
    flux, error = table[f"flux_{channel}"].value, table[f"flux_err_{channel}"].value
    assert np.abs(flux - fluxes)[0] < 3 * error[0] < 0.5 * fluxes[0]
    assert abs(flux[1] - fluxes[1]) < 4 * error[1]
    assert Flag(table["flags"][1]) & Flag.NO_COVERAGE and not result.messages
