"""Shifts between observations are found during a fit, alone and in batches."""

import numpy as np
import pytest

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.inspection import shifted
from clresample.deblending.inspection.centroids import common
from clresample.deblending.inspection.inspect import InputWarning
from clresample.deblending.settings import Settings
from clresample.deblending.shifts import extrapolate, shift_steps
from clresample.deblending.solver.scene import Scene, State
from clresample.deblending.solver.scene_model import compose
from clresample.resampling.cache import cached_resampler
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHARP, BLURRED = Grid.flat((60, 66), 0.1), Grid.flat((34, 36), 0.2, angle_deg=15)


def test_one_source_that_moves_is_no_shift_of_its_image():
    """A star of proper motion, known better than six galaxies that stay where they are."""
    rng = np.random.default_rng(3)
    errors = np.array([0.03, *np.full(6, 0.05)])
    offsets = errors[:, None] * rng.normal(size=(7, 2))
    still, error = common(offsets, errors)
    assert (np.abs(still) < 4 * error).all() and (error < 0.05).all()
    offsets[0] += 0.8, -0.6
    moved, error = common(offsets, errors)
    assert (np.abs(moved) < 4 * error).all() and (error < 0.05).all()
    moved, error = common(offsets[:2], errors[:2])  # of two nobody knows which one
    assert (error > 0.2).all()
    shift, _ = common(offsets[1:] + 0.7, errors[1:])
    assert np.allclose(shift, 0.7, atol=0.1)


def blend(shift, *, seed=0, noise=1.0):
    """Two lopsided galaxies; the blurred image is moved by `shift` (2,) [model px]."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(SHARP.shape)
    scene = sum(
        flux * np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * size**2)) / (2 * np.pi * size**2)
        for a, b, flux, size in ((25, 25, 9e3, 2), (28, 31, 4e3, 4), (40, 45, 6e3, 2.5))
    )
    blank = [
        Observation(
            np.zeros((n, *grid.shape)),
            PSF.gaussian(1.5, n_pixels=31),
            grid,
            weights=noise**-2,
            channels=tuple(names),
            name=names,
        )
        for n, grid, names in ((1, SHARP, "V"), (2, BLURRED, "gr"))
    ]
    frame = model_frame(blank, grid=SHARP)
    made = []
    for o, move in zip(blank, (np.zeros(2), shift), strict=True):
        op = cached_resampler(frame, o.grid, o.psf, dtype=np.float64, private=True)
        op.shift = move
        data = op.render(scene) + rng.normal(0, noise, o.data.shape)
        made.append(
            Observation(data, o.psf, o.grid, weights=o.weights, channels=o.channels, name=o.name)
        )
    sources = ExtendedSource(position_px=(25, 25)), ExtendedSource(position_px=(40, 45))
    return Blend(tuple(made), sources, frame)


@pytest.mark.parametrize("shift", [(0, 0), (0.6, -0.4), (-2.5, 3.0)])
def test_a_shift_is_found(device, shift):
    b = blend(shift)
    given = {"frame": b.frame, "device": device}
    settings = Settings(fit_shifts=True, max_iter=40)
    first = deblend(b.observations, b.sources, settings=settings, **given)
    assert not first.shifts[0].any()
    # profiles started from images that disagree: of a large shift, some percent stay in them
    np.testing.assert_allclose(first.shifts[1], shift, atol=0.05, rtol=0.04)
    again = deblend(b.observations, b.sources, shifts=first.shifts, settings=settings, **given)
    np.testing.assert_allclose(again.shifts[1], shift, atol=0.03)
    fixed = deblend(b.observations, b.sources, shifts=again.shifts, **given)
    np.testing.assert_array_equal(fixed.shifts, again.shifts)
    for i in (0, 1):
        assert np.nanmean(fixed.residual(i) ** 2) < 1.15


@pytest.mark.parametrize("shifts", [np.zeros(2), [(0, 0), (np.nan, 0)]])
def test_shifts_that_cannot_be_are_refused(shifts):
    b = blend((0, 0))
    with pytest.raises(ValueError, match=r"shifts is .* must be \(2, 2\) finite numbers"):
        deblend(b.observations, b.sources, frame=b.frame, shifts=shifts)


@pytest.mark.parametrize("choice", ["auto", False])
def test_a_shift_is_measured_and_fitted_unless_refused(device, choice):
    b = blend((1.2, -0.8))
    settings = Settings(fit_shifts=choice, max_iter=40)
    with pytest.warns(InputWarning, match=r"light in gr lies away from .* their WCS disagree"):
        result = deblend(b.observations, b.sources, frame=b.frame, device=device, settings=settings)
    if choice:
        np.testing.assert_allclose(result.shifts[1], (1.2, -0.8), atol=0.1)
    else:
        assert not result.shifts.any()


def test_what_agrees_is_fitted_as_without_shifts(device):
    """To the last bit, one by one and in a batch with one that is moved."""
    b, moved = blend((0, 0)), blend((1.2, -0.8))
    given = {"frame": b.frame, "device": device}
    auto, fixed = (
        deblend(
            b.observations, b.sources, settings=Settings(fit_shifts=choice, max_iter=20), **given
        )
        for choice in ("auto", False)
    )
    np.testing.assert_array_equal(auto.losses, fixed.losses)
    np.testing.assert_array_equal(auto.components[0].flux, fixed.components[0].flux)
    with pytest.warns(InputWarning, match="1 blend has problems"):
        many = deblend_many([b, moved], settings=Settings(max_iter=20), device=device)
    assert not many[0].shifts.any() and many[1].shifts.any()
    np.testing.assert_array_equal(many[0].losses, fixed.losses)


def test_batches_find_the_shifts_of_single_fits(device):
    blends = [blend(shift, seed=i) for i, shift in enumerate([(0.5, 0.5), (-1, 1), (2, 0)])]
    settings = Settings(fit_shifts=True, max_iter=200)
    together = deblend_many(blends, settings=settings, device=device)
    for b, result in zip(blends, together, strict=True):
        alone = deblend(b.observations, b.sources, frame=b.frame, settings=settings, device=device)
        np.testing.assert_allclose(result.shifts, alone.shifts, atol=2e-3)


def test_the_step_is_the_shift_of_a_right_model(device):
    """For a model that is right but for the shift, a first step goes all the way."""
    shift = np.array([0.15, -0.1])
    b = blend(shift, noise=1e-2)
    scene, state = truth(b, device)
    steps, gain = shift_steps(scene, state)
    np.testing.assert_allclose(steps[1], shift, atol=0.01)
    before = misfit(scene, state)
    scene.ops[1].shift = scene.ops[1].shift + steps[1]
    assert before - misfit(scene, state) == pytest.approx(gain, rel=0.05)
    scene.weights[1] = 0 * scene.weights[1]
    assert np.abs(shift_steps(scene, state)[0]).max() < 1e-3


def misfit(scene, state):
    """Half of chi2."""
    light = compose(scene.shape, scene.origin, state.morph, state.spectra)
    parts = zip(scene.ops, scene.channels(), scene.data, scene.weights, strict=True)
    return sum(0.5 * (w * (d - op(light[part])) ** 2).sum() for op, part, d, w in parts)


def test_steps_that_fall_off_are_summed_up():
    """A geometric series' limit in one step; no further than 5 steps, and not at all where they
    point backwards."""
    step = np.array([[0.0, 0.0], [0.3, -0.1]])
    np.testing.assert_allclose(extrapolate(step, 2 * step), 2 * step)
    np.testing.assert_allclose(extrapolate(step, 1.01 * step), 5 * step)
    for last in (-step, 0 * step):
        np.testing.assert_allclose(extrapolate(step, last), step)


def truth(b, device):
    """A Scene and State whose model is right."""
    y, x = np.indices(SHARP.shape)
    galaxies = ((25, 25, 9e3, 2), (28, 31, 4e3, 4), (40, 45, 6e3, 2.5))
    morphs = [np.exp(-((y - a) ** 2 + (x - c) ** 2) / (2 * s**2)) for a, c, _, s in galaxies]
    peaks = np.array([flux / (2 * np.pi * s**2) for _, _, flux, s in galaxies])
    scene = Scene(
        shape=SHARP.shape,
        unpadded_shape=SHARP.shape,
        ops=[
            cached_resampler(b.frame, o.grid, o.psf, dtype=np.float64, device=device, private=True)
            for o in b.observations
        ],
        data=[o.data for o in b.observations],
        weights=[o.weights for o in b.observations],
        origin=np.zeros((3, 2), int),
        center=np.array([(25, 25), (28, 31), (40, 45)]),
        profile=morphs,
        fixed=np.zeros(3, bool),
    )
    spectra = np.repeat(peaks[:, None], 3, axis=1)
    return scene, State(morphs, spectra, np.zeros(3))


@pytest.mark.filterwarnings("ignore:light in wide:clresample.InputWarning")
@pytest.mark.parametrize(("shift", "most", "named"), [(0.0, 0.1, 0), (0.2, 0.1, 1), (0.2, 0.0, 0)])
def test_a_shift_counts_by_the_size_of_the_pixels(device, monkeypatch, shift, most, named):
    """0.2" of an image with pixels of 0.6", known to 0.4 of those of 0.05"."""
    monkeypatch.setattr(shifted, "MAX_SHIFT_ERROR_PX", most)
    places = (-2.5, -2.0), (2.4, 2.2), (-2.2, 2.6), (2.6, -2.4)
    rng, observations = np.random.default_rng(3), []
    for name, n, scale, psf, flux in (
        ("sharp", 180, 0.05, 0.06, 9000),
        ("wide", 15, 0.6, 0.75, 160),
    ):
        off = shift if name == "wide" else 0.0
        y, x = (np.indices((n, n)) - (n - 1) / 2) * scale
        data, width = rng.normal(size=(n, n)), np.hypot(psf, 0.15)
        for y0, x0 in places:
            away = (y - y0 - off) ** 2 + (x - x0 + off) ** 2
            peak = flux * scale**2 / (2 * np.pi * width**2)
            data += peak * np.exp(-away / (2 * width**2))
        seen, grid = PSF.gaussian(psf / scale, pixel=False, n_pixels=31), Grid.flat((n, n), scale)
        observations.append(Observation(data, seen, grid, weights=1, name=name))
    sources = [ExtendedSource(sky_deg=place) for place in places]
    settings = Settings(max_iter=1, errors=False)
    result = deblend(observations, sources, settings=settings, device=device)
    assert sum("WCS disagree" in line for line in result.messages) == named
