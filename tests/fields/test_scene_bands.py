"""A scene file that takes some bands of cubes: images, weights and masks of these bands."""

import numpy as np
from astropy.io import fits
from helpers.tiny_scene import change, write_scene

from clresample.fields.field_toml.scene_file import read_scene


def test_weights_and_masks_are_those_of_the_chosen_bands(tmp_path):
    write_scene(tmp_path)
    with fits.open(tmp_path / "b.fits") as hdus:
        cube = np.stack([k * hdus[0].data for k in (1, 2, 3)])
        fits.PrimaryHDU(cube, hdus[0].header).writeto(tmp_path / "b.fits", overwrite=True)
    weights = np.ones((3, 14, 14)) * np.array([10.0, 20.0, 30.0])[:, None, None]
    masks = np.zeros((3, 14, 14), "u1")
    masks[0, :, 0] = masks[1, :, 1] = masks[2, :, 2] = 1
    for name, planes in (("wb", weights), ("mb", masks)):
        fits.PrimaryHDU(planes).writeto(tmp_path / f"{name}.fits", overwrite=True)
    change(tmp_path, 'weight = "wb.fits"', 'weight = "wb.fits"\nmask = "mb.fits"\nbands = [2, 0]')
    b = read_scene(tmp_path / "scene.toml").observations[1]
    np.testing.assert_allclose(b.data[0], 3 * b.data[1], rtol=1e-6)
    for plane, weight, column in ((0, 30, 2), (1, 10, 0)):
        expected = np.full((14, 14), float(weight))
        expected[:, column] = 0
        np.testing.assert_array_equal(b.weights[plane], expected)
