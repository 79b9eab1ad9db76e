"""Our operator inside scarlet2: a Renderer for observations of any pixels, rotation and PSF."""

from __future__ import annotations

import functools

import numpy as np

from ..resampling.resampler import Resampler
from ..sky.grid import Grid
from ..sky.psf import PSF
from .jax import as_jax
from .optional import require


def renderer_of(model_frame, obs_frame, *, device=None, dtype=np.float32):
    """A scarlet2 Renderer from a model frame to an observation's, by one Resampler.

        observation.match(scene.frame, renderer_of(scene.frame, observation.frame))

    It replaces scarlet2's own convolution and resampling: exact for band-limited models, for any
    rotation, parity and distortion of the WCS, and differentiable by the operator's own adjoint.

    model_frame, obs_frame: scarlet2.Frame, with WCS and PSF; the model must have the observation's
        channels
    device: see `get_device`; dtype: float32, or float64 under jax_enable_x64

    Raises ImportError without scarlet2; ValueError for frames without a WCS or a PSF, and for
    channels that the model does not have.
    """
    for name, frame in (("model_frame", model_frame), ("obs_frame", obs_frame)):
        for part in ("psf", "wcs"):
            if getattr(frame, part) is None:
                raise ValueError(f"{name} has no {part}")
    missing = [c for c in obs_frame.channels if c not in model_frame.channels]
    if missing:
        raise ValueError(f"obs_frame has channels {missing} that model_frame has not")
    channels = [list(model_frame.channels).index(c) for c in obs_frame.channels]
    psf_model = _psf(model_frame)
    op = Resampler(
        _grid(model_frame),
        psf_model.select(channels if psf_model.n_bands > 1 else [0] * len(channels)),
        _grid(obs_frame),
        _psf(obs_frame),
        dtype=dtype,
        device=device,
    )
    return _renderer_class()(as_jax(op), tuple(channels))


@functools.cache
def _renderer_class():
    """The scarlet2 Renderer class, defined at the first import of scarlet2."""
    equinox = require("equinox", "scarlet2")
    renderer = require("scarlet2.renderer", "scarlet2")

    class OperatorRenderer(renderer.Renderer):
        """The model's channels of an observation through a Resampler."""

        function: object = equinox.field(static=True)
        channels: tuple = equinox.field(static=True)

        def __call__(self, model, key=None):
            """Renders a model (C, Ny, Nx) in the observation (Co, My, Mx)."""
            return self.function(model[np.array(self.channels)])

    return OperatorRenderer


def _grid(frame):
    """The Grid of a scarlet2 Frame, its box being the WCS's first pixels."""
    return Grid.from_wcs(frame.wcs.celestial, frame.bbox.spatial.shape)


def _psf(frame):
    """The PSF of a scarlet2 Frame, which it evaluates on its own pixels."""
    return PSF(np.asarray(frame.psf(), np.float64))
