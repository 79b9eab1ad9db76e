"""Small simulated scenes, made by the library itself, for the tests of the fit."""

import numpy as np

from clresample import get_device
from clresample.deblending.batch import deblend
from clresample.deblending.blend import Blend
from clresample.deblending.profiles import draw_psf, profile, psf_second_moment
from clresample.resampling.resampler import Resampler
from clresample.sky.frame import Frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

SHAPE = (30, 36)
MODEL_PSF = PSF.gaussian(0.8, n_pixels=19)
SHARP, BLURRED = PSF.gaussian(0.9, n_pixels=19), PSF.gaussian(1.1, n_pixels=15, n_bands=2)
# A galaxy and a smaller one: (y, x) [px], flux in (v, g, r) [counts], sigma [px]; sigma 0 = a star
GALAXIES = (((13.2, 12.1), (30, 20, 40), 2.0), ((16.0, 23.3), (25, 60, 50), 1.4))

BRIGHT = tuple((p, tuple(2 * np.array(f)), s) for p, f, s in GALAXIES)
FLUX = (100.0, 80.0, 90.0)


def grids(shape=SHAPE, angle=25):
    """Sharp pixels upright, and pixels of twice the size, turned."""
    half = shape[0] // 2, shape[1] // 2
    return Grid.flat(shape, 0.1), Grid.flat(half, 0.2, angle_deg=angle)


def truth(objects, shape=SHAPE):
    """Model (3, Ny, Nx) [counts] of objects as in GALAXIES."""
    model = np.zeros((3, *shape))
    for position, flux, sigma in objects:
        if sigma:
            parameters = np.array([np.log(sigma), 0.2, -0.1, np.log(20.0)])
            image = profile(parameters, position, shape, psf_second_moment(MODEL_PSF))[0]
        else:
            image = draw_psf(MODEL_PSF, position, shape)[0]
        model += np.array(flux)[:, None, None] * image
    return model


def observe(
    objects=GALAXIES,
    *,
    shape=SHAPE,
    angle=25,
    noise=0.05,
    seed=0,
    psfs=(SHARP, BLURRED),
    shift=(0, 0),
    sky=(0, 0, 0),
    unit=1.0,
):
    """Observations "e" (v) and "r" (g, r) of objects, the second moved by `shift` [model px].

    They are made in float64 if the device has it.
    """
    rng, model, found = np.random.default_rng(seed), truth(objects, shape), []
    dtype = np.float64 if get_device().has_fp64 else np.float32
    for k, (grid, psf) in enumerate(zip(grids(shape, angle), psfs, strict=True)):
        part = (slice(0, 1), slice(1, 3))[k]
        op = Resampler(
            Grid.flat(shape, 0.1),
            MODEL_PSF,
            grid,
            psf,
            dtype=dtype,
            shift=shift if k else (0, 0),
        )
        data = op.forward(model[part].astype(dtype)) + np.array(sky)[part, None, None]
        data += noise * rng.normal(size=data.shape)
        found.append(
            Observation(
                unit * data,
                psf,
                grid,
                weights=(unit * noise) ** -2,
                channels=(("v",), ("g", "r"))[k],
                name="er"[k],
            )
        )
    return tuple(found)


def sources(objects=GALAXIES):
    return tuple(
        ExtendedSource(position_px=p) if sigma else PointSource(position_px=p)
        for p, _, sigma in objects
    )


def frame(shape=SHAPE):
    return Frame(Grid.flat(shape, 0.1), MODEL_PSF)


def blend(objects=GALAXIES, **given):
    shape = given.get("shape", SHAPE)
    return Blend(observe(objects, **given), sources(objects), frame(shape))


def fit(b, device, **given):
    return deblend(b.observations, b.sources, frame=b.frame, device=device, **given)


def same(one, other):
    """Two results have the same components, to float32's rounding."""
    for a, b in zip(one.components, other.components, strict=True):
        np.testing.assert_allclose(a.morphology, b.morphology, atol=1e-6)
        np.testing.assert_allclose(a.spectrum, b.spectrum, rtol=1e-5)


def chi2(result):
    """Per pixel with a weight."""
    parts = [result.residual(i) * np.sqrt(o.weights) for i, o in enumerate(result.observations)]
    return np.nanmean(np.concatenate([p.ravel() for p in parts]) ** 2)


def alike(together, alone, dtype=np.float32):
    """Asserts that two results are equal within the rounding of 30 steps.

    Each step divides a gradient by its own size, so that the rounding of the smallest gradients
    makes steps of the usual length. In float64 the limit is that of starts: windows that
    several scenes share are larger, and contain 1e-8 more of the light, 3e-7 of the loss after
    all steps of the start.
    """
    close = dtype == np.float64
    assert together.frame.shape == alone.frame.shape and together.status == alone.status
    np.testing.assert_allclose(together.losses, alone.losses, rtol=3e-7 if close else 1e-3)
    np.testing.assert_allclose(together.shifts, alone.shifts, atol=1e-6 if close else 2e-3)
    np.testing.assert_allclose(together.sky, alone.sky, atol=1e-6 if close else 1e-3)
    for k, o in enumerate(alone.observations):
        assert together.model(k).shape == o.shape
        away = (together.model(k) - alone.model(k)) * np.sqrt(o.weights)
        assert np.abs(away).max() < (1e-4 if close else 0.1)  # sigma
        # what one does not cover, the other does not either; a faint pixel may round to nothing
        dark = (together.model(k) == 0) != (alone.model(k) == 0)
        assert np.abs(away + alone.model(k) * np.sqrt(o.weights))[dark].max(initial=0) < 1e-3
        assert np.abs(alone.model(k) * np.sqrt(o.weights))[dark].max(initial=0) < 1e-3
    for c, d in zip(together.components, alone.components, strict=True):
        assert (c.source, c.origin) == (d.source, d.origin)
        assert c.morphology.shape == d.morphology.shape
        together.source_model(c.source)  # its box lies inside the frame
