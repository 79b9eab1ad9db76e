"""Mosaics: only what is asked for is read, and an observation of it is the same as of the array."""

import numpy as np
import pytest
from astropy.io import fits

from clresample import PSF, FunctionPSF, Grid, NoiseWarning, Observation
from clresample.fields.background import Background
from clresample.fields.mosaic import ArrayPlane, Channel, ConstantPlane, FilePlane, Mosaic
from clresample.files.atomic import FileError
from clresample.sky.box import Box, round_up_size

SHAPE = (60, 90)


@pytest.fixture
def image():
    return np.random.default_rng(1).normal(10, 1, SHAPE).astype(np.float32)


def grid(angle_deg=0.0, scale=0.1, shape=SHAPE):
    flat = Grid.flat(shape, scale, angle_deg=angle_deg)
    return Grid.from_wcs(flat.to_wcs(ra_deg=10.0, dec_deg=-30.0), shape)


def channel(data, **given):
    return Channel("a", ArrayPlane(data), given.pop("weight", ConstantPlane(1.0)), **given)


def test_plain_and_compressed_files_and_planes_of_cubes_read_as_the_array(tmp_path, image):
    plain, packed = tmp_path / "plain.fits", tmp_path / "packed.fits"
    fits.PrimaryHDU(np.stack([image, 2 * image])).writeto(plain)
    lossless = {"compression_type": "GZIP_2", "quantize_level": 0}
    hdu = fits.CompImageHDU(image, **lossless)
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(packed)
    box = Box(7, 11, 40, 73)
    for plane, expected in (
        (FilePlane(plain, 0, 0), image),
        (FilePlane(plain, 0, 1), 2 * image),
        (FilePlane(packed, 1), image),
    ):
        found = plane.read(box)
        np.testing.assert_array_equal(found, expected[box.slices])
        assert found.dtype.isnative


def test_a_cut_off_file_is_one_line_that_names_it(tmp_path, image):
    path = tmp_path / "short.fits"
    fits.PrimaryHDU(image).writeto(path)
    path.write_bytes(path.read_bytes()[: 2880 + 4 * 20 * SHAPE[1]])
    FilePlane(path, 0).read(Box(0, 0, 10, 10))  # what is there is read
    with pytest.raises(FileError, match=r"short.fits: HDU 0 .*"):
        FilePlane(path, 0).read(Box(30, 0, 50, 10))


def test_the_psf_of_a_cutout_varies_as_the_mosaic_s_does():
    def widening(y, x):
        return PSF.gaussian(1.5 + 0.01 * x + 0.003 * y)

    data, grid = np.zeros((1, 60, 80)), Grid.flat((60, 80), 0.2)
    mosaic = Mosaic.of_arrays("r", data, FunctionPSF(widening), grid, weights=1.0)
    box = Box(10, 20, 41, 71)
    o = mosaic.observation(box)
    np.testing.assert_array_equal(o.psf.images, widening(25, 45).images)
    np.testing.assert_array_equal(o.psf_field.psf_at(3, 4).images, widening(13, 24).images)
    fixed = mosaic.observation(box, psf_box=Box.of(grid.shape))
    np.testing.assert_array_equal(fixed.psf.images, widening(29.5, 39.5).images)
    assert fixed.psf_field is None
    same = Mosaic.of_arrays("r", data, widening(0, 0), grid, weights=1.0)
    assert same.observation(box).psf_field is None


def test_weights_come_from_weights_variances_and_rms_and_bits_of_the_mask(image):
    sigma = np.full(SHAPE, 2.0)
    sigma[3, 4], sigma[3, 5], sigma[3, 6] = np.nan, 0, np.inf
    flags = np.zeros(SHAPE, np.uint8)
    flags[0, 0], flags[0, 1], flags[0, 2] = 1, 4, 6
    for kind, plane in (("weight", sigma**-2.0), ("variance", sigma**2), ("rms", sigma)):
        plane = np.where(np.isinf(plane) & (kind == "weight"), 0, plane)
        made = channel(
            image, weight=ArrayPlane(plane), weight_kind=kind, mask=ArrayPlane(flags), mask_value=4
        )
        mosaic = Mosaic("m", grid(), (made,), PSF.gaussian(1.5))
        weights = mosaic.observation(Box(0, 0, 10, 10)).weights[0]
        dropped = [tuple(p) for p in np.argwhere(weights == 0)]
        assert dropped == [(0, 1), (0, 2), (3, 4), (3, 5), (3, 6)]
        assert np.allclose(weights[weights > 0], 0.25)


def test_a_negative_rms_is_no_noise(image):
    sigma = np.full(SHAPE, 2.0)
    sigma[3, 4:6] = -1, -2
    made = channel(image, weight=ArrayPlane(sigma), weight_kind="rms")
    weights = made.weights(Box(0, 0, 10, 10))
    assert np.argwhere(weights == 0).tolist() == [[3, 4], [3, 5]]
    assert (weights[weights > 0] == 0.25).all()


def test_an_observation_is_the_box_with_its_own_wcs_and_psf(image):
    whole, psf = grid(angle_deg=12.0), PSF.gaussian(1.5)
    mosaic = Mosaic.of_arrays("m", image, psf, whole, weights=1.0, zero_points=[25.0])
    box = Box(20, 30, 45, 80)
    seen = mosaic.observation(box, subtract=np.ones((1, *box.shape)))
    np.testing.assert_array_equal(seen.data[0], image[box.slices] - 1.0)
    np.testing.assert_allclose(seen.grid.sky(3, 4), whole.sky(23, 34), atol=1e-12)
    assert seen.zero_points.tolist() == [25.0]
    nothing = mosaic.observation(box, ignore=np.ones(box.shape, bool))
    assert nothing is None


def test_arrays_are_checked_and_read_as_those_of_an_observation(image):
    hidden = np.ma.masked_greater(image, 12)
    given = {"variance": 4.0, "bands": "g", "saturation": 50.0, "unit": "nJy"}
    given["noise"] = np.ones((1, 1))
    mosaic = Mosaic.of_arrays("m", hidden, PSF.gaussian(1.5), grid(), **given)
    expected = Observation(hidden, PSF.gaussian(1.5), grid(), name="m", **given)
    found = mosaic.observation()
    for name in ("data", "weights", "zero_points", "bands", "channels", "saturation"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.noise is not None and (found.weights[0] == 0).sum() == hidden.mask.sum() > 0
    with pytest.warns(NoiseWarning) as caught:
        Mosaic.of_arrays("m", image, PSF.gaussian(1.5), grid().wcs)
    assert len(caught) == 1
    with pytest.raises(ValueError, match="weights has 60 negative values"):
        Mosaic.of_arrays("m", image, PSF.gaussian(1.5), grid(), weights=-np.eye(*SHAPE))


def test_the_box_on_a_grid_holds_all_its_pixels_and_few_others():
    psf = PSF.gaussian(1.5)
    wide = grid(angle_deg=30.0, scale=0.2, shape=(200, 200))
    mosaic = Mosaic.of_arrays("m", np.zeros((200, 200)), psf, wide, weights=1.0)
    patch = grid().cutout(10, 20, (32, 48))
    box = mosaic.box_on(patch)
    everywhere = wide.positions_in(patch, *np.indices(wide.shape))
    inside = np.argwhere(Box.of(patch.shape).contains(everywhere))
    assert len(inside) and Box(*box).contains(inside).all()
    assert box.area < 3.5 * len(inside)
    assert mosaic.box_on(grid().cutout(5000, 0, (32, 32))).area == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"channels": ()}, "channels of mosaic 'm' is empty"),
        ({"psf": PSF.gaussian([1.0, 2.0])}, "psf of mosaic 'm' has 2 bands, channels are 1"),
    ],
)
def test_what_does_not_go_together_is_refused(image, given, message):
    whole = {"channels": (channel(image),), "psf": PSF.gaussian(1.0)} | given
    with pytest.raises(ValueError, match=message):
        Mosaic("m", grid(), **whole)


def test_boxes():
    a, b = Box(0, 0, 10, 20), Box(5, 15, 12, 30)
    assert a.intersection(b) == (5, 15, 10, 20) and a.union(b) == (0, 0, 12, 30)
    assert a.intersection(Box(20, 20, 30, 30)).area == 0
    assert a.intersection(b).relative_to(b) == (0, 0, 5, 5)
    assert round_up_size(Box(10, 10, 41, 43), 32).shape == (32, 64)
    assert round_up_size(Box(10, 10, 41, 43), 32).intersection(Box(10, 10, 41, 43)) == (
        10,
        10,
        41,
        43,
    )
    assert a.contains([(-0.5, 0), (9.5, 0), (9.49, 19.4)]).tolist() == [True, False, True]


@pytest.mark.parametrize("changed", ["surface", "light"])
def test_filled_pixels_get_no_weight_where_subtraction_changes_their_value(image, changed):
    image[:, 60:] = 0
    image[10:13, 10:13] = 40  # a flat top stays
    slope = Background(np.arange(4.0).reshape(2, 2), (30.0, 45.0))
    background = slope if changed == "surface" else None
    mosaic = Mosaic("r", grid(), (channel(image, background=background),), PSF.gaussian(1.5))
    light = np.full((1, *SHAPE), 0.5) if changed == "light" else None
    found = mosaic.observation(subtract=light)
    np.testing.assert_array_equal(found.weights[0] == 0, image == 0)
    subtracted = 0.5 if changed == "light" else slope.read(Box.of(SHAPE))
    np.testing.assert_allclose(found.data[0], image - subtracted)
    assert (
        mosaic.observation(
            Box(0, 61, 30, 90), subtract=None if light is None else light[:, :30, 61:]
        )
        is None
    )
    plain = Mosaic("r", grid(), (channel(image),), PSF.gaussian(1.5))
    assert plain.observation().weights.all()  # the inspection names and masks them
