"""One patch of sky to deblend, and what stands for it where that failed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.frame import Frame
from ..sky.observation import Observation
from ..sky.sources import Source

# Status of a fit that Ctrl-C ended.
INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class Blend:
    """One patch of sky: what was seen, and what is there.

    observations: at least one Observation; sources: Point and Extended
    frame: the model's Frame; None = `model_frame` of the observations
    shifts (n_observations, 2) [model px]: of the observations' pixels, where known; a fit of shifts
        starts from them. What moved by more than a pixel is best fitted again from there
    """

    observations: tuple[Observation, ...]
    sources: tuple[Source, ...]
    frame: Frame | None = None
    shifts: np.ndarray | None = None


@dataclass(frozen=True)
class Failure:
    """A blend of a batch that could not be fitted; `status` says why."""

    blend: Blend
    status: str

    converged = False
