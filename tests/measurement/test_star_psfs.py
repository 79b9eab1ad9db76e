"""PSFs of single stars with a masked core, from images of one star."""

import numpy as np
import pytest

from clresample.deblending.inspection.image import InspectedImage
from clresample.deblending.inspection.psf_samples import psf_at
from clresample.deblending.inspection.star_psfs import with_star_psfs
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


def star_psfs(*, size, half_px, fluxes, levels, fwhm=4.0, light=moffat, source=PointSource):
    """Measures the PSFs of a star with saturated pixels, in one channel or several.

    Returns `with_star_psfs` of it, and its place.
    """
    star = np.array([size // 2 + 0.3, size // 2 + 0.1])
    sides = (np.arange(size)[:, None] - star[0], np.arange(size) - star[1])
    data = np.array([flux * light(*sides, fwhm) for flux in fluxes])
    full = data > np.array(levels)[:, None, None]
    data += np.random.default_rng(1).normal(0, 1.0, data.shape)
    g = np.arange(-half_px, half_px + 1.0)
    psf = PSF(np.array([light(g[:, None], g, fwhm)] * len(fluxes)))
    grid, names = Grid.flat((size, size), 1.0), tuple("gri"[: len(fluxes)])
    observation = Observation(data, psf, grid, weights=np.where(full, 0.0, 1.0), channels=names)
    image = InspectedImage.of(observation, model_frame([observation]), star[None], np.zeros(2))
    return *with_star_psfs(image, [source(position_px=tuple(star))], star[None], False), star


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


def test_a_small_core_has_the_psf_within_its_image_and_a_halo_beyond():
    """Light of spikes beyond the image is not added to that of the PSF, which has them too."""
    given = {"size": 121, "half_px": 20, "fluxes": [4e6], "levels": [3e4], "light": with_spikes}
    image, _, n_own, star = star_psfs(**given)
    assert not n_own.any()
    own, psf = image.observation.psf_field.psf_at(*star), image.observation.psf
    along = np.arange(1.0, 28.0)  # a spike
    ratio = np.array([psf_at(own, 0, [d], [d])[0, 0] / with_spikes(d, d, 4.0) for d in along])
    within = along * np.sqrt(2) < 15  # a FWHM and more from the rim
    np.testing.assert_allclose(ratio[within], ratio[0], rtol=0.01)
    np.testing.assert_allclose(ratio[~within], ratio[0], rtol=0.12)
