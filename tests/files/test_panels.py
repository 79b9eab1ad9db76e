"""Stretches, comparisons and panels of pictures."""

import numpy as np
import pytest

from clresample.drawing.figure import stretch
from clresample.files.panels import Panel, save_panels, stretch_limits
from clresample.files.plot_resampled import compare
from clresample.sky.grid import Grid
from clresample.sky.noise import background


def test_background_ignores_sources_and_gaps():
    image = np.random.default_rng(0).normal(3, 2, (200, 200))
    image[:5], image[5:10] = np.nan, 1e4
    median, sigma = background(image)
    assert abs(median - 3) < 0.2 and abs(sigma - 2) < 0.2


@pytest.mark.parametrize("noise", [0, 1])
def test_stretch_rises_from_background_to_brightest(noise):
    image = noise * np.random.default_rng(0).normal(size=(100, 100))
    image[:10] += 1000
    shown = stretch(image, stretch_limits(image))
    assert shown.min() >= 0 and shown.max() <= 1
    assert shown[:10].min() > 0.9 and np.median(shown[10:]) < 0.2


def test_a_constant_image_can_be_shown():
    assert np.isfinite(stretch(np.ones((4, 4)), stretch_limits(np.ones((4, 4))))).all()


def test_compare_finds_scale_and_level_inside_the_coverage():
    rng = np.random.default_rng(1)
    rendered, covered = rng.normal(size=(40, 40)), np.zeros((40, 40), bool)
    covered[5:35, 5:35] = True
    observed = 3 * rendered + 7
    observed[5:8], observed[:, 20] = 1e3, np.nan  # wrong near the edge, and a bad column
    found = compare(rendered, observed, covered, 4)
    assert found.correlation > 0.999999
    np.testing.assert_allclose((found.scale, found.sky_level), (3, 7), rtol=1e-9)
    assert found.mask[20, 10] and not found.mask[20, 7] and not found.mask[:, 20].any()
    np.testing.assert_allclose(found.residual[found.mask], 0, atol=1e-9)
    assert np.isnan(found.residual[~covered]).all()
    assert compare(rendered, observed, covered, 100) is None


def test_panels_lie_where_their_grids_say(tmp_path):
    """A bright pixel of a turned, finer image is drawn where it lies on the common pixels."""
    image_module = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    like = Grid.flat((30, 30), 1.0)
    turned = Grid.flat((80, 80), 0.5, angle_deg=30, flip=True)
    y, x = turned.map_to(like).at(60, 50)
    one, two = np.zeros(turned.shape), np.zeros(like.shape)
    one[58:63, 48:53] = 1
    two[round(y) - 1 : round(y) + 2, round(x) - 1 : round(x) + 2] = 1
    save_panels(
        tmp_path / "p.png",
        [Panel(one, turned, "", limits=(0, 1, 1)), Panel(two, like, "", limits=(0, 1, 1))],
        like=like,
    )
    picture = np.asarray(image_module.open(tmp_path / "p.png").convert("RGB"), float)
    # the brightest of the colours is yellow, scale bar and text are white or grey
    lit = (picture[..., 0] > 230) & (picture[..., 1] > 230) & (picture[..., 2] < 200)
    half = picture.shape[1] // 2
    places = [np.argwhere(part).mean(axis=0) for part in (lit[:, :half], lit[:, half:])]
    px = half / 30  # picture's pixels per pixel of the common grid
    np.testing.assert_allclose(places[0], places[1] - (0, 0), atol=px)
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]
