"""Scene files: what they give, and each mistake reported by its key with what is allowed."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table

from clresample.fields.field_toml.scene_file import read_scene
from clresample.files.fits import write_fits
from clresample.files.scene_keys import SceneError
from clresample.files.source_table import read_sources
from clresample.paper.solver.constraints import Positivity, ProxChain
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

GRID = Grid.flat((30, 34), 0.1).to_wcs(ra_deg=150.0, dec_deg=2.0)
ONE = """
[[observation]]
name = "cam"
image = "image.fits"
psf = "psf.fits"
"""
CUBE = """
[[observation]]
name = "cube"
image = "cube.fits"
psf = "psf3.fits"
"""
SOURCES = """
[sources]
catalogue = "sources.csv"
"""
EVERY_KEY = """
[[observation]]
name = "cube"
image = "cube.fits"
hdu = 0
bands = ["i", "g"]
channels = ["red", "blue"]
psf = "psf3.fits"
psf_hdu = 0
psf_bands = [2, 0]
psf_center = [10, 10]
psf_spacing = 0.5
weight = "more.fits"
weight_hdu = "WHT"
mask = "more.fits"
mask_hdu = "DQ"
zero_point = [27, 26.5]
[sources]
catalogue = "full.fits"
format = "fits"
ra = "RA"
dec = "DE"
name = "id"
type = "class"
components = "n"
[frame]
reference = "cube"
footprint = "intersection"
psf_sigma_px = 0.7
[fit]
max_iter = 7
rel_tol = 0.01
monotone = false
correlation_px = 1.5
fit_shifts = true
fit_sky = true
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Images with noise 2, PSFs, weights and catalogues."""
    path = tmp_path_factory.mktemp("scene")
    rng = np.random.default_rng(0)
    grid = Grid.from_wcs(GRID, (30, 34))
    image, cube = rng.normal(0, 2, (30, 34)), rng.normal(0, 2, (3, 30, 34))
    write_fits(path / "image.fits", image, grid)
    write_fits(path / "cube.fits", cube, grid, bands="gri")
    write_fits(
        path / "away.fits",
        image,
        Grid.from_wcs(Grid.flat((30, 34), 0.1).to_wcs(ra_deg=151.0, dec_deg=2.0), (30, 34)),
    )
    fits.PrimaryHDU(PSF.gaussian(1.4, n_pixels=21).images[0]).writeto(path / "psf.fits")
    fits.PrimaryHDU(PSF.gaussian([1.4, 1.5, 1.6], n_pixels=21).images).writeto(path / "psf3.fits")
    fits.PrimaryHDU(PSF.gaussian([1.4, 1.5], n_pixels=21).images).writeto(path / "psf2.fits")
    weight = np.full((3, 30, 34), 0.25)
    weight[:, :5] = 0
    mask = np.zeros((30, 34), np.int16)
    mask[20:, 30:] = 4
    fits.HDUList(
        [fits.PrimaryHDU(), fits.ImageHDU(weight, name="WHT"), fits.ImageHDU(mask, name="DQ")]
    ).writeto(path / "more.fits")
    ra, dec = grid.sky(np.array([10.0, 20.0]), np.array([12.0, 22.0]))
    Table({"ra": ra, "dec": dec}).write(path / "sources.csv")
    Table({"ra": ra, "dec": dec, "type": ["point", "blob"]}).write(path / "types.csv")
    Table({"y": [10.0, np.nan], "x": [12.0, 3.0]}).write(path / "nan.csv")
    Table({"a": [1.0]}).write(path / "columns.csv")
    Table({"ra": ra[:0], "dec": dec[:0]}).write(path / "empty.ecsv")
    (path / "no_table.csv").write_bytes(bytes(range(256)))
    QTable(
        {
            "RA": ra * u.deg,
            "DE": (dec * u.deg).to(u.arcmin),
            "id": ["a", "b"],
            "class": ["Point", "extended"],
            "n": [1, 2],
        }
    ).write(path / "full.fits")
    return path


def scene(folder, text):
    path = folder / "scene.toml"
    path.write_text(text)
    return read_scene(path)


def test_the_least_that_a_scene_needs(folder):
    found = scene(folder, ONE)
    (o,) = found.observations
    assert (o.name, o.channels, o.zero_points) == ("cam", ("cam",), None)
    assert abs(o.weights[0, 0, 0] ** -0.5 - 2) < 0.2
    assert found.sources is None and found.passes == 2
    assert any("estimated" in note for note in found.notes)
    assert found.frame.shape == (30, 34)


def test_every_key_is_used(folder):
    found = scene(folder, EVERY_KEY)
    (o,) = found.observations
    cube = fits.getdata(folder / "cube.fits")
    np.testing.assert_array_equal(o.data, cube[[2, 0]])
    assert o.channels == ("red", "blue") and list(o.zero_points) == [27, 26.5]
    assert o.psf.spacing == 0.5
    np.testing.assert_allclose(o.psf.images, PSF.gaussian([1.6, 1.4], n_pixels=21).images)
    assert not o.weights[:, :5].any() and not o.weights[:, 20:, 30:].any()
    assert (o.weights[:, 5:20] == 0.25).all()
    point, extended = found.sources
    assert isinstance(point, PointSource) and isinstance(extended, ExtendedSource)
    assert (point.name, extended.n_components) == ("a", 2)
    np.testing.assert_allclose(
        found.frame.positions_of(found.sources), [(10, 12), (20, 22)], atol=1e-6
    )
    s = found.settings
    assert (s.max_iter, s.rel_tol, s.fit_shifts, s.fit_sky) == (7, 0.01, True, True)
    assert s.prior.correlation_px == 1.5 and str(s.constraints) == str(ProxChain(Positivity()))
    assert set(found.inputs) == {
        "scene",
        "sources",
        "image of cube",
        "PSF of cube",
        "weight of cube",
        "mask of cube",
    }


def test_bands_of_the_image_choose_those_of_the_psf(folder):
    (o,) = scene(folder, CUBE + "bands = [1, 2]\nvariance = [4, 5]").observations
    assert o.channels == ("r", "i")
    np.testing.assert_allclose(o.psf.images, PSF.gaussian([1.5, 1.6], n_pixels=21).images)
    np.testing.assert_allclose(o.weights[:, 0, 0], [1 / 4, 1 / 5])


@pytest.mark.parametrize("names", ["gri", "irg", "igr"])
@pytest.mark.parametrize("bands", ["", 'bands = ["i", "r", "g"]', 'bands = ["r", "i"]'])
def test_cubes_that_name_their_bands_are_matched_by_name(folder, names, bands):
    widths, variances = {"g": 1.4, "r": 1.5, "i": 1.6}, {"g": 3.0, "r": 4.0, "i": 5.0}
    header = fits.Header({f"BAND{i + 1}": name for i, name in enumerate(names)})
    psf = PSF.gaussian([widths[name] for name in names], n_pixels=21).images
    with fits.open(folder / "cube.fits") as hdus:
        planes = np.ones(hdus[0].shape) * np.array([variances[n] for n in names])[:, None, None]
    fits.PrimaryHDU(psf, header).writeto(folder / "named_psf.fits", overwrite=True)
    fits.PrimaryHDU(planes, header).writeto(folder / "named_variance.fits", overwrite=True)
    text = CUBE.replace("psf3", "named_psf") + bands + '\nvariance = "named_variance.fits"'
    (o,) = scene(folder, text).observations
    expected = PSF.gaussian([widths[name] for name in o.channels], n_pixels=21).images
    np.testing.assert_allclose(o.psf.images, expected)
    np.testing.assert_allclose(o.weights[:, 0, 0], [1 / variances[n] for n in o.channels])


@pytest.mark.parametrize("key", ["variance = [3, 4, 5]", 'psf = ["psf.fits", "psf.fits"]'])
def test_lists_beside_bands_in_another_order_are_refused(folder, key):
    text = CUBE if "psf" not in key else CUBE.replace('psf = "psf3.fits"', "")
    with pytest.raises(ValueError, match="bands puts all planes of the images into another order"):
        scene(folder, text + key + '\nbands = ["i", "r", "g"]')


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "observation is missing"),
        ("observation = 3", "observation is missing"),
        ("x = [", "not TOML"),
        (
            "[sauces]\n" + ONE,
            "table sauces is unknown; allowed are observation, sources, detection",
        ),
        ("fit = 3\n" + ONE, "fit is 3, must be a table"),
        (ONE + 'imgae = "x"', "observation 1: key imgae is unknown; allowed are name, image, hdu"),
        (
            '[[observation]]\nname = "cam"',
            "observation 1: image is missing, must be the name of a",
        ),
        (ONE + "hdu = 1.5", "hdu is 1.5, must be a number from 0"),
        (ONE + "hdu = 3", "observation 1 (cam): "),
        (ONE + 'hdu = "SCI"', "no HDU SCI (HDUs: 0 PRIMARY)"),
        (ONE + "bands = 4", "no band 4 (bands: 0)"),
        (ONE + 'bands = ["z"]', "no band z"),
        (ONE + "channels = 3", "channels is 3, must be a name, or a list of names"),
        (ONE + 'channels = ["V", "I"]', "channels has 2 names, data have 1 channels"),
        (
            ONE + 'psf_center = "left"',
            'psf_center is \'left\', must be "middle", "core" or [y, x]',
        ),
        (ONE + "psf_spacing = 0", "psf_spacing is 0, must be a number above 0"),
        (ONE + 'zero_point = "AB"', "zero_point is 'AB', must be a number, or a list"),
        (
            ONE + "zero_point = [25, 26]",
            "zero_point has 2 numbers, must have one for",
        ),
        (ONE + "variance = -1", "variance is -1, must be the name of a file, a number"),
        (ONE + "variance = [1, 2]", "variance has 2 planes, the images 1"),
        (ONE + "variance = 1\nweight = 1", "weight and variance are both given"),
        (ONE + 'weight_hdu = "WHT"', "weight_hdu is given, but weight names no file"),
        (ONE + "rms = 1\nvariance_hdu = 1", "variance names no file: the HDU of rms is rms_hdu"),
        (ONE + "weight = 1\nrms_hdu = 1", "rms names no file: the HDU of weight is weight_hdu"),
        (ONE + 'weight = "none.fits"', "none.fits: no such file"),
        (ONE + 'weight = "image.fits"', "weight_hdu must say which HDU"),
        (ONE + 'weight = "psf.fits"', "weight has (21, 21) pixels"),
        (CUBE.replace("psf3", "psf2"), "psf has 2 bands, the image 3"),
        (ONE.replace("image.fits", "none.fits"), "none.fits: no such file"),
        (ONE.replace("image.fits", "psf.fits"), "has no celestial WCS"),
        (ONE.replace("psf.fits", "scene.toml"), "not a FITS file"),
        (
            ONE
            + ONE.replace("image", "away").replace("away =", "image =").replace('"cam"', '"far"'),
            "does not overlap",
        ),
        (ONE + ONE, "given twice"),
        (ONE + 'channels = ["a"]' + ONE + 'channels = ["b"]', "names must be unique"),
        (ONE + "zero_point = 25" + CUBE, "'cam' has zero_point, 'cube' has none"),
        (
            ONE + '[frame]\nreference = "HST"',
            "reference is 'HST', must be the name of an observation: cam",
        ),
        (
            ONE + '[frame]\nfootprint = "all"',
            'footprint is \'all\', must be "union" or "intersection"',
        ),
        (ONE + "[frame]\npsf_sigma_px = 0", "psf_sigma_px is 0, must be a number above 0"),
        (ONE + "[fit]\nmax_iter = -1", "max_iter is -1, must be a whole number"),
        (ONE + "[fit]\nmax_iter = true", "max_iter is True, must be a whole number"),
        (ONE + "[fit]\nrel_tol = 1.0", "rel_tol is 1.0, must be a number x with 0 <= x < 1"),
        (ONE + "[fit]\nrel_tol = 0.1", "rel_tol is 0.1, but goes with monotone = true or"),
        (
            ONE + "[fit]\nmonotone = true\nloss_tol = 1",
            "loss_tol is 1, but goes without monotone = true or",
        ),
        (ONE + "[fit]\nfit_shifts = 1", 'fit_shifts is 1, must be true, false or "auto"'),
        (ONE + "[detection]\npasses = 3", "passes is 3, must be 1, or 2"),
        (ONE + "[detection]\nthreshold = 0", "threshold is 0, must be a number above 0"),
        (ONE + SOURCES + "[detection]", "sources and detection are both given"),
        (ONE + "[sources]", "sources: catalogue is missing"),
        (ONE + SOURCES.replace("sources.csv", "no.csv"), "no.csv: no such file"),
        (ONE + SOURCES.replace("sources.csv", "no_table.csv"), "no table that astropy can read"),
        (ONE + SOURCES + 'format = "nothing"', "no table that astropy can read"),
        (ONE + SOURCES + 'ra = "RAJ"', "ra is 'RAJ', "),
        (ONE + SOURCES.replace("sources.csv", "columns.csv"), "has neither the columns ra and dec"),
        (ONE + SOURCES.replace("sources.csv", "empty.ecsv"), "holds no source"),
        (
            ONE + SOURCES.replace("sources.csv", "types.csv"),
            "row 2: type is 'blob', must be point or",
        ),
        (ONE + SOURCES.replace("sources.csv", "nan.csv"), "row 2: position_px is"),
    ],
)
def test_mistakes_are_reported_by_key(folder, text, message):
    with pytest.raises(SceneError) as error:
        scene(folder, text)
    line = str(error.value)
    assert message in line and "scene.toml" in line and "\n" not in line


def test_a_psf_off_its_centre_is_noted_by_its_key(folder):
    moved = np.pad(fits.getdata(folder / "psf.fits"), ((4, 0), (0, 2)))
    fits.writeto(folder / "moved.fits", moved)
    off = scene(folder, ONE.replace("psf.fits", "moved.fits"))
    (note,) = [note for note in off.notes if "PSF core off the centre" in note]
    assert note.startswith("cam: ") and 'psf_center = "core" takes the core' in note
    right = scene(folder, ONE.replace("psf.fits", "moved.fits") + 'psf_center = "core"')
    assert not any("PSF" in note for note in right.notes)


def test_a_scene_that_is_not_there(tmp_path):
    with pytest.raises(SceneError, match=r"none\.toml: No such file"):
        read_scene(tmp_path / "none.toml")


def test_pixels_are_taken_where_they_are_asked_for(folder, tmp_path):
    Table({"ra": [150.0], "dec": [2.0], "y": [4.0], "x": [5.0], "row": [6.0]}).write(
        tmp_path / "both.ecsv"
    )
    (on_sky,) = read_sources(tmp_path / "both.ecsv")
    (on_pixels,) = read_sources(tmp_path / "both.ecsv", {"y": "row"})
    assert on_sky.sky_deg == (150.0, 2.0) and on_pixels.position_px == (6.0, 5.0)


def test_pixels_may_be_those_of_an_observation(folder, tmp_path):
    """A column names it; positions on the sky need none."""
    columns = {"y": [4.0, 5.0], "x": [5.0, 6.0], "image": ["cam", ""], "ra": [1.0] * 2}
    Table(columns | {"dec": [2.0] * 2}).write(tmp_path / "list.ecsv")
    found = read_sources(tmp_path / "list.ecsv", {"y": "y", "observation": "image"})
    assert [s.observation for s in found] == ["cam", None]
    assert found[0].position_px == (4.0, 5.0)
    on_sky = read_sources(tmp_path / "list.ecsv", {"ra": "ra", "observation": "image"})
    assert [s.observation for s in on_sky] == [None, None]


def test_the_frame_has_room_for_a_listed_source_just_outside(folder):
    """But where it is asked to be that of the images alone."""
    ra, dec = Grid.from_wcs(GRID, (30, 34)).sky(np.array([10.0, 33.0]), np.array([12.0, 20.0]))
    Table({"ra": ra, "dec": dec}).write(folder / "beside.csv")
    text = ONE + SOURCES.replace("sources.csv", "beside.csv")
    found = scene(folder, text)
    assert found.frame.shape[0] > 34 and found.frame.shape[1] == 34
    assert found.frame.contains(found.frame.positions_of(found.sources)).all()
    cut = scene(folder, text + '[frame]\nfootprint = "intersection"')
    assert cut.frame.shape == (30, 34)


def test_a_list_with_a_name_twice_is_refused(tmp_path):
    Table({"y": [4.0, 5.0], "x": [5.0, 6.0], "name": ["a", "a"]}).write(tmp_path / "list.ecsv")
    with pytest.raises(ValueError, match=r"list.ecsv: name 'a' is that of 2 sources, must be"):
        read_sources(tmp_path / "list.ecsv")


def test_a_negative_rms_gives_a_pixel_no_weight(folder):
    rms = np.full((30, 34), 2.0)
    rms[4, 5:7] = -1, -2
    fits.PrimaryHDU(rms).writeto(folder / "rms.fits", overwrite=True)
    (o,) = scene(folder, ONE + 'rms = "rms.fits"').observations
    assert np.argwhere(o.weights[0] == 0).tolist() == [[4, 5], [4, 6]]
    np.testing.assert_allclose(o.weights[o.weights > 0], 0.25)
