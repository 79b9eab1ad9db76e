"""Single rules of the fit and its errors: slips in them cost time, or change a rare fit."""

import time
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import blend

from clresample.deblending import fit as fit_module
from clresample.deblending.fit import Fit, render_fits, start_fits
from clresample.deblending.linear import aligned_observation
from clresample.deblending.linear.aligned_observation import (
    AlignedObservation,
    BandLimitedTransfer,
)
from clresample.deblending.settings import Settings
from clresample.deblending.solver.multiscale.evidence import (
    MIN_SEEN,
    SEEN_STRENGTH,
    LocalPowerSpectra,
    SourceEvidence,
)
from clresample.deblending.solver.multiscale.lbfgs_pairs import LbfgsPairs
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.paper.settings import PaperSettings
from clresample.sky.psf import PSF


def test_the_share_of_a_scale_that_is_seen_is_its_definition():
    """Of its power, what is over the noise where structure is a tenth of the peak."""
    prior = MultiscalePrior()
    spectra = LocalPowerSpectra(prior)
    y, x = np.indices((21, 21)) - 10
    rng = np.random.default_rng(0)
    response = 3 * rng.random((2, len(spectra.weight)))
    evidence = SourceEvidence(spectra, prior, np.exp(-np.hypot(y, x) / 3), response)
    spectrum = np.array([3.0, 1.0])
    power = 9 * response[0] + response[1]
    wanted = []
    for k in spectra.k:
        signal = SEEN_STRENGTH**2 * power * k
        wanted.append((spectra.weight * k * signal / (1 + signal)).sum())
    np.testing.assert_allclose(evidence.resolved_fraction(spectrum), np.maximum(wanted, MIN_SEEN))
    assert MIN_SEEN < min(wanted) < max(wanted) < 0.9


def test_pairs_lie_in_the_slots_that_kernels_look_at():
    """used: all pairs and the spare one are in slots before it; the oldest of a full ring goes."""
    pairs, n = LbfgsPairs(2, 3), 0
    for _ in range(6):
        which = np.array([1])
        slot = pairs.spare[1]
        pairs.take(which, np.ones((1, 4)), np.ones((1, 4)))
        n = min(n + 1, 3)
        assert pairs.count.tolist() == [0, n]
        held = {*pairs._order[1, : n + 1]}
        assert slot in held and max(held) < pairs.used[1] == len(held) == n + 1
    assert pairs.used.tolist() == [1, 4]


@pytest.mark.parametrize("size", [1.0, 1e-9, 1e9])
def test_pairs_that_show_curvature_are_kept_however_large_they_are(size):
    """s . y above a millionth of y . H y, and above 0."""
    pairs, shape = LbfgsPairs(4, 3), (4, 4)
    sy = size * np.array([2e-6, 0.5e-6, -1.0, 1.0])[:, None]
    yy = size * np.array([1.0, 1.0, 1.0, -1e-3])[:, None]  # below 0 by rounding alone
    pairs.take(np.arange(4), np.broadcast_to(sy, shape), np.broadcast_to(yy, shape))
    assert pairs.count.tolist() == [1, 0, 0, 1]


def test_weights_of_a_scene_are_those_that_bright_stars_have_lowered(device, monkeypatch):
    """Once, however often the fit starts."""

    def lowered(patch, point, settings):
        views = patch.views
        return [replace(v, sqrt_weights=0.5 * v.sqrt_weights) for v in views], point

    monkeypatch.setattr(fit_module, "with_psf_error_weights", lowered)
    one = Fit(blend(), Settings(), device, np.float32, pad=1)
    for _ in range(2):
        start_fits([one])
        for weights, view in zip(one.scene.weights, one.views, strict=True):
            np.testing.assert_allclose(weights, view.sqrt_weights**2)
            assert 0.2 < weights.max() < 0.3


def test_seconds_are_those_that_passed(device):
    began = time.perf_counter()
    one = Fit(blend(), PaperSettings(prior=None), device, np.float32, pad=1)
    start_fits([one])
    assert 0 < sum(one.seconds.values()) <= time.perf_counter() - began
    (seen,) = render_fits([one])
    shared = one.seconds["result"]
    found = one.result(seen).seconds
    assert 0 < shared < found["result"]
    assert sum(found.values()) <= time.perf_counter() - began


def test_no_frequency_of_an_exposure_is_beyond_the_models_pixels():
    """Of pixels as large as the model's, turned by 45 degrees, and of smaller ones."""
    cos = np.sqrt(0.5)
    for scale in (1.0, 0.6):
        matrix = scale * np.array([[cos, cos], [-cos, cos]])
        sharp = PSF.gaussian(0.3, n_pixels=15)
        nu_y, nu_x, d = BandLimitedTransfer(matrix, sharp, sharp).at((11, 13), 4.0)
        assert 0.4 < nu_y.max() <= 0.5 and 0.4 < np.abs(nu_x).max() <= 0.5
        assert d.shape == (len(nu_y), 1, len(nu_x))


def test_an_exposure_shows_what_the_operator_renders(device):
    """On pixels parallel to the model's, to a part of 1e-3, as far as it follows the light."""
    one = Fit(blend(), Settings(), device, np.float32, pad=1)
    view, observation = one.views[0], one.blend.observations[0]
    exposure = AlignedObservation.of(view, one.frame, observation, np.zeros(1, int))
    y, x = np.indices((13, 11))
    image = np.exp(-((y - 6) ** 2 + (x - 5) ** 2) / (2 * 1.7**2))
    whole = np.zeros(view.op.shape_in, np.float32)
    origin = np.array([8, 9])
    whole[:, 8:21, 9:20] = image
    wanted = view.op(whole) * view.sqrt_weights
    low, high = exposure.window(origin, image.shape)
    reach = exposure.reach_px
    for at, o, n, first, end in zip((exposure.y, exposure.x), origin, image.shape, low, high):
        near = np.flatnonzero((at >= o - reach) & (at < o + n - 1 + reach))
        assert (near[0], near[-1] + 1) == (first, end)
    seen = exposure.observe(image[None], 0, origin, low, high)[:, 0]
    part = wanted[:, low[0] : high[0], low[1] : high[1]]
    assert seen.shape == part.shape and min(part.shape[1:]) > 13
    np.testing.assert_allclose(seen, part, atol=2e-3 * wanted.max())


@pytest.mark.parametrize("angle", [0, 20])
def test_wider_pixels_hold_the_same_sums(device, monkeypatch, angle):
    """Of an image's products with itself, pixels as wide as the band allows, and its own."""
    one = Fit(blend(angle=angle), Settings(), device, np.float32, pad=1)
    view, observation = one.views[1], one.blend.observations[1]
    y, x = np.indices((13, 11))
    image = np.exp(-((y - 6) ** 2 + (x - 5) ** 2) / (2 * 1.7**2)).astype(np.float32)
    origin, sums, widths = np.array([8, 12]), [], []
    for wider in (1e9, 0.1):
        monkeypatch.setattr(aligned_observation, "MIN_REBIN_FACTOR", wider)
        found = AlignedObservation.of(view, one.frame, observation, np.zeros(1, int))
        low, high = found.window(origin, image.shape)
        seen = found.observe(image[None], 0, origin, low, high)[:, 0]
        sums.append(np.square(seen).sum((1, 2)))
        widths.append(found.x[1] - found.x[0])
    assert widths[1] > 1.03 * widths[0]
    np.testing.assert_allclose(sums[1], sums[0], rtol=0.01)
