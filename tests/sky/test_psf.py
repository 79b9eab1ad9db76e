"""The PSF's OTF against its definition and analytic transforms, its width, and its warnings."""

import math
import warnings

import numpy as np
import pytest

from clresample.sky.fourier import cos_sin_columns, phases, uniform_waves
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning, limit_power

NU_Y, NU_X = np.arange(-16, 17) / 33, np.arange(0, 20) / 39


def quiet(*args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        return PSF(*args, **kwargs)


def term_by_term(psf, nu_y, nu_x, matrix):
    """The definition, one frequency and one sample after the other."""
    result = np.zeros((psf.n_bands, len(nu_y), len(nu_x)), dtype=complex)
    for c, (image, center) in enumerate(zip(psf.images, psf.center, strict=True)):
        y, x = (
            (np.arange(n) - at) * psf.spacing for n, at in zip(image.shape, center, strict=True)
        )
        for i, j in np.ndindex(len(nu_y), len(nu_x)):
            f_y, f_x = matrix.T @ (nu_y[i], nu_x[j])
            if max(abs(f_y), abs(f_x)) <= 0.5 / psf.spacing:
                phase = f_y * y[:, None] + f_x * x
                result[c, i, j] = np.sum(image * np.exp(-2j * np.pi * phase))
    return result


def matrices():
    rng = np.random.default_rng(11)
    yield "diagonal", np.diag([0.7, -1.3])
    yield "anti-diagonal", np.array([[0, 1.2], [-0.6, 0]])
    yield "rotated", 2.0 * np.array([[0.8, 0.6], [-0.6, 0.8]])
    yield "shear", np.array([[1.0, 0.0], [0.3, 1.0]])
    yield "random", rng.normal(size=(2, 2))


@pytest.mark.parametrize("spacing", [1.0, 0.5, 0.4])
@pytest.mark.parametrize("shape", [(9, 9), (8, 13), (1, 1), (12, 6)], ids=str)
@pytest.mark.parametrize("matrix", [pytest.param(m, id=name) for name, m in matrices()])
def test_the_otf_is_its_definition(matrix, shape, spacing):
    rng = np.random.default_rng(5)
    images = rng.random((3, *shape))
    psf = quiet(images, spacing=spacing, center=[(1.0, 2.0), (1.0, 2.0), (3.3, -0.4)])
    found = psf.otf(NU_Y, NU_X, matrix)
    assert found.dtype == np.complex128
    # sums of a few hundred terms that add up to 1 in float64
    np.testing.assert_allclose(found, term_by_term(psf, NU_Y, NU_X, matrix), atol=1e-13)
    assert np.abs(found).max() > 0.1


def test_many_samples_go_in_blocks(monkeypatch):
    rng = np.random.default_rng(6)
    psf = quiet(rng.random((2, 21, 10)))
    matrix = rng.normal(size=(2, 2))
    whole = psf.otf(NU_Y, NU_X, matrix)
    monkeypatch.setattr("clresample.sky.psf.BLOCK", 1600)  # three rows of ten samples at a time
    np.testing.assert_allclose(psf.otf(NU_Y, NU_X, matrix), whole, atol=1e-15)


def test_no_matrix_is_the_identity():
    psf = PSF.gaussian(1.2)
    np.testing.assert_array_equal(psf.otf(NU_Y, NU_X), psf.otf(NU_Y, NU_X, np.eye(2)))
    assert abs(psf.otf([0.0], [0.0])[0, 0, 0] - 1) < 1e-15


@pytest.mark.parametrize("spacing", [1.0, 0.5])
def test_band_ends_where_the_samples_do(spacing):
    psf = quiet(np.ones((1, 3, 3)), spacing=spacing)
    limit = 0.5 / spacing
    nu = np.array([-1.01, -1, 0, 1, 1.01]) * limit
    carried = psf.otf(nu, nu)[0] != 0
    np.testing.assert_array_equal(carried, np.outer(abs(nu) <= limit, abs(nu) <= limit))
    matrix = np.array([[0.0, 2.0], [1.0, 0.0]])  # f = (nu_x, 2 nu_y)
    carried = psf.otf(nu / 2, nu, matrix)[0] != 0
    np.testing.assert_array_equal(carried, np.outer(abs(nu) <= limit, abs(nu) <= limit))


@pytest.mark.parametrize("n_pixels", [61, 60, (60, 61)])
@pytest.mark.parametrize("angle", [0, 30, 90])
def test_gaussian_is_the_analytic_one(angle, n_pixels):
    sigma = 2.1  # 2 pi sigma nu_max >> 1: aliases are below float64
    cos, sin = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    matrix = 1.4 * np.array([[cos, sin], [-sin, cos]])
    nu = np.linspace(-0.2, 0.2, 15)
    f_y = matrix[0, 0] * nu[:, None] + matrix[1, 0] * nu
    f_x = matrix[0, 1] * nu[:, None] + matrix[1, 1] * nu
    round_one = np.exp(-2 * (np.pi * sigma) ** 2 * (f_y**2 + f_x**2))
    for pixel, truth in ((False, round_one), (True, round_one * np.sinc(f_y) * np.sinc(f_x))):
        psf = PSF.gaussian(sigma, n_pixels=n_pixels, pixel=pixel)
        np.testing.assert_allclose(psf.otf(nu, nu, matrix)[0], truth, atol=1e-13)


def test_oversampled_gaussian_is_the_same_gaussian():
    fine = PSF.gaussian(2.1, n_pixels=243, spacing=0.25)
    nu = np.linspace(-0.3, 0.3, 9)
    truth = PSF.gaussian(2.1, n_pixels=61).otf(nu, nu)
    np.testing.assert_allclose(fine.otf(nu, nu), truth, atol=1e-13)


def test_a_centre_is_a_phase():
    rng = np.random.default_rng(8)
    image, matrix = rng.random((7, 8)), rng.normal(size=(2, 2))
    here, there = quiet(image, spacing=0.5), quiet(image, spacing=0.5, center=(2.25, 5.0))
    shift = 0.5 * (there.center[0] - here.center[0])
    f = np.tensordot(matrix.T, np.stack(np.meshgrid(NU_Y, NU_X, indexing="ij")), 1)
    phase = np.exp(2j * np.pi * np.tensordot(shift, f, 1))
    found = there.otf(NU_Y, NU_X, matrix)[0]
    np.testing.assert_allclose(found, phase * here.otf(NU_Y, NU_X, matrix)[0], atol=1e-14)


def test_each_band_is_normalised_by_itself():
    rng = np.random.default_rng(9)
    images = rng.random((4, 6, 5)) * np.array([1, 10, 1e-3, 1e6])[:, None, None]
    before = images.copy()
    psf = quiet(images)
    np.testing.assert_allclose(psf.images.sum(axis=(1, 2)), 1, rtol=1e-14)
    np.testing.assert_array_equal(images, before)
    np.testing.assert_array_equal(psf.center, np.full((4, 2), (2.5, 2.0)))
    with pytest.raises(ValueError):
        psf.images[0, 0, 0] = 1


def test_select_bands():
    psf = PSF.gaussian([1.0, 1.5, 2.0])
    for bands, chosen in ((1, [1]), ([2, 0], [2, 0]), (slice(1, None), [1, 2])):
        np.testing.assert_array_equal(psf[bands].images, psf.images[chosen])
        assert psf.select(bands).n_bands == len(chosen)
    with pytest.raises(ValueError, match="has 3"):
        psf.select(3)


def test_restore_keeps_every_bit():
    rng = np.random.default_rng(10)
    first = quiet(rng.random((2, 7, 9)) * 1e3, spacing=0.3, center=(1.1, 2 + 1e-9))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a core so far off its centre was warned of before
        again = PSF.restore(first.images, spacing=first.spacing, center=first.center.tolist())
    np.testing.assert_array_equal(again.images, first.images)
    np.testing.assert_array_equal(again.center, first.center)
    assert again.spacing == first.spacing and again.images is not first.images
    with pytest.raises(ValueError, match="read-only"):
        again.center[0, 0] = 1


@pytest.mark.parametrize("spacing", [1.0, 0.25])
def test_fwhm_of_gaussians(spacing):
    sigmas = np.array([1.5, 3.0, 6.0])
    psf = PSF.gaussian(sigmas, n_pixels=int(60 / spacing) + 1, spacing=spacing)
    # the pixel adds 1/12 to the variance; samples are counted, to one or two along the edge
    truth = 2 * np.sqrt(2 * math.log(2) * (sigmas**2 + 1 / 12))
    np.testing.assert_allclose(psf.fwhm_px, truth, atol=0.3 * spacing)
    assert psf.fwhm_px.shape == (3,)
    one = quiet([[1.0]])
    assert one.fwhm_px[0] == pytest.approx(2 / math.sqrt(math.pi))


def test_whole_cycles_are_taken_off_before_they_are_rounded():
    nu, x = np.array([0.25, 1 / 3]), np.array([4e6 + 1, 3e6])
    angle = phases(nu, x)
    assert angle.shape == (2, 2)
    np.testing.assert_allclose(
        np.abs(angle), np.abs([[np.pi / 2, 0], [2 * np.pi / 3, 0]]), atol=2e-9
    )
    assert np.abs(np.cos(2 * np.pi * nu[0] * x[0])) > 1e-10 > np.abs(np.cos(angle[0, 0]))
    columns = cos_sin_columns(angle)
    assert columns.shape == (2, 4)
    np.testing.assert_array_equal(columns[:, ::2], np.cos(angle))
    np.testing.assert_array_equal(columns[:, 1::2], np.sin(angle))


@pytest.mark.parametrize("n", [0, 1, 2, 10, 117, 1000])
def test_waves_at_equal_distances_are_the_waves(n):
    """To the rounding of their phases, of up to 340 cycles here."""
    nu, first, step = np.array([0.0, 1e-3, 0.37, -0.5]), -58.25, 0.73
    waves = uniform_waves(nu, first, step, n)
    truth = np.exp(1j * phases(first + step * np.arange(n), nu))
    assert waves.shape == truth.shape and waves.flags.c_contiguous
    np.testing.assert_allclose(waves, truth, atol=1e-12, rtol=0)


def test_integer_and_foreign_endian_images():
    image = np.outer([1, 2, 1], [1, 2, 1])
    for dtype in (np.int16, ">f4", ">f8", np.uint8):
        np.testing.assert_allclose(quiet(image.astype(dtype)).images[0], image / 16)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.31, -0.44), (1.5, -2.2)], ids=str)
@pytest.mark.parametrize("sigma", [1.0, 1.7, 3.0])
def test_core_is_found_to_a_hundredth(sigma, shift):
    y, x = ((np.arange(n) - (n - 1) / 2 - s) for n, s in zip((31, 30), shift, strict=True))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) / sigma**2)
    image += 0.05 * np.exp(-0.5 * ((y[:, None] - 9) ** 2 + x**2))  # a neighbour is not the core
    core = quiet(image).core()[0]
    np.testing.assert_allclose(core, np.array([15, 14.5]) + shift, atol=0.01)
    psf = quiet(image, center="core")
    np.testing.assert_array_equal(psf.center[0], core)


def test_a_core_off_the_centre_is_warned_of_once_with_figures():
    y = np.arange(20) - 10.0  # the core at n/2: the usual slip
    image = np.exp(-0.5 * (y[:, None] ** 2 + y**2) / 2)
    with pytest.warns(PSFWarning) as warned:
        PSF(np.stack([image, image]))
    assert len(warned) == 1
    for figure in ("bands 0, 1", "(10.00, 10.00)", "(+0.50, +0.50)", "(9.5, 9.5)"):
        assert figure in str(warned[0].message)
    assert PSF(image, center=(10, 10)).warnings() == []
    assert PSF(image, center="core").warnings() == []


def test_samples_that_are_too_coarse_are_warned_of():
    for sigma in (0.4, 0.3):
        with pytest.warns(PSFWarning, match="sampled too coarsely, band 0: .*`spacing`"):
            PSF.gaussian(sigma)
    assert PSF.gaussian(0.4, spacing=0.25, n_pixels=81).warnings() == []
    assert PSF.gaussian(0.8).warnings() == []
    images = PSF.gaussian(0.8).images
    nyquist = np.exp(-2 * (np.pi * 0.8 / 2) ** 2) * np.sinc(0.5)
    np.testing.assert_allclose(limit_power(images), nyquist, rtol=1e-3)


def test_light_cut_at_the_edge_is_warned_of():
    with pytest.warns(PSFWarning, match=r"cut at the edge of the 41 x 41 image, band 1"):
        PSF.gaussian([2.0, 10.0])
    with pytest.warns(PSFWarning, match="PSF negative at the edge of .* too much background"):
        PSF(PSF.gaussian(2.0).images - 1e-4)  # a background taken off twice


def test_edge_light_is_right_for_its_wing():
    n = 201
    y = np.arange(n) - (n - 1) / 2
    wing = (y[:, None] ** 2 + y**2 + 25) ** -1.5  # falls as r^-3: 2 pi / r of it lies beyond r
    inside = wing.sum()
    beyond = 2 * np.pi / ((n / 2) * 2 / np.sqrt(np.pi))  # the circle of the square's area
    found = quiet(wing).edge_light()[0]
    assert found == pytest.approx(beyond / inside, rel=0.3)  # a square ring is no circle


@pytest.mark.parametrize(
    ("images", "match"),
    [
        (np.zeros((3, 3)), "sum"),
        (-np.ones((3, 3)), "sum"),
        (np.array([[1.0, -1.0], [1.0, -1.0]]), "sum"),
        (np.array([[1.0, np.nan], [np.inf, 1.0]]), "2 NaN or infinite"),
        (np.ones(3), "images must be"),
        (np.ones((1, 2, 3, 3)), "images must be"),
        (np.ones((2, 0, 3)), "images must be"),
    ],
)
def test_what_is_no_psf(images, match):
    with pytest.raises(ValueError, match=match):
        PSF(images)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"spacing": 0}, "spacing"),
        ({"spacing": np.nan}, "spacing"),
        ({"center": "peak"}, "center"),
        ({"center": (1, 2, 3)}, "center"),
        ({"center": (np.nan, 2)}, "center"),
        ({"center": np.zeros((3, 2))}, "center"),
    ],
)
def test_what_is_no_spacing_or_centre(kwargs, match):
    with pytest.raises(ValueError, match=match):
        PSF(np.ones((2, 3, 3)), **kwargs)


def test_what_is_no_gaussian():
    for sigma in (0, -1, np.nan, [1.0, 0.0]):
        with pytest.raises(ValueError, match="sigma_px"):
            PSF.gaussian(sigma)
    with pytest.raises(ValueError, match="2 bands"):
        PSF.gaussian([1.0, 2.0], n_bands=3)
    with pytest.raises(ValueError, match="matrix"):
        PSF.gaussian(1.0).otf(NU_Y, NU_X, np.eye(3))


@pytest.mark.parametrize("center", [(1e300, 1e300), (2.0, -1e4), [(2, 2), (1e4, 2)]])
def test_centres_far_from_the_samples_are_refused(center):
    quiet(np.ones((2, 5, 5)), center=(900.0, -900.0))
    with pytest.raises(ValueError, match=r"center is .*, over 1000 samples from their middle"):
        PSF(np.ones((2, 5, 5)), center=center)
