"""The operator against the sky: closed forms, flux, coverage, GalSim, HST as HSC sees it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, TYPES, affine, distance, distorted, operator, turn

from clresample.files import fits as io
from clresample.resampling import plan as spectrum
from clresample.resampling.resampler import Resampler
from clresample.simulation.galaxies import draw, open_catalogue, random_galaxy
from clresample.simulation.scenes import SMOOTHING_ARCSEC
from clresample.simulation.sdr import sdr
from clresample.simulation.surveys import NOTEBOOK_SURVEYS
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

ANGLES = [(0, False), (5, False), (30, False), (45, True), (90, True), (137, False), (200, True)]
every_angle = pytest.mark.parametrize(("angle", "flip"), ANGLES)


def gaussian_image(grid, sigma_arcsec, position_arcsec=(0.0, 0.0)):
    """A round Gaussian of flux 1 in the square pixels of a flat grid, by error functions."""
    scale = np.linalg.norm(grid.jacobian, axis=0)
    place = np.linalg.solve(grid.jacobian, np.array(position_arcsec) - grid.origin)
    axes = []
    for n, at, sigma in zip(grid.shape, place, sigma_arcsec / scale, strict=True):
        edges = np.arange(n + 1) - 0.5 - at
        axes.append(np.diff([math.erf(u / (math.sqrt(2) * sigma)) / 2 for u in edges]))
    return np.outer(*axes)


def round_galaxy(mapping, sigma_px=3.0):
    """A Gaussian in the middle of the model, in model pixels."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in mapping.shape_in)
    return np.exp(-0.5 * (y[:, None] ** 2 + x**2) / sigma_px**2)


@pytest.mark.parametrize("dtype", TYPES, ids=lambda t: t.__name__)
@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.67, 2.0, 3.0])
@every_angle
def test_gaussian_source_through_gaussian_psfs(device, angle, flip, ratio, dtype):
    """Source (s) under PSF 1 and pixel 1 becomes the source under PSF 2 and pixel 2, exactly."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip("no float64")
    pixel_in, pixel_out = 0.1, 0.1 * ratio  # arcsec, as all that follows
    source, sigma_in, sigma_out, place = 0.25, 0.16, 0.16 * max(ratio, 2), (0.23, -0.31)
    model, shape_out = Grid.flat((90, 95), pixel_in), (int(72 / ratio), int(70 / ratio))
    seen = Grid.flat(shape_out, pixel_out, angle_deg=angle, flip=flip, center_arcsec=(0.04, 0.05))
    psf_in = PSF.gaussian(sigma_in / pixel_in)
    psf_out = PSF.gaussian(sigma_out / pixel_out, n_pixels=101)
    op = Resampler(model, psf_in, seen, psf_out, dtype=dtype, device=device)
    found = op(gaussian_image(model, math.hypot(source, sigma_in), place)[None])[0]
    truth = gaussian_image(seen, math.hypot(source, sigma_out), place)
    # light that the coarser pixels fold over, at their Nyquist frequency, relative to the total
    folded = math.exp(-0.5 * (math.pi * math.hypot(source, sigma_out) / max(pixel_out, 0.1)) ** 2)
    tolerance = {np.float32: 5e-7, np.float64: 1e-12}[dtype] + 2 * folded
    assert distance(found, truth * op.covered) < tolerance
    assert abs(found.sum() - 1) < tolerance  # all of it lies on both


def check_flux(op, mapping):
    """A source inside both stamps keeps its flux."""
    image = round_galaxy(mapping)
    flux = op(image[None]).sum(dtype=float) / image.sum()
    assert abs(flux - 1) < 1e-6, f"flux {flux}"  # some roundings of float32


@pytest.mark.parametrize("matrix", [turn(0), turn(90, 1.3), turn(30), turn(60, 0.7, flip=True),
                                    np.array([[1.5, 0.8], [0.2, 1.1]])])  # fmt: skip
@pytest.mark.parametrize("build", [affine, distorted])
def test_flux_is_kept(device, build, matrix, monkeypatch):
    # sigma 3 model px and sigma 1.6 observed px: 7 sigma to every edge
    bend = {"bend": 2e-3} if build is distorted else {}
    mapping = build(matrix, (71, 74), tuple(int(56 / np.linalg.norm(c)) for c in matrix.T), **bend)
    psf_in, psf_out = PSF.gaussian(0.8), PSF.gaussian(1.6)
    op = operator(device, mapping, psf_in, psf_out)
    check_flux(op, mapping)
    monkeypatch.setattr(np.linalg, "det", lambda m: 1.0)  # flux per area instead of per pixel
    with pytest.raises(AssertionError, match="flux"):
        check_flux(operator(device, mapping, psf_in, psf_out), mapping)


@pytest.mark.parametrize(
    "geometry", ["aligned", "crossed", "30 degrees", "60 degrees", "distorted"]
)
def test_pixels_that_the_model_does_not_cover_are_zero_and_told(device, geometry):
    mapping = GEOMETRIES[geometry]()
    y, x = np.moveaxis(mapping.at(*np.indices(mapping.shape_out)), -1, 0)
    inside = (y >= -0.5) & (y <= 30.5) & (x >= -0.5) & (x <= 25.5)
    assert 0.5 < inside.mean() < 1
    psf_in, psf_out = PSF.gaussian(0.8), PSF.gaussian(1.5)
    op = operator(device, mapping, psf_in, psf_out)
    np.testing.assert_array_equal(op.covered, inside)
    bright = op(np.ones(mapping.shape_in))
    assert not bright[~inside].any()
    assert np.abs(bright[inside]).min() > 0.1  # up to the edge
    # and the adjoint does not hear what is said there
    images = np.where(inside, 0.0, 1e9)
    assert not op.adjoint(images).any()
    larger = replace(mapping, shape_in=(61, 61), offset=mapping.offset + 15)
    if mapping.positions is not None:
        larger = replace(larger, positions=mapping.positions + 15)
    wide = operator(device, larger, psf_in, psf_out)
    assert wide.covered.all()
    padded = np.zeros((61, 61))
    padded[15:46, 15:41] = 1
    assert np.abs(wide(padded)[~inside]).max() > 0.1  # where light would have fallen
    assert distance(wide(padded)[inside], bright[inside]) < 1e-3  # ringing of white edges


def check_wrap(device, angle):
    """A point at one edge under a PSF five times as wide as the stamp."""
    model, seen = Grid.flat((40, 36), 0.1), Grid.flat((20, 18), 0.2, angle_deg=angle)
    op = Resampler(model, PSF.gaussian(0.8), seen, PSF.gaussian(8.0, n_pixels=101), device=device)
    # a point of 0.1 arcsec under the model's PSF (0.08), 6 sigma from the edge
    place = np.array([-1.4, 0.0])
    found = op(gaussian_image(model, 0.1, place))
    truth = gaussian_image(seen, math.hypot(0.06, 1.6), place)
    error = np.abs(found - truth)[op.covered].max() / truth.max()
    assert error < 1e-6, f"wrapped light {error:.1e}"


@pytest.mark.parametrize("angle", [0, 30, 90, 120])
def test_no_light_wraps_under_a_psf_wider_than_the_stamps(device, angle, monkeypatch):
    check_wrap(device, angle)
    monkeypatch.setattr(spectrum, "wrap_radius", lambda psf, matrix: (4.0, 4.0))
    with pytest.raises(AssertionError, match="wrapped light"):
        check_wrap(device, angle)


@pytest.mark.parametrize("angle", [0, 35, 90])
def test_a_psf_with_its_core_elsewhere_is_the_same_psf(device, angle):
    mapping = affine(turn(angle, 1.4))
    image = round_galaxy(mapping)
    y, x = np.indices((40, 41), dtype=float)
    shifted = np.exp(-0.5 * ((y - 17.3) ** 2 + (x - 22.1) ** 2) / 1.7**2)
    psf_in, core = PSF.gaussian(0.8), np.array([17.3, 22.1])
    truth = operator(device, mapping, psf_in, PSF.gaussian(1.7, pixel=False))(image)
    found = operator(device, mapping, psf_in, PSF(shifted, center=core))(image)
    assert distance(found, truth) < 1e-6
    assert (
        distance(operator(device, mapping, psf_in, PSF(shifted, center="core"))(image), truth)
        < 1e-4
    )
    # with its centre stated half a sample off, it moves the image that far, the same way
    off = operator(device, mapping, psf_in, PSF(shifted, center=core - (0.2, 0)))
    off.shift = mapping.matrix @ (0.2, 0)
    assert distance(off(image), truth) < 1e-6
    off.shift = 0
    assert distance(off(image), truth) > 0.01


@pytest.fixture(scope="module")
def pair():
    """Euclid's model of 100 pixels and the angle's Rubin grid, with their PSFs' sigmas."""
    pytest.importorskip("galsim")
    return NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"]


def model_grid(pair):
    euclid, rubin = pair
    return euclid.grid(euclid.n_same_sky(50, rubin))


def drawn(galaxies, survey, grid):
    """GalSim's own drawing (n, Ny, Nx)."""
    sigma = survey.psf_sigma_arcsec[0]
    return np.array([draw(g, grid, psf_sigma_arcsec=sigma) for g in galaxies])


def rendered(pair, device, galaxies, images, angle, flip):
    """Euclid images of galaxies rendered as Rubin sees them, GalSim's own drawing, the operator."""
    euclid, rubin = pair
    seen = rubin.grid(50, angle_deg=angle, flip=flip)
    op = Resampler(model_grid(pair), euclid.psf(), seen, rubin.psf(), device=device)
    return op(images[:, None])[:, 0], drawn(galaxies, rubin, seen), op


@every_angle
def test_galsims_own_drawing(device, pair, angle, flip):
    rng = np.random.default_rng(1)
    galaxies = [random_galaxy(rng, smoothing_arcsec=SMOOTHING_ARCSEC) for _ in range(3)]
    images = drawn(galaxies, pair[0], model_grid(pair))
    found, truth, op = rendered(pair, device, galaxies, images, angle, flip)
    truth *= op.covered
    # GalSim draws to 1e-6 (60 dB), float32 renders to 3e-7 (65 dB): at worst their sum
    assert sdr(truth, found).min() > 59
    assert sdr(truth, found[:, ::-1]).mean() < 20  # upside down


# SDR [dB] of GalSim's sinc interpolation from 100 to 50 pixels, mean of these 60 galaxies; what is
# missing is the light that the model's stamp cuts off.  Of its default, quintic: 35.
SINC_SDR = {0: 52.6, 10: 50.9, 30: 49.6, 45: 49.2}


@pytest.fixture(scope="module")
def real_galaxies(pair, data):
    """These galaxies, and their Euclid images, which all angles of Rubin's pixels share."""
    catalogue = open_catalogue(data / "cosmos")
    rng = np.random.default_rng(2)
    galaxies = [
        random_galaxy(rng, catalogue=catalogue, i_galaxy=i, smoothing_arcsec=SMOOTHING_ARCSEC)
        for i in range(60)
    ]
    return galaxies, drawn(galaxies, pair[0], model_grid(pair))


@pytest.mark.parametrize("angle", SINC_SDR)
def test_real_galaxies_as_well_as_sinc_interpolation(device, pair, real_galaxies, angle):
    found, truth, _ = rendered(pair, device, *real_galaxies, angle, False)
    # random turns and flips of the galaxies move the mean by two tenths
    assert sdr(truth, found, unit_sum=True).mean() > SINC_SDR[angle] - 0.3


@pytest.mark.filterwarnings("ignore:PSF core off the centre")  # of HSC, a third of a sample
def test_hst_as_hsc_sees_it(device, data):
    from scipy.optimize import minimize

    folder = data / "hst_hsc"
    hst, hsc = (io.read_image(folder / f"{name}.fits") for name in ("hst_f814w", "hsc_grizy"))
    i_band = "grizy".index("i")
    psf_out = io.read_psf(folder / "psf_hsc_grizy.fits", bands=i_band)

    def correlation(op, shift):
        op.shift = shift
        images = op(hst.data)[0], hsc.data[i_band]
        return np.corrcoef(*(image[5:45, 5:45].ravel() for image in images))[0, 1]

    def build(center):
        psf_in = io.read_psf(folder / "psf_hst_f814w.fits", center=center)
        return Resampler(hst.grid, psf_in, hsc.grid, psf_out, device=device)

    op = build("core")
    assert op.covered[5:45, 5:45].all()
    assert correlation(op, 0) >= 0.99
    # the frames disagree by a pixel or two of HST's; a simplex of one finds the best shift
    start = [(0, 0), (1, 0), (0, 1)]
    best = minimize(
        lambda shift: -correlation(op, shift), (0, 0), method="Nelder-Mead",
        options={"initial_simplex": start, "xatol": 0.01, "fatol": 1e-6},
    )  # fmt: skip
    assert -best.fun >= 0.998
    assert np.abs(best.x).max() < 2
    assert correlation(op, np.negative(best.x)) < 0.995
    # the PSF's core lies a pixel off the array's centre, and ignoring it is seen
    with pytest.warns(UserWarning, match="off the centre"):
        assert correlation(build(None), 0) < 0.991
