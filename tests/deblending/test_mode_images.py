"""Smooth modes on wide pixels: what is computed from them, and errors of fits with them."""

import numpy as np
import pytest
from helpers import scenes

from clresample import Settings
from clresample.deblending.linear.mode_images import (
    CellImages,
    ModeImages,
    cell_sums,
    combined,
    subtract,
    sums_with,
)
from clresample.deblending.posterior import smooth_modes
from clresample.deblending.posterior.posterior import Posterior
from clresample.files.draws import draw_hdus, read_draws

LARGE = (((32.4, 30.7), (2000, 1500, 2500), 9.0), ((40.0, 52.0), (90, 60, 90), 2.0))


def drawn(shape=(7, 10), pixels=(4, 2), k=(3, 1, 2)):
    """Modes of two widths on pixels of their own, and sharp ones."""
    rng = np.random.default_rng(0)
    smooth = [
        CellImages(rng.normal(size=(n, *(-(-side // pixel) for side in shape))), pixel)
        for n, pixel in zip(k, pixels, strict=False)
    ]
    return ModeImages(tuple(smooth), rng.normal(size=(k[-1], *shape)))


def test_images_in_cells_are_arrays():
    """They keep the means, and polynomials of second order."""
    modes, rng = drawn(), np.random.default_rng(1)
    dense = np.asarray(modes)
    assert dense.shape == modes.shape == (6, 7, 10) and len(modes) == 6
    values = rng.normal(size=(4, 6))
    np.testing.assert_allclose(combined(modes, values), np.tensordot(values, dense, 1))
    np.testing.assert_allclose(combined(modes, values[0]), np.tensordot(values[0], dense, 1))
    weights = rng.normal(size=(2, 7, 10))
    wanted = np.tensordot(weights, dense, ((1, 2), (1, 2)))
    np.testing.assert_allclose(sums_with(modes, weights), wanted)
    y, x = np.indices((20, 24)) / 10
    image = y**2 - 2 * x**2 + x * y
    cells = CellImages(cell_sums(image, 4)[None] / 16, 4)
    found = cells.on_pixels(cells.values, image.shape)[0]
    np.testing.assert_allclose(cell_sums(found, 4), cell_sums(image, 4))
    np.testing.assert_allclose(found, image, atol=1e-9)
    image, parts = rng.normal(size=(7, 10)), rng.normal(size=6)
    before = sums_with(modes, np.ones((1, 7, 10)))[0]
    subtract(modes, parts, image)
    after = sums_with(modes, np.ones((1, 7, 10)))[0]
    padded = cell_sums(image, 4).sum(), image.sum()
    assert padded[0] == pytest.approx(padded[1])
    np.testing.assert_allclose(before[4:] - after[4:], parts[4:] * image.sum())


@pytest.fixture(scope="module")
def given(device):
    """Parts of the Posterior of a large galaxy with a small one on its flank."""
    kept, make = [], Posterior.__init__
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Posterior, "__init__", lambda *a, **k: kept.append(a[1:]) or make(*a, **k))
        free = Settings(fit_sky=True, fit_shifts=True, max_iter=15)
        scenes.fit(scenes.blend(LARGE, shape=(64, 72)), device, settings=free)
    return kept[0]


def test_errors_on_wide_pixels_are_those_on_the_models(given, monkeypatch):
    """Of fluxes and moments, with sky and shifts; of what the bound did; of draws."""
    monkeypatch.setattr(smooth_modes, "MAX_MODES", 60)
    found, draws = [], []
    for wide in (True, False):
        with monkeypatch.context() as patch:
            if not wide:
                patch.setattr(smooth_modes, "PIXELS_A_SIGMA", 1000)
            one = Posterior(*given, fit_sky=True, fit_shifts=True)
        sharp = [not isinstance(m, ModeImages) for m in one.modes]
        assert sharp == [not wide, True]
        if wide:  # the wider bumps; narrower ones are sharp
            assert [cells.pixel for cells in one.modes[0].smooth] == [2]
        run = np.arange(2), np.zeros((2, 3)), np.ones(3)
        found.append(one.errors(*run, np.zeros((0, 2, 3))))
        sampler = one.draws(*run)
        draws.append(sampler.changes(0)[0].std(0))
    wide, fine = found
    for a, b in ((wide.colour, fine.colour), (wide.moments, fine.moments)):
        a, b = (np.sqrt(np.diagonal(c, axis1=1, axis2=2)) for c in (a, b))
        np.testing.assert_allclose(a, b, rtol=0.02)
    error = np.sqrt(np.diagonal(fine.colour, axis1=1, axis2=2))
    np.testing.assert_allclose((wide.flux_correction - fine.flux_correction) / error, 0, atol=0.02)
    np.testing.assert_allclose(wide.flux[:, 0, 1], fine.flux[:, 0, 1], rtol=0.05)
    assert np.abs(draws[0] - draws[1]).max() < 0.2 * draws[1].max()


def test_draws_on_wide_pixels_are_stored_bit_by_bit(given, monkeypatch):
    monkeypatch.setattr(smooth_modes, "MAX_MODES", 40)
    one = Posterior(*given)
    assert [[cells.pixel for cells in m.smooth] for m in one.modes] == [[4, 2], [2]]
    sampler = one.draws(np.arange(2), np.zeros((2, 3)), np.ones(3))
    hdus = {hdu.name: hdu for hdu in draw_hdus(sampler)}
    back = read_draws(hdus, [m.shape[1:] for m in one.modes])
    for i in range(2):
        np.testing.assert_array_equal(sampler.sums[i], back.sums[i])
        for a, b in zip(sampler.changes(i), back.changes(i), strict=True):
            np.testing.assert_array_equal(a, b)
