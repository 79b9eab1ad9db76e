"""PSFs that vary: the few whose sums stand for many, cutouts, what observations make of them."""

import pickle

import numpy as np
import pytest

from clresample import PSF, FunctionPSF, Grid, Observation, PSFField
from clresample.sky.correlation import filtered_psf
from clresample.sky.varying_psf.basis import PSFBasis

PLACES = np.random.default_rng(0).uniform(0, 100, (12, 2))


def widening(y, x):
    """Two bands, each of which varies in another way."""
    return PSF.gaussian([1.6 + 0.004 * x, 1.5 + 0.003 * y + 0.002 * x], n_pixels=31)


FIELD = FunctionPSF(widening, 2)


class Moved(PSFField):
    """The same samples about a centre that moves, on stamps of several sizes."""

    n_bands = 1

    def psf_at(self, y, x):
        n = 31 + 2 * int(x > 50)
        y_axis, x_axis = np.indices((n, n))
        center = 15 + 0.3 * np.sin(y), 15.2 + 0.002 * x
        r2 = (y_axis - center[0]) ** 2 + (x_axis - center[1]) ** 2
        return PSF(np.exp(-0.5 * r2 / (2 + 0.002 * x) ** 2), center=center)


def sums(basis):
    """The PSFs (S, C, ny, nx) that a basis gives."""
    n_bands = basis.coefficients.shape[1]
    terms = basis.psf.images.reshape(n_bands, basis.n_terms, *basis.psf.images.shape[1:])
    return np.einsum("sct,ctyx->scyx", basis.coefficients, terms)


@pytest.mark.parametrize("tolerance", [0.03, 1e-3, 1e-5, 0.0])
def test_sums_are_the_psfs_to_the_tolerance(tolerance):
    basis = PSFBasis.of(FIELD, PLACES, tolerance)
    truth = np.array([FIELD.psf_at(*place).images for place in PLACES])
    norm = np.linalg.norm(truth, axis=(2, 3)).min()
    off = np.linalg.norm(sums(basis) - truth, axis=(2, 3)).max() / norm
    assert off <= max(1.2 * tolerance, 1e-12)
    np.testing.assert_allclose(off, basis.max_error.max(), rtol=0.3, atol=1e-12)
    np.testing.assert_allclose(basis.coefficients.sum(axis=2), 1, atol=1e-12)
    assert basis.psf.n_bands == 2 * basis.n_terms


def test_smoother_psfs_take_fewer_terms():
    counts = [PSFBasis.of(FIELD, PLACES, t).n_terms for t in (0.5, 0.03, 1e-3, 1e-5)]
    assert counts[0] == 1
    assert counts == sorted(counts)
    assert counts[2] <= 4
    assert PSFBasis.of(FIELD, PLACES[:1], 0.0).n_terms == 1
    assert PSFBasis.of(FIELD, PLACES[:5], 0.0).n_terms == 5
    same = PSFBasis.of(FunctionPSF(lambda y, x: widening(3, 4), 2), PLACES, 0.0)
    assert same.n_terms == 1
    assert same.max_variation.max() == 0


def test_psfs_of_several_centres_and_sizes_are_added_up_at_their_frequencies():
    nu, matrix = np.linspace(-0.5, 0.5, 15), np.array([[0.9, 0.2], [-0.2, 0.9]])
    basis = PSFBasis.of(Moved(), PLACES, 1e-4)
    assert 1 < basis.n_terms < len(PLACES)
    found = np.einsum("st,tyx->syx", basis.coefficients[:, 0], basis.psf.otf(nu, nu, matrix))
    truth = np.array([Moved().psf_at(*p).otf(nu, nu, matrix)[0] for p in PLACES])
    assert np.abs(found - truth).max() < 2e-4


def test_samples_of_several_distances_are_refused():
    field = FunctionPSF(lambda y, x: PSF.gaussian(2.0, spacing=1.0 if x < 50 else 0.5))
    with pytest.raises(ValueError, match=r"samples \[0.5, 1.0\] px apart"):
        PSFBasis.of(field, [(0, 10), (0, 90)], 0)


def test_an_observation_takes_the_psf_in_the_middle_for_all_else():
    data, grid = np.zeros((2, 40, 60)), Grid.flat((40, 60), 0.2)
    o = Observation(data, FIELD, grid, weights=1.0)
    np.testing.assert_array_equal(o.psf.images, widening(19.5, 29.5).images)
    assert o.psf_field is FIELD
    assert Observation(data, o.psf, grid, weights=1.0).psf_field is None
    again = pickle.loads(pickle.dumps(o))
    np.testing.assert_array_equal(again.psf_field.psf_at(3, 4).images, widening(3, 4).images)
    with pytest.raises(ValueError, match="psf has 2 bands, data have 3 channels"):
        Observation(np.zeros((3, 40, 60)), FIELD, grid, weights=1.0)
    with pytest.raises(ValueError, match="must be PSF or PSFField"):
        Observation(data, widening, grid, weights=1.0)


def test_one_band_serves_all_channels_and_cutouts_move():
    field = FunctionPSF(lambda y, x: widening(y, x)[0])
    o = Observation(np.zeros((2, 40, 60)), field, Grid.flat((40, 60), 0.2), weights=1.0)
    psf = o.psf_field.psf_at(5, 50)
    np.testing.assert_array_equal(psf.images, widening(5, 50)[[0, 0]].images)
    cut = FIELD.cutout(10, 20)
    np.testing.assert_array_equal(cut.psf_at(3, 4).images, widening(13, 24).images)
    assert cut.varies
    assert cut.n_bands == 2


def test_white_noise_is_made_with_the_psf_of_each_place():
    kernel = np.outer([0.2, 1, 0.2], [0.2, 1, 0.2])
    grid = Grid.flat((40, 60), 0.2)
    o = Observation(np.zeros((2, 40, 60)), FIELD, grid, weights=1.0, noise=kernel)
    wanted, _ = filtered_psf(widening(7, 50), [n.filter for n in o.noise])
    np.testing.assert_allclose(o.whitened.psf_field.psf_at(7, 50).images, wanted.images)
