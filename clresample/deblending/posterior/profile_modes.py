"""Modes of a component's smooth profile: its parameters, its position, its core and halo."""

from __future__ import annotations

import numpy as np

from ...sky.box import box_slices
from ..profiles import SIZE_SCATTER, GalaxyProfile, StarProfile, one_galaxy
from .moments import light_sums

# Scatter of galaxies in ln sigma, g1, g2 (Leauthaud et al. 2007) and ln beta, for errors: n = 1 is
# 1.9 from the expected ln beta. The prior of fits is narrower, which gives better models of faint
# galaxies. With 1.0 for ln beta sizes of simulated galaxies lie within their errors by 0.02 (joint)
# to 0.03 (Euclid) less often.
SCATTER = np.array([SIZE_SCATTER, 0.26, 0.26, 2.5])
# [px] Scatter of a catalogue's position. With 0.5 the errors of faint sources' positions are larger
# than their scatter by a half.
POSITION_PX = 0.1
# [peak] Scatter of two additional modes, a core proportional to p^2 and a halo proportional to
# sqrt(p), for the difference of galaxies from the family of profiles. Without them the sizes of
# simulated bright galaxies lie within their errors in 59 % of cases. HALO = 0.02 increases the
# coverage of sizes by 0.02 and that of fluxes above signal to noise 300 by 0.025, which is then too
# high. Twice or half the CORE has no effect.
CORE, HALO = 0.1, 0.01
# Which of a galaxy's modes, its last ones, are its four shape parameters.
SHAPE_MODES = np.arange(-8, -4)


# A box ends where its profile is below the noise of a pixel. Light beyond the box is summed on
# every side up to half of the box's side, at most FAR_PX: for a galaxy of signal to noise 10 this
# region has 1 % of the light and changes the size by 4 %. For a profile with wings the region
# extends inside the frame until only FAR_LIGHT of the light is left: de Vaucouleurs galaxies of r_e
# 40 to 60 px at signal to noise 30 to 60 have a third of their light there (bench.ladder). There
# HALO is multiplied by FAR_HALO: with twice as much the coverage of simulated galaxies' sizes is
# 0.02 higher.
FAR_PX, FAR_LIGHT, FAR_HALO = 24, 0.003, 0.2


def profile_modes(shape, theta, position, profile, origin, *, radial=1.0):
    """Slopes (k, ny, nx) of a profile in its box, prior scatter (k,), and sums beyond the box.

    These are the `light_sums` (6, 1 + k) of the profile and of its slopes.

    shape: ComponentProfile; theta (n,): its parameters; position (2,) [px]: in the frame
    profile (ny, nx): with max = 1; origin (2,) [px]: of the box in the frame
    radial: times CORE and HALO
    """
    core_and_halo = radial * CORE, radial * HALO
    if isinstance(shape, StarProfile):
        drawn = shape.draw_box(np.zeros(len(theta)), position, origin, profile.shape)
        drawn /= drawn[0].max()
        return drawn[1:], shape.scatter, np.zeros((6, 1 + len(theta)))
    if isinstance(shape, GalaxyProfile):
        low, size = _surroundings(shape, theta, position, np.array(origin), profile.shape)
        box = box_slices(origin - low, profile.shape)
        drawn = shape.draw(theta, position - low, tuple(size), moved=True)
        drawn /= drawn[0].max()
        images = np.concatenate([drawn, _core_and_halo(drawn[0])])
        near = images[1:, *box].copy()
        scatter = np.concatenate([SCATTER, [POSITION_PX] * 2, core_and_halo])
        images[:, *box] = 0
        far = light_sums(images, low) * np.append(np.ones(len(drawn)), [FAR_HALO] * 2)
        return near, scatter, far
    slopes = np.stack([-_slope(profile, axis) for axis in (0, 1)])  # of a given image
    images = np.concatenate([slopes, _core_and_halo(profile)])
    scatter = np.array([POSITION_PX, POSITION_PX, *core_and_halo])
    return images, scatter, np.zeros((6, 1 + len(images)))


def _surroundings(galaxy, theta, position, origin, size):
    """Window around a galaxy's box for the light beyond it: first pixel (2,), size (2,)."""
    near = np.minimum(np.array(size) // 2, FAR_PX)
    (level,) = one_galaxy(theta, galaxy.psf_moment).threshold(FAR_LIGHT)
    frame, (middle, half) = np.array(galaxy.shape), galaxy.bounding_box(theta, position, level)
    low = np.minimum(origin - near, np.maximum(np.floor(middle - half), 0))
    high = np.maximum(origin + size + near, np.minimum(np.ceil(middle + half) + 1, frame))
    return low.astype(int), (high - low).astype(int)


def _core_and_halo(profile):
    light = np.maximum(profile, 0)
    return np.stack([light**2, np.sqrt(light)])


def _slope(image, axis):
    """Difference quotient along an axis; 0 along a side of one pixel."""
    return np.gradient(image, axis=axis) if image.shape[axis] > 1 else np.zeros_like(image)
