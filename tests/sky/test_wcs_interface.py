"""Grids of WCS objects behind astropy's common interface: gwcs, slices, other units and orders."""

import pickle

import numpy as np
import pytest
from astropy.wcs import WCS
from astropy.wcs.wcsapi import HighLevelWCSWrapper, SlicedLowLevelWCS
from helpers.geometries import sky_grid

from clresample import Grid
from clresample.sky.wcs import axis_names, celestial_frame
from clresample.sky.wcs_interface import Ape14Wcs

SHAPE = (300, 200)


def tangent_wcs(shape, sip=False):
    """A WCS of 0.1 arcsec pixels at 20 degrees; SIP moves its corners by a pixel or two."""
    return sky_grid(shape, 0.1, 20.0, sip=1e-4 if sip else 0.0).wcs


def behind(wcs):
    """A WCS of astropy's that is known by the common interface only."""
    return SlicedLowLevelWCS(wcs, Ellipsis)


def pixels(shape=SHAPE):
    return np.meshgrid(np.arange(0.0, shape[0], 13), np.arange(0.0, shape[1], 11), indexing="ij")


@pytest.mark.parametrize("sip", [False, True])
@pytest.mark.parametrize("wrap", [behind, lambda wcs: HighLevelWCSWrapper(behind(wcs))])
def test_a_grid_of_the_interface_is_that_of_the_wcs(sip, wrap):
    wcs = tangent_wcs(SHAPE, sip=sip)
    own, other = Grid.from_wcs(wcs, SHAPE), Grid.from_wcs(wrap(wcs), SHAPE)
    n, m = pixels()
    assert isinstance(other.wcs, Ape14Wcs)
    assert np.allclose(own.sky(n, m), other.sky(n, m), rtol=0, atol=1e-12)
    sky = own.sky(n, m)
    assert np.abs(other.pixel(*sky) - np.stack([n, m], axis=-1)).max() < 1e-7
    assert abs(own.pixel_scale_arcsec - other.pixel_scale_arcsec) < 1e-12
    cut = other.cutout(-7, 12, (40, 50))
    assert np.abs(cut.positions_in(own, 3.0, 4.0) - [-4, 16]).max() < 1e-7
    assert cut.map_to(own).geometry == "aligned"


def test_the_inverse_is_refined_where_the_package_stops_early():
    wcs = tangent_wcs(SHAPE, sip=True)
    place = Ape14Wcs.of(behind(wcs))
    n, m = (axis.ravel() for axis in pixels())
    world = place.world_at(n, m)
    x, y = place.low.world_to_pixel_values(*world)
    rough = np.hypot(x - m, y - n).max()
    fine = np.abs(place.pixels_at(*world) - np.stack([n, m], axis=-1)).max()
    assert rough > 1e-7 > 10 * fine


def test_fits_headers_of_the_interface_are_near_enough_to_measure_with():
    wcs = tangent_wcs(SHAPE, sip=True)
    grid = Grid.from_wcs(behind(wcs), SHAPE)
    written = WCS(grid.to_wcs().to_header(relax=True))
    assert written.sip is not None
    n, m = pixels()
    there = grid.positions_in(Grid.from_wcs(written, SHAPE), n, m)
    assert np.abs(there - np.stack([n, m], axis=-1)).max() < 1e-3
    plain = Grid.from_wcs(behind(tangent_wcs(SHAPE)), SHAPE).to_wcs()
    assert plain.sip is None


def test_latitude_first_and_galactic_frames():
    header = tangent_wcs(SHAPE).to_header()
    header["CTYPE1"], header["CTYPE2"] = "GLAT-TAN", "GLON-TAN"
    header["CRVAL1"], header["CRVAL2"] = -20.0, 359.99
    del header["RADESYS"]
    wcs = WCS(header)
    own, other = Grid.from_wcs(wcs, SHAPE), Grid.from_wcs(behind(wcs), SHAPE)
    n, m = pixels()
    assert np.allclose(own.sky(n, m), other.sky(n, m), rtol=0, atol=1e-12)
    assert (axis_names(other.wcs), celestial_frame(other.wcs).name) == (
        ("glon", "glat"),
        "galactic",
    )
    there = other.positions_in(Grid.from_wcs(other.to_wcs(), SHAPE), n, m)
    assert np.abs(there - np.stack([n, m], axis=-1)).max() < 1e-3


@pytest.mark.parametrize(
    ("wcs", "message"),
    [
        (behind(WCS(naxis=2)), "no celestial axes"),
        (SlicedLowLevelWCS(WCS(naxis=3), Ellipsis), "3 pixel and 3 world axes"),
        (7, "wcs is 7"),
    ],
)
def test_what_is_no_celestial_wcs_is_refused(wcs, message):
    with pytest.raises(ValueError, match=message):
        Grid.from_wcs(wcs, SHAPE)


def test_gwcs():
    gwcs = pytest.importorskip("gwcs")
    from astropy import coordinates, units as u
    from astropy.modeling import models

    matrix = np.array([[-0.8, 0.6], [0.6, 0.8]]) * 0.03 / 3600
    to_sky = (
        (models.Shift(-100.5) & models.Shift(-120.0))
        | models.AffineTransformation2D(matrix)
        | models.Pix2Sky_TAN()
        | models.RotateNative2Celestial(150.0, 2.0, 180.0)
    )
    frames = gwcs.coordinate_frames
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(u.pix, u.pix))
    sky = frames.CelestialFrame(reference_frame=coordinates.ICRS(), name="world")
    wcs = gwcs.WCS([(detector, to_sky), (sky, None)])
    wcs.bounding_box = ((-0.5, SHAPE[1] - 0.5), (-0.5, SHAPE[0] - 0.5))
    grid = pickle.loads(pickle.dumps(Grid.from_wcs(wcs, SHAPE)))
    assert abs(grid.pixel_scale_arcsec - 0.03) < 1e-9
    assert np.isfinite(grid.cutout(-30, -30, (9, 9)).sky(0, 0)).all()  # beyond the bounding box
    written = Grid.from_wcs(WCS(grid.to_wcs().to_header(relax=True)), SHAPE)
    n, m = pixels()
    assert np.abs(grid.positions_in(written, n, m) - np.stack([n, m], axis=-1)).max() < 1e-5
    assert wcs.bounding_box is not None  # the user's own is left as it is
