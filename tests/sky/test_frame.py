"""The model frame: which pixels, how many, with what PSF, and which sources lie on it."""

import math

import numpy as np
import pytest
from helpers.headers import DEC, RA, SCALE, grid_of, header

from clresample.files.fits import read_image, read_psf
from clresample.sky.frame import Frame, model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

PSF_OUT = PSF.gaussian(1.5, n_pixels=17)


def observe(grid, name="A"):
    return Observation(np.zeros(grid.shape), PSF_OUT, grid, weights=1, name=name)


def on_pixels_of(frame, grid):
    """Origin (y, x) of the frame in whole pixels of a grid."""
    mapping = frame.grid.map_to(grid)
    np.testing.assert_array_equal(mapping.matrix, np.eye(2))
    np.testing.assert_array_equal(mapping.offset, np.rint(mapping.offset))
    return tuple(mapping.offset)


@pytest.mark.parametrize("order", [1, -1])
def test_the_finest_pixels_and_their_orientation_are_taken(order):
    fine = observe(Grid.flat((40, 50), 0.1, angle_deg=20), "fine")
    coarse = observe(Grid.flat((30, 30), 0.2, flip=True), "coarse")
    frame = model_frame([fine, coarse][::order])
    on_pixels_of(frame, fine.grid)
    for observation in (fine, coarse):
        assert observation.grid.map_to(frame.grid).covered.all()
    # 6 x 6 arcsec turned by 20 degrees reach 0.1 arcsec times:
    side = 60 * (math.cos(math.radians(20)) + math.sin(math.radians(20)))
    assert all(side <= n < side + 2 for n in frame.shape)


def test_of_equal_pixels_the_first_are_taken():
    one, other = Grid.flat((9, 9), 0.1), Grid.flat((9, 9), 0.1 * (1 - 1e-9), angle_deg=30)
    for first, second in ((one, other), (other, one)):
        frame = model_frame([observe(first, "A"), observe(second, "B")])
        on_pixels_of(frame, first)


NARROW = PSF.gaussian(0.6, n_pixels=17)
# the same between four pixels, where a width that counts pixels is twice as large
BETWEEN = PSF(
    np.exp(-0.5 * ((np.indices((18, 18)) - 8.5) ** 2).sum(axis=0) / (0.6**2 + 1 / 12)),
)


def placed(kind, center, angle=0.0):
    """A grid of 0.3 arcsec on a flat or on the curved sky; center (2,) [px]."""
    if kind == "flat":
        y, x = center
        return Grid.flat((20, 24), 0.3, angle_deg=angle, center_arcsec=(0.3 * y, 0.3 * x))
    y, x = center
    return grid_of(
        header((20, 24), scale=0.3 / 3600, CROTA2=angle, CRPIX1=12.5 - x, CRPIX2=10.5 - y), (20, 24)
    )


@pytest.mark.parametrize("kind", ["flat", "celestial"])
@pytest.mark.parametrize(
    "center, angle, psf, is_finer",
    [
        ((0.5, 0.0), 0.0, NARROW, True),
        ((0.0, 0.0), 40.0, NARROW, True),
        ((0.0, 0.0), 1.0, BETWEEN, True),
        ((1.0, -2.0), 0.0, NARROW, False),  # the same pixels
        ((0.0, 0.5), 0.0, PSF_OUT, False),
    ],
)
def test_dithered_images_of_a_narrow_psf_have_finer_model_pixels(
    kind, center, angle, psf, is_finer
):
    """Together they show more than the pixels of one."""
    first = Observation(np.zeros((20, 24)), psf, placed(kind, (0, 0)), weights=1, name="A")
    grid = placed(kind, center, angle)
    other = Observation(np.zeros(grid.shape), psf, grid, weights=1, name="B")
    frame = model_frame([first, other])
    scale = 0.15 if is_finer else 0.3
    assert frame.grid.pixel_scale_arcsec == pytest.approx(scale, rel=1e-6)
    for one in (first, other):
        assert one.grid.map_to(frame.grid).covered.all()
    mapping = first.grid.map_to(frame.grid)
    np.testing.assert_allclose(mapping.matrix, np.eye(2) * (2 if is_finer else 1), atol=1e-6)
    # their outer edges meet
    half = mapping.offset - 0.5 * is_finer
    np.testing.assert_allclose(half, np.rint(half), atol=1e-5)
    assert model_frame([first]).grid.pixel_scale_arcsec == pytest.approx(0.3, rel=1e-6)


def test_union_and_what_is_shared():
    one = observe(Grid.flat((10, 12), 0.1), "A")
    other = observe(Grid.flat((10, 12), 0.1, center_arcsec=(0.3, -0.5)), "B")
    union, shared = model_frame([one, other]), model_frame([one, other], shared=True)
    assert (union.shape, on_pixels_of(union, one.grid)) == ((13, 17), (0, -5))
    assert (shared.shape, on_pixels_of(shared, one.grid)) == ((7, 7), (3, 0))
    assert model_frame([one]).shape == one.grid.shape


def test_on_the_sky_the_frame_holds_every_pixel():
    fine = observe(grid_of(header((60, 60), scale=SCALE / 2, CROTA2=10.0), (60, 60)), "fine")
    coarse = observe(grid_of(header((40, 44), CROTA2=40.0), (40, 44)), "coarse")
    frame = model_frame([coarse, fine])
    assert frame.grid.pixel_scale_arcsec == pytest.approx(0.1, rel=1e-6)
    for observation in (fine, coarse):
        assert observation.grid.map_to(frame.grid).covered.all()


def test_a_given_grid_is_the_frame():
    grid = Grid.flat((21, 23), 0.05, angle_deg=45)
    assert model_frame([observe(Grid.flat((10, 10), 0.1))], grid=grid).grid is grid


@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.0])
def test_the_psf_is_a_gaussian_with_its_pixel(sigma):
    psf = model_frame([observe(Grid.flat((10, 10), 0.1))], psf_sigma_px=sigma).psf
    assert psf.n_bands == 1 and psf.spacing == 1
    n = psf.images.shape[1]
    assert n % 2 == 1 and psf.images[0, 0].max() < 1e-15  # nothing is cut
    y = np.arange(n) - n // 2
    variance = psf.images[0].sum(axis=1) @ y**2
    assert variance == pytest.approx(sigma**2 + 1 / 12, rel=1e-3)
    # where the samples do not alias: the Gaussian's transform times the pixel's
    nu = np.array([0.1])
    expected = np.exp(-2 * (np.pi * sigma * 0.1) ** 2) * np.sinc(0.1)
    aliased = np.exp(-2 * (np.pi * sigma * 0.9) ** 2)
    assert abs(psf.otf(nu, np.zeros(1))[0, 0, 0] - expected) <= 1.01 * aliased + 1e-14


def test_observations_that_do_not_meet_are_named():
    one, near = observe(Grid.flat((10, 10), 0.1), "A"), observe(Grid.flat((9, 9), 0.2), "B")
    far = observe(Grid.flat((10, 10), 0.1, center_arcsec=(0, 30)), "C")
    with pytest.raises(ValueError, match="'C' does not overlap 'A', 'B'"):
        model_frame([one, far, near])
    with pytest.raises(ValueError, match="'C' does not overlap the model frame.*10, 10.*9, 9"):
        model_frame([one, near, far], grid=near.grid)
    # two pairs, each overlapping, are not one patch
    also_far = observe(Grid.flat((10, 10), 0.1, center_arcsec=(0, 30.5)), "D")
    with pytest.raises(ValueError, match="'C' does not overlap"):
        model_frame([one, near, far, also_far])
    # a chain is, however little its ends share
    grids = [Grid.flat((10, 10), 0.1, center_arcsec=(0, x)) for x in (0, 1.6, 0.8)]
    chain = [observe(grid, f"{i}") for i, grid in enumerate(grids)]
    assert model_frame(chain).shape == (10, 26)
    with pytest.raises(ValueError, match="overlap"):
        model_frame(chain, shared=True)


def test_the_other_side_of_the_sky_is_named():
    here = observe(grid_of(header((10, 10)), (10, 10)), "here")
    there = observe(grid_of(header((10, 10), ra=RA + 180, dec=-DEC), (10, 10)), "there")
    for options in ({}, {"grid": here.grid}):
        with pytest.raises(ValueError, match="'there' does not overlap"):
            model_frame([here, there], **options)


def test_boxes_that_meet_only_at_a_corner_are_refused():
    # a square turned by 45 degrees leaves the corners of its bounding box empty
    turned = observe(Grid.flat((40, 40), 0.1, angle_deg=45), "turned")
    corner = observe(Grid.flat((8, 8), 0.09, center_arcsec=(2.5, 2.5)), "corner")
    with pytest.raises(ValueError, match="'turned' does not overlap the model frame"):
        model_frame([turned, corner], shared=True)


def test_what_is_no_frame():
    flat, placed = Grid.flat((10, 10), 0.1), grid_of(header((10, 10)), (10, 10))
    with pytest.raises(ValueError, match="grid is flat, observation 'A' placed by a WCS"):
        model_frame([observe(placed)], grid=flat)
    with pytest.raises(ValueError, match="grid is placed by a WCS, observation 'A' flat"):
        model_frame([observe(flat)], grid=placed)
    for sigma in (0, -1, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"psf_sigma_px .*not {sigma}"):
            model_frame([observe(flat)], psf_sigma_px=sigma)
    for sigma in (200.0, 1e300):
        with pytest.raises(ValueError, match=r"psf_sigma_px is .* px, must be at most the longer"):
            model_frame([observe(flat)], psf_sigma_px=sigma)
    with pytest.raises(ValueError, match="at least one"):
        model_frame([])


def test_sources_are_placed_by_sky_or_pixel():
    frame = model_frame([observe(grid_of(header((20, 31), CROTA2=30.0), (20, 31)))])
    sky = frame.grid.sky(3.25, 17.5)
    sources = [
        PointSource(sky_deg=tuple(sky)),
        ExtendedSource(position_px=(4, 5)),
        PointSource(sky_deg=(RA, DEC)),
    ]
    positions = frame.positions_of(sources)
    # a rotated pixel grid is placed by two WCS evaluations: rounding only
    np.testing.assert_allclose(positions, [(3.25, 17.5), (4, 5), (9.5, 15)], atol=1e-6)
    assert frame.positions_of([]).shape == (0, 2)
    behind = frame.positions_of([PointSource(sky_deg=(RA - 180, -DEC))])
    assert np.isnan(behind).all() and not frame.contains(behind)[0]


def test_inside_names_a_pixel():
    frame = Frame(Grid.flat((4, 6), 0.1), PSF_OUT)
    edge = [(-0.5, 0), (3.49, 5.49), (3.5, 0), (0, 5.5), (-0.51, 0), (0, np.inf), (2, 3)]
    inside = frame.contains(edge)
    np.testing.assert_array_equal(inside, [True, True, False, False, False, False, True])
    pixel = np.floor(np.array(edge)[inside] + 0.5)
    assert ((pixel >= 0) & (pixel < frame.shape)).all()
    assert frame.contains((1, 1)) and frame.contains(np.zeros((2, 3, 2))).shape == (2, 3)


def test_hst_and_hsc(data):
    folder = data / "hst_hsc"
    hst, hsc = read_image(folder / "hst_f814w.fits"), read_image(folder / "hsc_grizy.fits")
    psfs = (
        read_psf(folder / "psf_hst_f814w.fits", center="core"),
        read_psf(folder / "psf_hsc_grizy.fits", center="core"),
    )
    observations = [
        Observation(hsc.data, psfs[1], hsc.grid, channels=tuple("grizy"), name="HSC"),
        Observation(hst.data, psfs[0], hst.grid, channels="F814W", name="HST"),
    ]
    frame = model_frame(observations)
    on_pixels_of(frame, hst.grid)
    # 50 x 0.168 arcsec are 280 HST pixels; the two cutouts share a centre within a few
    assert all(280 <= n <= 284 for n in frame.shape)
    assert model_frame(observations, shared=True).shape == hst.grid.shape
    for o in observations:
        assert o.n_invalid == 0 and len(o.messages) == len(o.channels)
        background = o.data[np.abs(o.data) < 3 * o.weights**-0.5]
        assert 0.5 * o.data.size < background.size < o.data.size
