"""Light of a piece's galaxies beyond its frame, on the pixels of the pieces beside it."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.profiles import profile, psf_second_moment
from clresample.fields.execution.wings import continued, galaxies_beyond
from clresample.sky.box import Box
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE, THETA, PLACE = (40, 44), (np.log(9.0), 0.3, -0.2, 0.0), (22.0, 18.0)
LIGHT = np.array([300.0, 500.0])


def fitted(theta=THETA, structure=0.0):
    """A Result of one galaxy, its morphology the profile and structure that is not along it."""
    frame = SimpleNamespace(grid=Grid.flat(SHAPE, 0.1), shape=SHAPE, psf=PSF.gaussian(0.8))
    drawn = profile(theta, PLACE, SHAPE, psf_second_moment(frame.psf), slopes=False)[0]
    other = np.random.default_rng(0).normal(size=SHAPE) * drawn
    other -= drawn * (other * drawn).sum() / (drawn**2).sum()
    c = SimpleNamespace(
        source=0,
        origin=(0, 0),
        morphology=(drawn + structure * other) / drawn.max(),
        spectrum=LIGHT * drawn.max(),
    )
    return SimpleNamespace(
        frame=frame,
        components=(c,),
        sources=(ExtendedSource(position_px=PLACE),),
        thetas=((np.array(theta),),),
    )


@pytest.mark.parametrize("structure", [0.0, 0.5])
def test_a_galaxy_goes_on_beyond_its_frame(structure):
    """As its profile with all its light, whatever structure it has; in pixels of twice the side."""
    result = fitted(structure=structure)
    galaxies = galaxies_beyond(result)
    grid = Grid.flat((40, 40), 0.2)
    mosaic = SimpleNamespace(grid=grid)
    box, region = Box(10, 9, 30, 31), Box(2, 0, 38, 40)
    model = np.full((2, *box.shape), 7.0)
    given = galaxies, slice(0, 2), box, region, mosaic, result.frame.grid
    found = continued(model, *given)
    inside = box.relative_to(region).slices
    assert (found[:, *inside] == 7).all()
    at = grid.cutout(2, 0, region.shape).map_to(result.frame.grid)
    y, x = np.indices(region.shape)
    far = np.rint(at.at(y, x) + 60).astype(int)  # the same profile on a frame with a margin of 60
    moment = psf_second_moment(result.frame.psf)
    whole = profile(THETA, np.add(PLACE, 60), (160, 164), moment, slopes=False)[0]
    wanted = 4 * LIGHT[:, None, None] * whole[far[..., 0], far[..., 1]]
    beyond = np.ones(region.shape, bool)
    beyond[inside] = False
    # half a pixel beside the profile's own grid
    assert np.abs(found[:, beyond] / wanted[:, beyond] - 1).max() < 0.13
    assert found[:, beyond].sum() == pytest.approx(wanted[:, beyond].sum(), rel=0.02)


def test_small_galaxies_and_stars_end_in_their_frame():
    assert galaxies_beyond(fitted((np.log(1.5), 0.0, 0.0, 2.0))) == []
    star = fitted()
    star.thetas = ((np.zeros(2),),)
    assert galaxies_beyond(star) == []
