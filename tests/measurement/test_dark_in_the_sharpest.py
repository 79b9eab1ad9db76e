"""Sources that the sharpest image does not show, beside others; gaps that are no stars."""

import numpy as np
import pytest

from clresample.measurement.detection import detect
from clresample.measurement.star_light import saturated_stars
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF

pytest.importorskip("sep")
# sharp: one channel on pixels of 0.1"; blurred: three on pixels of 0.2", at the same place
SIDE_BY_SIDE = "sharp", "blurred"
SIDE, SIGMA = 8.0, {"sharp": 1.0, "blurred": 1.6}
SCALES, CHANNELS = {"sharp": 0.1, "blurred": 0.2}, {"sharp": ("V",), "blurred": tuple("gri")}


def observed(name, objects, *, mask=None, seed=2):
    """An Observation of Gaussians ((y, x) ["] from the middle, sigma ["], light in V, g, r, i)."""
    n, scale = round(SIDE / SCALES[name]), SCALES[name]
    y, x = (np.indices((n, n)) - (n - 1) / 2) * scale
    data = np.random.default_rng(seed).normal(size=(len(CHANNELS[name]), n, n))
    for (a, b), sigma, light in objects:
        s2 = (sigma / scale) ** 2 + SIGMA[name] ** 2 + 1 / 12
        image = np.exp(-((y - a) ** 2 + (x - b) ** 2) / scale**2 / (2 * s2)) / (2 * np.pi * s2)
        data += np.array(light[:1] if name == "sharp" else light[1:])[:, None, None] * image
    grid, psf = Grid.flat((n, n), scale), PSF.gaussian(SIGMA[name], n_pixels=31)
    given = {"channels": CHANNELS[name], "name": name, "weights": 1.0, "mask": mask}
    return Observation(data, psf, grid, **given)


def places(objects, **given):
    """Places ["] of the sources found in both images."""
    both = [observed(name, objects, **given) for name in SIDE_BY_SIDE]
    found = detect(both)
    middle = (np.array(found.frame.shape) - 1) / 2
    return (np.array([s.position_px for s in found.sources]) - middle) * SCALES["sharp"]


BLUE = ((0.0, -0.4), 0.25, (600.0, 1500, 900, 600))
RED = ((0.0, 0.75), 0.2, (0.0, 0, 60, 900))


def test_a_source_dark_in_the_sharpest_image_is_found_beside_another():
    found = places([BLUE, RED])
    assert len(found) == 2
    assert np.hypot(*(found - RED[0]).T).min() < 0.2


def test_a_galaxy_of_one_colour_has_no_companion_in_the_blurred_image():
    assert len(places([BLUE])) == 1


POINT = ((0.0, 0.0), 0.0, (0.0, 0, 2e4, 0))


@pytest.mark.parametrize(
    ("others", "n_stars"),
    [
        ([((0.0, 0.0), 0.0, (0.0, 2e4, 0, 2e4))], 1),
        ([((0.0, 0.0), 0.5, (0.0, 2e4, 0, 2e4))], 0),
        ([], 1),
    ],
)
def test_a_core_masked_in_one_band_is_a_stars_unless_others_show_a_galaxy(others, n_stars):
    """There are gaps over galaxies; where others show nothing, they cannot tell."""
    mask = np.zeros((3, 40, 40), bool)
    mask[1, 18:22, 18:22] = True
    o = observed("blurred", [POINT, *others], mask=mask)
    assert len(saturated_stars([o], model_frame([o]))) == n_stars
