"""Frames in tiles: the answer of one tile, within the memory allowed, forward and back."""

import numpy as np
import pytest
from astropy.wcs import WCS

from clresample.device.device import Device, get_device
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.resampler import TiledResampler
from clresample.simulation.surveys import NOTEBOOK_SURVEYS
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint

SMALL = 3 << 20  # [bytes] forces several tiles on the frames below


def pair(name_in, name_out, n_in=300, **place):
    """Grid and PSF of two surveys over the same sky, the observed frame a little larger."""
    one, two = NOTEBOOK_SURVEYS[name_in], NOTEBOOK_SURVEYS[name_out]
    n_out = int(1.1 * n_in * one.pixel_scale_arcsec / two.pixel_scale_arcsec)
    return one.grid(n_in), one.psf(), two.grid(n_out, **place), two.psf()


def field(grid, psf, rng, n_bands=1):
    """Point sources under the PSF's core: what a telescope can deliver, dark at the edges."""
    y, x = np.indices(grid.shape)
    n_y, n_x = grid.shape
    sigma = np.sqrt(1 / (2 * np.pi * psf.images.max()))  # [px] of a Gaussian as peaked
    image = np.zeros((n_bands, n_y, n_x))
    for i in range(n_bands):
        for cy, cx, flux in rng.uniform((40, 40, 1), (n_y - 40, n_x - 40, 9), (30, 3)):
            image[i] += flux * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * sigma**2))
    return image


def distance(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


@pytest.mark.parametrize(
    "names, place, tolerance",
    [
        # the padding of the single tile itself moves its answer by 2e-6 from Euclid to Rubin, whose
        # PSF samples alias, by less than 1e-6 elsewhere
        (("EUCLID", "RUBIN"), {}, 5e-6),
        (("EUCLID", "RUBIN"), {"angle_deg": 30}, 5e-6),
        (("EUCLID", "RUBIN"), {"angle_deg": 90, "flip": True}, 5e-6),
        (("HST", "HSC"), {"angle_deg": -137, "flip": True}, 2e-6),
        (("EUCLID", "EUCLID"), {"angle_deg": 45}, 2e-6),
    ],
)
def test_tiles_give_the_answer_of_one_tile(names, place, tolerance):
    setting = pair(*names, **place)
    one = Resampler(*setting, dtype=np.float64, shift=(0.3, -1.7))
    tiled = TiledResampler(*setting, dtype=np.float64, shift=(0.3, -1.7), memory=2 * SMALL)
    x = field(*setting[:2], np.random.default_rng(1))
    assert tiled.n_tiles > 3 and len(tiled.groups) == 1
    assert tiled.geometry == one.geometry
    np.testing.assert_array_equal(tiled.covered, one.covered)
    result = tiled(x)
    assert distance(result, one(x)) < tolerance
    assert not result[:, ~one.covered].any()


def test_float32_tiles_are_float32_exact():
    setting = pair("HST", "HSC")
    x = field(*setting[:2], np.random.default_rng(1))
    one = Resampler(*setting, dtype=np.float64)(x)
    result = TiledResampler(*setting, memory=SMALL)(x)
    assert result.dtype == np.float32
    assert distance(result, one) < 2e-6


def test_noise_up_to_the_edge_stays_close_from_fine_to_coarse_pixels():
    """White noise has light at every frequency: the tails of the kernel's sharp band count."""
    setting = pair("HST", "HSC")
    x = np.random.default_rng(2).normal(size=(1, *setting[0].shape))
    one = Resampler(*setting, dtype=np.float64)
    assert distance(TiledResampler(*setting, dtype=np.float64, memory=SMALL)(x), one(x)) < 2e-6


@pytest.mark.parametrize("place", [{}, {"angle_deg": 20}])
def test_adjoint_is_the_transpose(place):
    setting = pair("EUCLID", "RUBIN", 150, **place)
    tiled = TiledResampler(*setting, memory=SMALL // 3)
    assert tiled.n_tiles > 1
    rng = np.random.default_rng(3)
    check_adjoint(tiled, rng)
    y = rng.normal(size=tiled.shape_out).astype(np.float32)
    np.testing.assert_array_equal(tiled.T(y), tiled.adjoint(y))
    np.testing.assert_array_equal(tiled.as_scipy().rmatvec(y.ravel()), tiled.adjoint(y).ravel())


def test_bands_and_batches():
    grid_in, _, grid_out, _ = pair("EUCLID", "RUBIN", 150, angle_deg=10)
    psf_in, psf_out = PSF.gaussian(1.6, n_pixels=25), PSF.gaussian([1.4, 1.7], n_pixels=25)
    x = field(grid_in, psf_in, np.random.default_rng(4), 4).reshape(2, 2, *grid_in.shape)
    one = Resampler(grid_in, psf_in, grid_out, psf_out)
    tiled = TiledResampler(grid_in, psf_in, grid_out, psf_out, memory=SMALL)
    assert distance(tiled(x), one(x)) < 1e-5
    np.testing.assert_array_equal(tiled(x)[1], tiled(x[1]))
    out = np.full((*one.shape_out,), np.nan, np.float32)
    assert tiled.forward(x[0], out) is out
    np.testing.assert_array_equal(out, tiled(x[0]))


def test_same_pixels_and_psf_return_the_input_bit_for_bit():
    grid, psf, *_ = pair("HST", "HSC", 200)
    x = np.random.default_rng(5).normal(size=grid.shape).astype(np.float32)
    np.testing.assert_array_equal(TiledResampler(grid, psf, grid, psf, memory=SMALL)(x), x)
    cut = TiledResampler(grid, psf, grid.cutout(-5, 20, (60, 70)), psf)
    expected = np.zeros((60, 70), np.float32)
    expected[5:] = x[:55, 20:90]
    np.testing.assert_array_equal(cut(x), expected)
    cut.shift = (2, 0)
    expected[3:] = x[:57, 20:90]
    expected[~cut.covered] = 0
    np.testing.assert_array_equal(cut(x), expected)
    cut.shift = (2, 0.25)
    assert distance(cut(x), expected) > 0.1


@pytest.mark.parametrize("angle_deg", [0, 30])
def test_memory_is_never_exceeded(angle_deg, monkeypatch):
    setting = pair("EUCLID", "RUBIN", angle_deg=angle_deg)
    in_use, allocate = [], Device._allocate

    def watched(self, n_bytes):
        buffer = allocate(self, n_bytes)
        in_use.append(self.in_use)
        return buffer

    monkeypatch.setattr(Device, "_allocate", watched)
    x = field(*setting[:2], np.random.default_rng(6))
    sides = []
    for memory in (2 << 20, 4 << 20, 16 << 20):
        before = get_device().in_use
        tiled = TiledResampler(*setting, memory=memory)
        tiled.adjoint(tiled(x))
        assert max(in_use) - before <= memory
        sides.append(max(tiled.tile_shape))
        del tiled
        in_use.clear()
    assert sides == sorted(sides) and sides[0] < sides[-1]


def tan(scale_arcsec, shape, *, ra_deg=150.0, angle_deg=0.0, sip=0.0):
    """A gnomonic WCS in the middle of `shape`, with a quadratic distortion of `sip` [1/px]."""
    wcs = WCS(naxis=2)
    suffix = "-SIP" if sip else ""
    wcs.wcs.ctype = ["RA---TAN" + suffix, "DEC--TAN" + suffix]
    wcs.wcs.crval = [ra_deg, 2.0]
    wcs.wcs.crpix = [(shape[1] + 1) / 2, (shape[0] + 1) / 2]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    wcs.wcs.cd = np.array([[-c, s], [s, c]]) * scale_arcsec / 3600
    if sip:
        header = wcs.to_header()
        header.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": sip, "B_1_1": -sip})
        wcs = WCS(header)
    return Grid.from_wcs(wcs, shape)


def test_slight_distortion_is_affine_tile_by_tile():
    one, two = NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"]
    grid_in = tan(one.pixel_scale_arcsec, (300, 290))
    grid_out = tan(two.pixel_scale_arcsec, (150, 160), angle_deg=3, sip=5e-8)
    setting = grid_in, one.psf(), grid_out, two.psf()
    x = field(*setting[:2], np.random.default_rng(7))
    tiled = TiledResampler(*setting, dtype=np.float64, memory=SMALL // 2)
    exact = Resampler(*setting, dtype=np.float64, tolerance_px=1e-8)
    assert (tiled.geometry, exact.geometry) == ("affine", "distorted")
    assert len(tiled.groups) < tiled.n_tiles  # neighbours share an operator
    np.testing.assert_array_equal(tiled.covered, exact.covered)
    # tolerance_px is 1e-4 px, and the images change by their own size over 1.6 px
    assert distance(tiled(x), exact(x)) < 3e-5


def test_strong_distortion_is_followed_pixel_by_pixel():
    """Each tile takes the PSF at its own scale and angle, as the operator of a cutout does."""
    one, two = NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"]
    grid_in = tan(one.pixel_scale_arcsec, (300, 290))
    grid_out = tan(two.pixel_scale_arcsec, (150, 160), angle_deg=3, sip=3e-5)
    x = field(grid_in, one.psf(), np.random.default_rng(7))
    tiled = TiledResampler(
        grid_in, one.psf(), grid_out, two.psf(), dtype=np.float64, memory=2 * SMALL
    )
    assert tiled.geometry == "distorted" and tiled.n_tiles > 3
    result = tiled(x)
    for group in tiled.groups[:3]:
        (y0, x0), shape = group.tiles[0].origin, tiled.tile_shape
        cutout = grid_out.cutout(y0, x0, shape)
        part = Resampler(grid_in, one.psf(), cutout, two.psf(), dtype=np.float64)
        np.testing.assert_array_equal(
            tiled.covered[y0 : y0 + shape[0], x0 : x0 + shape[1]], part.covered
        )
        error = result[:, y0 : y0 + shape[0], x0 : x0 + shape[1]] - part(x)
        error = error[:, group.tiles[0].mask]
        assert np.linalg.norm(error) < 5e-6 * np.linalg.norm(result)


def test_only_what_overlaps_is_computed():
    one, two = NOTEBOOK_SURVEYS["EUCLID"], NOTEBOOK_SURVEYS["RUBIN"]
    grid_in = tan(one.pixel_scale_arcsec, (90, 80))
    grid_out = tan(two.pixel_scale_arcsec, (20000, 30000), angle_deg=25)
    near = grid_out.cutout(9900, 14900, (200, 200))
    tiled = TiledResampler(grid_in, one.psf(), grid_out, two.psf())
    assert tiled.n_tiles < 5
    x = field(grid_in, one.psf(), np.random.default_rng(8)).astype(np.float32)
    result = TiledResampler(grid_in, one.psf(), near, two.psf())(x)
    assert distance(result, Resampler(grid_in, one.psf(), near, two.psf())(x)) < 1e-5


def test_errors_say_what_is_wrong():
    setting = pair("EUCLID", "RUBIN", 100)
    with pytest.raises(ValueError, match="memory is 1000 bytes, .* need"):
        TiledResampler(*setting, memory=1000)
    far = Grid.flat((50, 50), 0.2, center_arcsec=(100, 0))
    with pytest.raises(ValueError, match="do not overlap"):
        TiledResampler(setting[0], setting[1], far, setting[3])
    corner = Grid.flat((50, 50), 0.2, center_arcsec=(9.8, 9.8), angle_deg=45)
    with pytest.raises(ValueError, match="do not overlap"):
        TiledResampler(setting[0], setting[1], corner, setting[3])
    with pytest.raises(ValueError, match="2 bands"):
        TiledResampler(setting[0], PSF.gaussian([1, 2]), setting[2], PSF.gaussian([1, 2, 3]))
    tiled = TiledResampler(*setting)
    with pytest.raises(ValueError, match=r"x has shape \(3, 100, 100\), expected \(1, 100, 100\)"):
        tiled(np.zeros((3, 100, 100)))
    with pytest.raises(ValueError, match="out has shape"):
        tiled.forward(np.zeros((100, 100)), np.zeros((5, 5)))
    with pytest.raises(ValueError, match="x is on the device"):
        tiled(tiled.device.zeros((1, 100, 100), np.float32))


def test_progress_bar_is_for_terminals(capsys, monkeypatch):
    setting = pair("EUCLID", "RUBIN", 100)
    x = np.zeros((100, 100))
    TiledResampler(*setting)(x)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    TiledResampler(*setting)(x)
    assert "tile" in capsys.readouterr().err
    TiledResampler(*setting, progress=False)(x)
    assert capsys.readouterr().err == ""
