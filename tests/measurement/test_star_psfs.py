"""PSFs of single stars with a masked core, from images of one star."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.assessment.cores import _model, _neighbour_errors
from clresample.deblending.blend import Blend
from clresample.deblending.component_images import ComponentImages
from clresample.deblending.inspection.image import InspectedImage
from clresample.deblending.inspection.inspect import inspect
from clresample.deblending.inspection.psf_samples import psf_at
from clresample.deblending.inspection.star_psfs import with_star_psfs
from clresample.deblending.settings import Settings
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource


def moffat(y, x, fwhm):
    radius = fwhm / 2 / np.sqrt(2**0.4 - 1)
    return (1 + (y**2 + x**2) / radius**2) ** -2.5 * 1.5 / (np.pi * radius**2)


def with_spikes(y, x, fwhm):
    """A Moffat profile with four diagonal spikes."""
    a, b = (y + x) / np.sqrt(2), (y - x) / np.sqrt(2)
    spikes = sum(np.exp(-np.abs(p) / 25 - 0.5 * (q / 1.7) ** 2) for p, q in ((a, b), (b, a)))
    return moffat(y, x, fwhm) + 8e-5 * spikes


def with_rings(y, x, fwhm):
    return moffat(y, x, fwhm) * (1.2 + np.sin(1.6 * np.hypot(y, x)))


def observed(*, size, half_px, fluxes, levels, fwhm=4.0, light=moffat, spacing_px=1.0):
    """An Observation of a star with saturated pixels, in one channel or several, and its place."""
    star = np.array([size // 2 + 0.3, size // 2 + 0.1])
    sides = (np.arange(size)[:, None] - star[0], np.arange(size) - star[1])
    data = np.array([flux * light(*sides, fwhm) for flux in fluxes])
    full = data > np.array(levels)[:, None, None]
    data += np.random.default_rng(1).normal(0, 1.0, data.shape)
    g = np.arange(-half_px, half_px + spacing_px, spacing_px)
    psf = PSF(np.array([light(g[:, None], g, fwhm)] * len(fluxes)), spacing=spacing_px)
    grid, names = Grid.flat((size, size), 1.0), tuple("gri"[: len(fluxes)])
    weights = np.where(full, 0.0, 1.0)
    return Observation(data, psf, grid, weights=weights, channels=names), star


def star_psfs(source=PointSource, **given):
    """Returns `with_star_psfs` of such a star listed as a kind of source, and its place."""
    observation, star = observed(**given)
    image = InspectedImage.of(observation, model_frame([observation]), star[None], np.zeros(2))
    return *with_star_psfs(image, [source(position_px=tuple(star))], False, False), star


@pytest.mark.parametrize("half_px", [30, 33])
def test_a_psf_image_that_reaches_beyond_the_observation_leaves_no_halo(half_px):
    image, *n, _ = star_psfs(size=41, half_px=half_px, fluxes=[3e6], levels=[6e4], fwhm=5.0)
    assert image.observation.psf_field is None
    assert not np.any(n)


def test_a_star_whose_wings_reach_the_edge_has_a_psf_of_its_own():
    """Its rings end there and do not rise, as those of diffraction would."""
    image, n_wide, n_own, _ = star_psfs(size=31, half_px=12, fluxes=[8e7], levels=[3e4])
    assert (n_wide, n_own) == (1, 1)
    assert image.observation.psf_field.flux_error[0, 0] > 0


@pytest.mark.parametrize("spacing_px", [1.0, 0.5])
def test_a_small_core_has_the_psf_within_its_image_and_a_halo_beyond(spacing_px):
    """Light of spikes beyond the image is not added to that of the PSF, which has them too."""
    given = {"size": 121, "half_px": 20, "fluxes": [4e6], "levels": [3e4], "light": with_spikes}
    image, _, n_own, star = star_psfs(**given, spacing_px=spacing_px)
    assert not n_own.any()
    own = image.observation.psf_field.psf_at(*star)
    along = np.arange(1.0, 28.0)  # a spike
    ratio = np.array([psf_at(own, 0, [d], [d])[0, 0] / with_spikes(d, d, 4.0) for d in along])
    within = along * np.sqrt(2) < 15  # a FWHM and more from the rim
    np.testing.assert_allclose(ratio[within], ratio[0], rtol=0.01)
    np.testing.assert_allclose(ratio[~within], ratio[0], rtol=0.12)


def test_a_wide_core_in_one_channel_makes_a_star_of_all_of_them():
    """With a halo in the channel of a small core; a galaxy with small cores alone stays one."""
    given = {"size": 61, "half_px": 12, "fluxes": [4e6, 2e7], "levels": [3e4, 3e4]}
    image, n_wide, n_own, star = star_psfs(ExtendedSource, **given)
    assert (n_wide, n_own) == (1, 1)
    own = image.observation.psf_field.psf_at(*star)
    light = [psf_at(own, band, [20.0], [0.0])[0, 0] for band in (0, 1)]
    assert min(light) > 0.5 * moffat(20, 0, 4.0)
    image, *n, _ = star_psfs(ExtendedSource, **{**given, "fluxes": [4e6, 4e6]})
    assert image.observation.psf_field is None and not np.any(n)


def test_a_faint_dark_ring_with_a_brighter_one_beyond_is_of_diffraction():
    given = {"size": 61, "half_px": 20, "fluxes": [5e5], "levels": [1e3]}
    _, n_wide, n_own, _ = star_psfs(**given, light=with_rings, spacing_px=0.5)
    assert (n_wide, n_own) == (1, 0)


def test_a_star_with_rings_that_rise_is_a_star_with_the_psf_passed():
    """Its light in the whole image leaves the sky's level open."""
    given = {"size": 61, "half_px": 20, "fluxes": [2e7], "levels": [3e4]}
    observation, star = observed(**given, light=with_rings, spacing_px=0.5)
    blend = Blend([observation], [ExtendedSource(position_px=tuple(star))])
    found = inspect(blend, model_frame([observation]), star[None], np.zeros((1, 2)), Settings())
    assert [type(source) for source in found.blend.sources] == [PointSource]
    assert found.blend.observations[0].psf_field.keeps_core.all()
    assert np.isinf(found.levels[0].error).all()
    assert not [message for message in found.messages if "sky" in message]


@pytest.mark.parametrize("star, place", [(0, None), (2, None), (0, (1.3, 2.6))])
def test_a_neighbour_has_the_error_of_a_stars_light_of_one_sign_over_all_of_it(star, place):
    """|sum w m (L, r . grad L)| / sum w m^2 flux: of sources of two components, without flux, and
    only partly in a star's light; no source has that of its own."""
    rng, psf_error = np.random.default_rng(2), 0.03
    low, spectra = [(0, 0), (1, 0), (2, 3), (0, 2)], np.array([[9e3, 4e3], [3, 2], [1, 5], [0, 0]])
    images = [rng.random((2, *size)) for size in ((5, 6), (3, 4), (2, 3), (5, 4))]
    images = ComponentImages((4, 2, 5, 6), low, images)
    rendered = np.asarray(images)
    weights, used = rng.uniform(0.5, 2, (2, 5, 6)), rng.random((2, 5, 6)) < 0.8
    owner, sums = np.array([0, 1, 1, 2]), np.array([1.0, 3.0, 2.0, 4.0])
    parts = zip(owner, spectra, sums, strict=True)
    result = SimpleNamespace(
        components=[SimpleNamespace(spectrum=s, morphology=np.array(m)) for _, s, m in parts],
        rendered=[images],
        channel_slices=lambda: [slice(0, 2)],
        footprints=[SimpleNamespace(used=used)],
        observations=[SimpleNamespace(weights=weights)],
        sources=range(3),
        psf_error=psf_error,
    )
    others = {s: _model(result, 0, np.flatnonzero(owner == s)) for s in {0, 1, 2} - {owner[star]}}
    found = _neighbour_errors(result, 0, star, list(others), others.get, place)
    changes = [spectra[star][:, None, None] * rendered[star]]
    if place:
        y, x = np.indices((5, 6))
        slopes = np.gradient(changes[0], axis=(1, 2))
        changes.append((y - place[0]) * slopes[0] + (x - place[1]) * slopes[1])
    w = used / (1 / weights + psf_error**2 * sum(change**2 for change in changes))
    bright = spectra[:, :, None, None] * rendered
    flux = sums[:, None] * spectra
    models = [(bright[0], flux[0]), (bright[1] + bright[2], flux[1] + flux[2]), (rendered[3], 4.0)]
    wanted = [
        np.hypot(*[(w * model * one).sum((1, 2)) for one in (*changes, 0 * changes[0])[:2]])
        / (w * model**2).sum((1, 2))
        * flux
        for model, flux in models
    ]
    wanted[owner[star]] = [0, 0]
    np.testing.assert_allclose(found, wanted)


def test_neighbours_have_the_error_of_a_measured_stars_light_where_it_is_extrapolated():
    """psf_error of it up to the last ring, beside that all of it from twice that ring's radius."""
    light, used = np.full((1, 1, 24), 1e-3), np.ones((1, 1, 24), bool)
    images = ComponentImages((2, 1, 1, 24), [(0, 0), (0, 0)], [light, light.copy()])
    part = SimpleNamespace(spectrum=np.ones(1), morphology=np.ones((1, 1)))
    result = SimpleNamespace(
        components=[part, part],
        rendered=[images],
        channel_slices=lambda: [slice(0, 1)],
        footprints=[SimpleNamespace(used=used)],
        observations=[SimpleNamespace(weights=np.full(used.shape, 1e6))],
        sources=range(2),
        psf_error=0.1,
    )
    pixels, found = np.arange(24), []
    for low, high in ((0, 5), (12, 24)):
        model = np.where((pixels >= low) & (pixels < high), 1.0, 0.0)[None, None]
        other = (slice(0, 1), slice(0, 24)), model, np.ones(1)
        errors = _neighbour_errors(result, 0, 0, [1], lambda s, o=other: o, (0, 0), np.array([6.0]))
        found.append(result.psf_error * errors[1, 0])
    assert found == pytest.approx([1e-4, 1e-3])
