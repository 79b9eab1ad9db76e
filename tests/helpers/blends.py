"""Fitted blends made by hand, for the tests of what is measured on them and stored of them."""

import numpy as np

from clresample.deblending.ended import Ended
from clresample.deblending.result import Component, Result
from clresample.sky.footprint import Footprint
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SCALE = 0.1  # [arcsec/px]
MIDDLE = (30.0, 35.0)  # [px] about the middle of the frame of `blend`


def gaussian(shape, center, covariance):
    """exp(-d^T Q^-1 d / 2) on pixels (ny, nx), d = (y, x) - center."""
    away = np.stack(np.indices(shape), axis=-1) - center
    return np.exp(-0.5 * np.einsum("yxi,ij,yxj->yx", away, np.linalg.inv(covariance), away))


def round_component(source, center, spectrum, *, n=21, sigma=1.5):
    """A round Gaussian in a box of n x n pixels about a centre [px]."""
    origin = tuple(int(round(c)) - n // 2 for c in center)
    image = gaussian((n, n), np.subtract(center, origin), sigma**2 * np.eye(2))
    return Component(source, origin, image, np.array(spectrum, float))


def observe(grid, channels, *, data=0.0, weights=1.0, **given):
    shape = (len(channels), *grid.shape)
    return Observation(
        np.broadcast_to(data, shape),
        PSF.gaussian(1.2, n_bands=len(channels)),
        grid,
        weights=np.broadcast_to(weights, shape),
        channels=channels,
        **given,
    )


def in_frame(component, shape):
    (y, x), (n_y, n_x) = component.origin, component.morphology.shape
    image = np.zeros(shape)
    image[y : y + n_y, x : x + n_x] = component.morphology
    return image


def on_pixels(component, observation, grid, shift):
    """The light (Co, My, Mx) of a component of a frame on this grid, as points."""
    footprint = Footprint(observation, observation.grid.map_to(grid), np.asarray(shift))
    held, pixels = footprint.nearest_pixels(np.stack(np.indices(grid.shape), axis=-1))
    image = np.zeros(observation.shape)
    np.add.at(image, (slice(None), *pixels[:, held]), in_frame(component, grid.shape)[held])
    return image


def blend(components, *, observations=None, sources=None, grid=None, **given):
    """A result, on the frame's own pixels where nothing else is rendered.

    Each source is put where the first of its components has its peak.
    """
    grid = Grid.flat((60, 70), SCALE) if grid is None else grid
    if observations is None:
        # weights so small that the model, which the data do not hold, is no misfit
        observations = (observe(grid, ("g", "r"), weights=1e-12),)
    if sources is None:
        peaks = {
            c.source: np.add(c.origin, np.unravel_index(c.morphology.argmax(), c.morphology.shape))
            for c in reversed(components)
        }
        sources = tuple(
            ExtendedSource(position_px=tuple(map(float, peaks[s]))) for s in sorted(peaks)
        )
    n, n_channels = len(components), sum(len(o.channels) for o in observations)
    images = np.array([in_frame(c, grid.shape) for c in components]).reshape(n, *grid.shape)
    shifts = given.get("shifts", np.zeros((len(observations), 2)))
    fields = {
        "rendered": tuple(
            np.repeat(images[:, None], len(o.channels), axis=1)
            if o.grid.shape == grid.shape
            else np.array([on_pixels(c, o, grid, shift) for c in components])
            for o, shift in zip(observations, shifts, strict=True)
        ),
        "sky": np.zeros(n_channels),
        "covariance": np.tile(np.eye(n), (n_channels, 1, 1)),
        "shifts": shifts,
        "losses": np.array([100.0, 10.0, 9.0]),
        "status": Ended.CONVERGED,
    }
    return Result(
        observations=tuple(observations),
        frame=Frame(grid, PSF.gaussian(0.8)),
        sources=tuple(sources),
        components=tuple(components),
        **(fields | given),
    )


def two_sources(**given):
    """A bulge and a disk about one centre, and a neighbour."""
    return blend(
        [
            round_component(0, (30, 28), (2.0, 1.0)),
            round_component(0, (30, 28), (0.5, 3.0), n=31, sigma=2.5),
            round_component(1, (30, 44), (1.0, 4.0)),
        ],
        **given,
    )


def one_source(center=MIDDLE, **given):
    """A round Gaussian of two channels."""
    return blend([round_component(0, center, (1, 1))], **given)
