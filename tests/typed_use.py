"""The public names as a typed program uses them: `make lint` checks it, nothing runs it.

A type checker must know every name (none is Any) and what each of the main calls returns.
"""

from typing import assert_type

import numpy as np

import clresample
from clresample import (
    PSF,
    Blend,
    Device,
    DeviceError,
    ExtendedSource,
    Failure,
    Frame,
    Grid,
    Observation,
    Resampler,
    Result,
    Settings,
    deblend,
    deblend_many,
    get_device,
    model_frame,
)

grid = Grid.flat((60, 60), 0.1)
psf = PSF.gaussian(1.5)
assert_type(grid, Grid)
assert_type(psf, PSF)

operator = Resampler(grid, psf, Grid.flat((30, 30), 0.2), psf, dtype=np.float64)
assert_type(operator, Resampler)

assert_type(Resampler(grid.to_wcs(), psf.images, grid, psf), Resampler)

observation = Observation(np.zeros((60, 60)), psf, grid, weights=1.0, channels=["VIS"])
frame = model_frame([observation])
assert_type(frame, Frame)

result = deblend([observation], [ExtendedSource(position_px=(30.0, 30.0))], settings=Settings())
assert_type(result, Result)
blends = [Blend((observation,), (ExtendedSource(position_px=(30.0, 30.0)),))]
assert_type(deblend_many(blends), list[Result | Failure])

try:
    assert_type(get_device(), Device)
except DeviceError as error:
    print(error)
print(clresample.__version__)
