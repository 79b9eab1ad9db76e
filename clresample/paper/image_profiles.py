"""Initial morphologies from the instruments' images, as in the paper's deblender.

The image of the sharpest instrument that detects a source above 5 sigma is used. Its channels are
combined by their signal to noise and interpolated to the model frame (Whittaker-Shannon). The
result is made symmetric about the source and monotone, and is 0 below the noise. For a source that
no instrument detects above 5 sigma, the images of all instruments are combined.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..deblending.blend import Blend
from ..deblending.solver.boxes import Boxes
from ..device.device import get_device
from ..resampling.resampler import Resampler
from ..sky.sources import ExtendedSource
from ..sky.validation.checks import check_instance
from .solver.constraints import MaxNorm, Monotone, Positivity, ProxChain

# [sigma] Signal to noise at a source's centre from which an instrument's image is used: below it
# the noise would shape the morphology. Then that of a pixel to count as light.
SEEN, LIGHT = 5.0, 1.0
# [model px] Half side of the region of the images that is used; light beyond is left out. A larger
# one costs time, and the fit's boxes are cut to the light afterwards.
RADIUS_PX = 30


def with_image_profiles(blend: Blend, *, device=None) -> Blend:
    """The blend with a `profile` for each extended source of one component that has none.

    device: see get_device

    Raises ValueError where `Blend.resolve_frame` does.
    """
    check_instance("blend", blend, Blend)
    device = get_device(device)
    frame = blend.frame or blend.resolve_frame()
    positions = frame.positions_of(blend.sources, blend.observations, blend.initial_shifts())
    inside = frame.contains(positions)
    views = [_in_frame(o, frame, device) for o in blend.observations]
    order = np.argsort([_sharpness(o) for o in blend.observations], kind="stable")
    sources = list(blend.sources)
    for i in np.flatnonzero(inside):
        source = sources[i]
        if not isinstance(source, ExtendedSource) or source.n_components not in (None, 1):
            continue
        if source.profile is None:
            profile = _profile(frame.shape, positions[i], [views[k] for k in order], device)
            sources[i] = replace(source, profile=profile)
    return replace(blend, sources=tuple(sources), frame=frame)


def _sharpness(observation):
    """Width [arcsec] of an observation's sharpest PSF."""
    return observation.psf.fwhm_px.min() * observation.grid.pixel_scale_arcsec


def _in_frame(observation, frame, device):
    """Signal-to-noise images (C, Ny, Nx) of an observation on the model's pixels, 0 if unseen."""
    root = np.sqrt(observation.weights)
    op = Resampler(observation.grid, observation.psf, frame.grid, observation.psf, device=device)
    return op.forward(observation.data * root)


def _profile(shape, position, views, device):
    """One source's profile (Ny, Nx), max = 1, from signal-to-noise images, sharpest first."""
    center = np.clip(np.floor(position + 0.5).astype(int), 0, np.array(shape) - 1)
    low = np.maximum(center - RADIUS_PX, 0)
    high = np.minimum(center + RADIUS_PX + 1, shape)
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    combined = [_combine(view[(slice(None), *part)], center - low) for view in views]
    seen = [image for image in combined if image[tuple(center - low)] > SEEN]
    image = seen[0] if seen else _combine(np.array(combined), center - low)
    image = np.minimum(image, _mirror(image, center - low))
    image[image < LIGHT] = 0
    image[tuple(center - low)] = max(image[tuple(center - low)], LIGHT)

    boxes = Boxes(np.zeros(1, int), low[None], np.array([image.shape]), (center - low)[None])
    morph = device.put(boxes.pack([image]))
    ProxChain(Positivity(), Monotone(), MaxNorm()).prox(morph, boxes.put(device))
    out = np.zeros(shape)
    out[part] = boxes.unpack(device.get(morph))[0]
    return out


def _combine(images, center):
    """Images in units of their noise (C, ny, nx), summed to the best signal at the centre."""
    signal = np.maximum(images[(slice(None), *center)], 0)
    if not signal.any():
        signal = np.ones(len(images))
    return np.tensordot(signal, images, 1) / np.linalg.norm(signal)


def _mirror(image, center):
    """The image turned by 180 degrees about a pixel; its own value where the mirror is outside."""
    out = image.copy()
    y, x = np.indices(image.shape)
    y, x = 2 * center[0] - y, 2 * center[1] - x
    there = (y >= 0) & (y < image.shape[0]) & (x >= 0) & (x < image.shape[1])
    out[there] = image[y[there], x[there]]
    return out
