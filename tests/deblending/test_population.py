"""What is expected of a scene's galaxies, learned from all of them."""

import numpy as np
import pytest
from helpers.scenes import blend, frame

from clresample import Settings
from clresample.deblending.fit import Fit, begin
from clresample.deblending.profiles import Galaxy, Given, Star
from clresample.deblending.start.population import COMMON, LEARNED, OWN, Population, learned


def shrunk(data, noise, mean, scatter):
    """Posterior means and variances of what was measured with some noise."""
    precision = noise**-2.0 + scatter**-2.0
    return (data / noise**2 + mean / scatter**2) / precision, 1 / precision


def test_scenes_learn_what_their_galaxies_have_in_common():
    """Of 500 scenes of twelve galaxies, drawn from the model, the mean and scatter are found, and
    galaxies are known better than by what is expected of any: as well as by the true two."""
    rng = np.random.default_rng(1)
    n_scenes, n, noise = 500, 12, 0.4
    true = rng.normal(0, COMMON, (n_scenes, 2))
    theta = true[:, None] + OWN * rng.standard_normal((n_scenes, n, 2))
    data = theta + noise * rng.normal(size=theta.shape)
    common, own = np.zeros_like(true), np.tile(OWN, (n_scenes, 1))
    scatter = np.broadcast_to(np.hypot(COMMON, OWN), theta.shape)
    known = np.ones((n_scenes, n), bool)
    for _ in range(15):
        common, own, scatter = learned(
            *shrunk(data, noise, common[:, None], scatter), known, common, own
        )
    found = shrunk(data, noise, common[:, None], scatter)[0]
    alone = shrunk(data, noise, 0.0, np.hypot(COMMON, OWN))[0]
    best = shrunk(data, noise, true[:, None], OWN)[0]
    error, by_itself, least = (
        np.sqrt(np.square(a - theta).mean((0, 1))) for a in (found, alone, best)
    )
    assert (error < 0.95 * by_itself).all() and (error < 1.15 * least).all()
    # a mean of twelve, each with its noise and its own scatter
    away = (common - true) / np.hypot(OWN, noise) * np.sqrt(n)
    assert (np.abs(away.std(0) - 1) < 0.2).all()
    assert (np.abs(np.median(own, axis=0) / OWN - 1) < 0.25).all()


def test_a_galaxy_unlike_the_others_counts_for_little():
    """Three times as large as five others, it moves what is expected of these by 3 % of that."""
    off, known = np.zeros((1, 7, 2)), np.ones((1, 7), bool)
    off[0, 0], off[0, 6], known[0, 6] = np.log(3), 5.0, False  # the last one is no galaxy
    common, own = np.zeros((1, 2)), OWN[None].copy()
    for _ in range(10):
        common, own, scatter = learned(off, np.full_like(off, 0.01), known, common, own)
    assert 0 < common[0, 0] < 0.03 * np.log(3) and own[0, 0] == pytest.approx(OWN[0], rel=0.02)
    # nor is it held to be like them
    assert scatter[0, 0, 0] > 2.5 * own[0, 0] > 2.5 * scatter[0, 1, 0]


def test_only_whole_galaxies_of_scenes_with_several_are_learned_from():
    home = frame()
    scenes = (
        [Galaxy(home), Star(home, free=True), Galaxy(home), Given(np.ones((3, 3)))],
        [Galaxy(home)],
        [Galaxy(home, 0, 2), Galaxy(home, 1, 2), Galaxy(home)],
    )
    shapes = [shape for scene in scenes for shape in scene]
    scene = np.repeat([0, 1, 2], [len(s) for s in scenes])
    index = np.concatenate([np.arange(len(s)) for s in scenes])
    one = Population(shapes, scene, index, 3, 4, 4)
    mean, scatter = one.mean.copy(), one.scatter.copy()
    theta = mean + 0.5
    before = one.pull(np.array([2, 0]), theta)
    np.testing.assert_allclose(before, [(0.25 / scatter[b] ** 2).sum() for b in (2, 0)])
    one.learn(np.arange(3), theta, np.tile(1e4 * np.eye(16), (3, 1, 1)))
    changed = np.zeros(mean.shape, bool)
    changed[0, [[0], [2]], LEARNED] = True
    assert ((one.mean != mean) == changed).all() and ((one.scatter != scatter) == changed).all()
    # two that are well known have moved half of the way and more
    assert (one.mean - mean)[changed] == pytest.approx(0.5, abs=0.25)
    assert one.pull(np.array([0]), theta)[0] < before[1]
    alone = one.mean.copy()
    one.learn(np.array([1]), theta, np.tile(np.eye(16), (3, 1, 1)))
    assert (one.mean == alone).all()


def test_a_faint_galaxy_is_taken_for_what_its_neighbours_are(device):
    """One of which the data say little is fitted larger among large ones than small ones."""
    places = ((10, 10), (10, 50), (50, 10), (50, 50))
    faint, sizes = ((30, 30), (1.6, 1.2, 1.4), 2.5), []
    for sigma in (1.5, 4.5):
        objects = (faint, *((p, (300, 250, 280), sigma) for p in places))
        one = Fit(blend(objects, shape=(60, 60), seed=3), Settings(), device, np.float32, pad=1)
        begin([one])
        sizes.append([theta[0] for theta in one.start.thetas])
    small, large = np.array(sizes)
    np.testing.assert_allclose(large[1:], np.log(4.5), atol=0.05)
    np.testing.assert_allclose(small[1:], np.log(1.5), atol=0.05)
    assert large[0] - small[0] > 0.15
