"""Large galaxies are drawn on pixels of several model pixels, which resolve them."""

import numpy as np
import pytest
from helpers.geometries import sky_grid

from clresample.deblending.linear import component_batch
from clresample.deblending.linear.component_batch import (
    UNRESOLVED,
    StartComponent,
    peaks_of,
    pixels_of,
)
from clresample.deblending.linear.linearised_scenes import linearise
from clresample.deblending.profiles import GalaxyProfile, profile, wave_light
from clresample.deblending.start.profile_start import PRECISION, TOLERANCE
from clresample.deblending.view import WhitenedView
from clresample.resampling.cache import cached_resampler
from clresample.sky.frame import Frame
from clresample.sky.psf import PSF

SHAPE = 270, 290
MODEL_PSF = PSF.gaussian(0.8, n_pixels=15)


@pytest.mark.parametrize("beta", [0.3, 2.0, 20.0])
def test_largest_waves_are_those_of_the_transform(beta):
    n, moment = 401, 0.64 * np.eye(2)
    theta = np.array([np.log(4.0), 0.4, -0.3, np.log(beta)])
    image = profile(theta, (n // 2, n // 2), (n, n), moment, slopes=False)[0]
    waves, nu = np.abs(np.fft.fft2(image)), np.fft.fftfreq(n)
    distance = np.hypot(nu[:, None], nu)
    # of the whole profile, of which an image of 100 sigma has .998 if beta = 0.3
    for at in (0.03, 0.06, 0.12):
        near = np.abs(distance - at) < 0.5 / n
        bounds = [wave_light(theta[None], moment[None], at + e / n)[0] for e in (0.5, -0.5)]
        assert 0.99 * bounds[0] - 3e-3 < waves[near].max() < 1.01 * bounds[1] + 3e-3


def components(position, frame):
    return [StartComponent(0, 0, 0, GalaxyProfile(frame), np.array(position), frame.shape)]


@pytest.mark.parametrize("sigma_px, widest", [(1.2, 1), (10.0, 2), (25.0, 4)])
def test_pixels_are_as_wide_as_the_profile_allows(sigma_px, widest):
    frame = Frame(sky_grid(SHAPE, 0.1), MODEL_PSF)
    chosen, theta = components((130.0, 140.0), frame), [np.array([np.log(sigma_px), 0.1, 0.2, 2.0])]
    large, small = (np.array([[(10, 10), (side, side)]]) for side in (256, 128))
    assert pixels_of(chosen, theta, large, np.ones(1, bool)).tolist() == [widest]
    assert pixels_of(chosen, theta, large, np.zeros(1, bool)).tolist() == [1]
    assert pixels_of(chosen, theta, small, np.ones(1, bool)).tolist() == [1]


@pytest.mark.parametrize("scale, angle", [(0.1, 0.0), (0.2, 0.0), (0.17, 25.0)])
def test_images_and_slopes_are_those_of_narrow_pixels(device, monkeypatch, scale, angle):
    """Of a galaxy whose light ends in its box, to the waves that are not resolved.

    These fall as nu^-3 or faster: together they are at most 2 pi nu^2 times the first of them, and
    those of slopes that times 4, one more than the power by which they fall.
    """
    frame = Frame(sky_grid(SHAPE, 0.1), MODEL_PSF)
    grid = sky_grid(tuple(int(0.1 / scale * n) for n in SHAPE), scale, angle)
    op = cached_resampler(
        frame, grid, PSF.gaussian(1.6, n_pixels=31), dtype=np.float32, device=device
    )
    data = np.zeros(op.shape_out)
    view = WhitenedView(op, op.mapping, op.covered, np.ones(1), data + 1, data, None)
    chosen = components((131.3, 143.6), frame)
    theta, found = [np.array([np.log(20.0), 0.3, -0.2, 3.0])], []
    for wide in ((2, 4), (1,)):
        monkeypatch.setattr(component_batch, "WIDE_PX", wide)
        monkeypatch.setattr(component_batch, "UNRESOLVED", UNRESOLVED if 2 in wide else -1.0)
        looking = linearise([[view]], chosen, PRECISION, TOLERANCE, fit_sky=False)
        looking.render([0], theta, np.array([1000.0]), slopes=True, whiten=False)
        assert looking.slots.pixel.tolist() == [wide[-1]]
        ((window, images),) = looking.sights[0].lit_images()
        whole = np.zeros((len(images), *op.shape_out))
        whole[:, :, *window] = images
        found.append(whole)
    wide, narrow = found
    moment, nu = chosen[0].shape.psf_moment, 0.5 / 4
    light = 2 * np.pi * nu**2 * wave_light(theta[0][None], moment[None], nu)[0]
    part = light / peaks_of(chosen, theta)[0] * np.array([1, 4, 4, 4, 4])
    assert (np.abs(wide - narrow).max(axis=(1, 2, 3)) < part * np.abs(narrow[0]).max()).all()
    assert part.max() < 0.02
    assert (wide != narrow).any()
