"""Fits of awkward sources and awkward data."""

import numpy as np
import pytest
from helpers.scenes import BRIGHT, FLUX, GALAXIES, SHAPE, blend, chi2, fit, frame, observe, same

from clresample.deblending.batch import deblend
from clresample.deblending.settings import Settings
from clresample.measurement.photometry import fluxes
from clresample.sky.frame import Frame
from clresample.sky.observation import Observation
from clresample.sky.sources import ExtendedSource, PointSource

EXACT = Settings(max_iter=20)


@pytest.fixture(scope="module")
def plain(device):
    return fit(blend(BRIGHT), device)


def reweighted(observation, weights):
    o = observation
    return Observation(o.data, o.psf, o.grid, weights=weights, channels=o.channels, name=o.name)


@pytest.mark.parametrize("position", [(-0.5, 12.0), (29.49, 35.49), (0.0, 0.0), (15.0, 35.4)])
def test_a_source_at_the_very_edge(device, position):
    """Its part inside the frame is fitted, in a box inside."""
    b = blend(((position, FLUX, 1.5), GALAXIES[1]), noise=0.2)
    result = fit(b, device, settings=Settings(max_iter=60))
    for c in result.components:
        assert min(c.origin) >= 0
        assert (np.add(c.origin, c.morphology.shape) <= SHAPE).all()
        assert np.isfinite(c.spectrum).all() and (c.spectrum >= 0).all()
    assert result.components[0].flux[0] > 20 and chi2(result) < 1.3


def test_a_source_outside_is_reported_and_left_out(device):
    b = blend()
    more = (b.sources[0], ExtendedSource(position_px=(15, 35.6)), b.sources[1])
    result = deblend(b.observations, more, frame=b.frame, device=device, settings=EXACT)
    assert [c.source for c in result.components] == [0, 2]
    assert len(result.messages) == 1
    assert result.messages[0].startswith(
        "a source lies outside the model frame: source 1 at (y, x) = (15.0, 35.6) [px]"
    )
    assert not np.any(result.source_model(1))
    same(result, fit(b, device, settings=EXACT))
    with pytest.raises(ValueError, match="none of the 1 sources lies inside"):
        deblend(b.observations, more[1:2], frame=b.frame, device=device)


def test_no_sources_at_all(device):
    """Nothing to fit is a mistake that is named, or a result without components."""
    b = blend()
    try:
        result = deblend(b.observations, [], frame=b.frame, device=device)
    except ValueError as error:
        assert "sources" in str(error)
    else:
        assert result.components == ()


def test_a_source_on_masked_pixels(device):
    """Its core unseen by all, its wings and the other instrument's pixels show it."""
    b = blend(BRIGHT)
    masked = []
    for o, (y, x), r in zip(b.observations, ((13, 12), (6, 6)), (1, 0), strict=True):
        weights = o.weights.copy()
        weights[:, y - r : y + r + 1, x - r : x + r + 1] = 0
        masked.append(reweighted(o, weights))
    result = deblend(masked, b.sources, frame=b.frame, device=device)
    assert chi2(result) < 1.1
    np.testing.assert_allclose(result.components[0].flux, BRIGHT[0][1], rtol=0.05)


@pytest.mark.parametrize(
    "kinds",
    [(PointSource, PointSource), (ExtendedSource, ExtendedSource), (PointSource, ExtendedSource)],
)
def test_sources_exactly_on_each_other_share_the_light(device, kinds):
    drawn = ((15.0, 18.0), FLUX, 0 if kinds == (PointSource, PointSource) else 2.0)
    b = blend((drawn,))
    twins = [kind(position_px=drawn[0]) for kind in kinds]
    result = deblend(b.observations, twins, frame=b.frame, device=device, settings=EXACT)
    total = sum(c.flux for c in result.components)
    np.testing.assert_allclose(total, FLUX, rtol=0.05)
    assert all((c.spectrum >= 0).all() for c in result.components)
    assert np.isfinite(result.covariance).all()


def test_a_frame_of_one_pixel_row(device):
    """Boxes of one pixel across."""
    o = observe(GALAXIES[:1])
    thin = Frame(frame().grid.cutout(13, 0, (1, SHAPE[1])), frame().psf)
    result = deblend(
        o, [ExtendedSource(position_px=(0, 12))], frame=thin, device=device, settings=EXACT
    )
    (component,) = result.components
    assert component.morphology.shape[0] == 1 and np.isfinite(component.spectrum).all()


def test_a_free_star_moves_to_its_place(device):
    drawn = ((15.3, 18.2), FLUX, 0)
    b = blend((drawn, GALAXIES[0]))
    star = PointSource(position_px=(15, 18.5), free_position=True)
    result = deblend(b.observations, [star, b.sources[1]], frame=b.frame, device=device)
    m = result.components[0].morphology
    y, x = (np.indices(m.shape) * m).sum(axis=(1, 2)) / m.sum() + result.components[0].origin
    assert (y, x) == pytest.approx(drawn[0], abs=0.05)
    np.testing.assert_allclose(result.components[0].flux, FLUX, rtol=0.03)


def test_two_components_of_one_source(device):
    disk, bulge = ((15.0, 18.0), (500, 1000, 200), 3.0), ((15.0, 18.0), (600, 100, 900), 1.0)
    b = blend((disk, bulge))
    both = ExtendedSource(position_px=(15, 18), n_components=2)
    single = ExtendedSource(position_px=(15, 18), n_components=1)
    one = deblend(b.observations, [single], frame=b.frame, device=device)
    two = deblend(b.observations, [both], frame=b.frame, device=device)
    assert [c.source for c in two.components] == [0, 0]
    np.testing.assert_allclose(sum(c.flux for c in two.components), (1100, 1100, 1100), rtol=0.03)
    assert chi2(two) < 0.7 * chi2(one)


def test_sky_is_found(device):
    sky = np.array([0.3, -0.2, 0.5])
    b = blend(BRIGHT, sky=sky)
    for given in (Settings(fit_sky=True), Settings()):
        result = fit(b, device, settings=given)
        # 1080 and 270 pixels of noise 0.05, and the galaxies' wings
        np.testing.assert_allclose(result.sky, sky, atol=0.02)
        assert chi2(result) < 1.05
    assert chi2(fit(b, device, settings=Settings(fit_sky=False))) > 2


@pytest.mark.parametrize("unit", [1e-30, 1e-5, 1e10])
def test_units_do_not_matter(device, unit, plain):
    result = fit(blend(BRIGHT, unit=unit), device)
    assert result.status == plain.status
    for a, b in zip(result.components, plain.components, strict=True):
        np.testing.assert_allclose(a.morphology, b.morphology, atol=2e-3)
        np.testing.assert_allclose(a.spectrum, unit * b.spectrum, rtol=2e-3)
    np.testing.assert_allclose(result.covariance, unit**2 * plain.covariance, rtol=1e-2)


def test_double_precision_agrees(device, plain):
    if not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    result = fit(blend(BRIGHT), device, dtype=np.float64)
    for a, b in zip(result.components, plain.components, strict=True):
        np.testing.assert_allclose(a.morphology, b.morphology, atol=2e-3)
        np.testing.assert_allclose(a.spectrum, b.spectrum, rtol=2e-3)


def test_a_channel_without_weights(device, plain):
    """Flux 0 of infinite variance there; the others as usual."""
    b = blend(BRIGHT)
    blind = b.observations[1].weights * np.array([0, 1])[:, None, None]
    observations = b.observations[0], reweighted(b.observations[1], blind)
    result = deblend(observations, b.sources, frame=b.frame, device=device)
    assert result.status != "diverged"
    for c, d in zip(result.components, plain.components, strict=True):
        assert c.spectrum[1] == 0
        np.testing.assert_allclose(c.flux[[0, 2]], d.flux[[0, 2]], rtol=0.02)
    assert np.isinf(np.diagonal(result.covariance[1])).all()
    assert np.isfinite(result.covariance[[0, 2]]).all()
    assert np.isnan(result.residual(1)[0]).all() and np.isfinite(result.residual(1)[1]).all()


def test_a_channel_without_weights_at_one_source(device, plain):
    """It has no flux there, however bright the wings of the fit; the other source has one."""
    b = blend(BRIGHT)
    x = plain.footprints[1].positions[..., 1]
    blind = b.observations[1].weights * np.stack([x > 20, np.ones(x.shape)])
    observations = b.observations[0], reweighted(b.observations[1], blind)
    flux, covariance = fluxes(deblend(observations, b.sources, frame=b.frame, device=device))
    expected = np.array([[False, True, False], [False, False, False]])
    np.testing.assert_array_equal(np.isnan(flux), expected)
    np.testing.assert_array_equal(np.isnan(covariance[:, [0, 1], [0, 1]].T), expected)
    np.testing.assert_allclose(flux[1], fluxes(plain)[0][1], rtol=0.1)


def test_no_weights_at_all_are_refused(device):
    b = blend()
    empty = [reweighted(o, 0.0) for o in b.observations]
    with pytest.raises(ValueError, match="no observed pixel on the model frame has a weight"):
        deblend(empty, b.sources, frame=b.frame, device=device)
    half = (b.observations[0], empty[1])
    result = deblend(half, b.sources, frame=b.frame, device=device, settings=EXACT)
    assert np.isinf(result.covariance[1, 0, 0]) and np.isfinite(chi2(result))
