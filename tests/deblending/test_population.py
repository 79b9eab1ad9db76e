"""The prior on a scene's galaxies, updated from all of them."""

import numpy as np
import pytest
from helpers.scenes import blend, frame, observe, sources

from clresample import Settings
from clresample.deblending.blend import Blend
from clresample.deblending.fit import Fit, start_fits
from clresample.deblending.profiles import (
    ELLIPTICITY_SCATTER,
    FixedProfile,
    GalaxyProfile,
    StarProfile,
)
from clresample.deblending.start import population, profile_fit
from clresample.deblending.start.population import (
    ANY_SHAPE,
    GALAXY_SCATTER,
    LEARNED,
    NEIGHBOUR_MODEL_ERROR,
    OWN_LIGHT,
    SCENE_SCATTER,
    STAR_MODEL_ERROR,
    STUDENT_DOF,
    PopulationPrior,
    contamination_factors,
    em_step,
)
from clresample.deblending.start.profile_fit import ProfileFit
from clresample.deblending.start.without_doubt import MIN_BRIGHT, _is_faint, run_without_doubt


def shrunk(data, noise, mean, scatter):
    """Posterior means and variances of what was measured with some noise."""
    precision = noise**-2.0 + scatter**-2.0
    return (data / noise**2 + mean / scatter**2) / precision, 1 / precision


def test_scenes_learn_what_their_galaxies_have_in_common():
    """Of 500 scenes of twelve galaxies, drawn from the model, the mean and scatter are found, and
    galaxies are known better than by what is expected of any: as well as by the true two."""
    rng = np.random.default_rng(1)
    n_scenes, n, noise = 500, 12, np.array([0.4, 0.85])
    true = rng.normal(0, SCENE_SCATTER, (n_scenes, 2))
    theta = true[:, None] + GALAXY_SCATTER * rng.standard_normal((n_scenes, n, 2))
    data = theta + noise * rng.normal(size=theta.shape)
    common, own = np.zeros_like(true), np.tile(GALAXY_SCATTER, (n_scenes, 1))
    scatter = np.broadcast_to(np.hypot(SCENE_SCATTER, GALAXY_SCATTER), theta.shape)
    known = np.ones((n_scenes, n), bool)
    for _ in range(15):
        common, own, scatter = em_step(
            *shrunk(data, noise, common[:, None], scatter), known, common, own
        )
    found = shrunk(data, noise, common[:, None], scatter)[0]
    alone = shrunk(data, noise, 0.0, np.hypot(SCENE_SCATTER, GALAXY_SCATTER))[0]
    best = shrunk(data, noise, true[:, None], GALAXY_SCATTER)[0]
    error, by_itself, least = (
        np.sqrt(np.square(a - theta).mean((0, 1))) for a in (found, alone, best)
    )
    assert (error < 0.95 * by_itself).all() and (error < 1.15 * least).all()
    # a mean of twelve, each with its noise and its own scatter
    away = (common - true) / np.hypot(GALAXY_SCATTER, noise) * np.sqrt(n)
    assert (np.abs(away.std(0) - 1) < 0.2).all()
    assert (np.abs(np.median(own, axis=0) / GALAXY_SCATTER - 1) < 0.25).all()


def test_a_galaxy_unlike_the_others_counts_for_little():
    """Three times as large as five others, it moves what is expected of these by 3 % of that."""
    off, known = np.zeros((1, 7, 2)), np.ones((1, 7), bool)
    off[0, 0], off[0, 6], known[0, 6] = np.log(3), 5.0, False  # the last one is no galaxy
    common, own, scatter = np.zeros((1, 2)), GALAXY_SCATTER[None].copy(), GALAXY_SCATTER
    for _ in range(10):
        variance = np.broadcast_to(shrunk(off, 0.1, 0, scatter)[1], off.shape)
        common, own, scatter = em_step(off, variance, known, common, own)
    assert 0 < common[0, 0] < 0.03 * np.log(3) and own[0, 0] == pytest.approx(
        GALAXY_SCATTER[0], rel=0.05
    )
    # nor is it held to be like them
    assert scatter[0, 0, 0] > 2.5 * own[0, 0] > 2.5 * scatter[0, 1, 0]


def learned(data, noise):
    """c and s of one scene of galaxies, whose values (n,) were measured with some noise (n,)."""
    data, noise = (np.repeat(a, 2).reshape(1, -1, 2).astype(float) for a in (data, noise))
    common, own, scatter = np.zeros((1, 2)), GALAXY_SCATTER[None].copy(), GALAXY_SCATTER
    known = np.ones(data.shape[:2], bool)
    for _ in range(30):
        posterior = shrunk(data, noise, common[:, None], scatter)
        common, own, scatter = em_step(*posterior, known, common, own)
    return common[0, 0], own[0, 0]


def test_a_faint_galaxy_beside_known_ones_changes_nothing_and_among_faint_ones_it_counts():
    """The size of one with signal to noise 5 is known within a factor of two."""
    alone, beside = learned([0.4, 0.5], [0.05, 0.1]), learned([0.4, 0.5, -0.4], [0.05, 0.1, 0.7])
    assert np.abs(np.subtract(beside, alone)).max() < 0.015
    few, more = learned([0.4, 0.4], [0.7, 0.7]), learned([0.4] * 8, [0.7] * 8)
    assert 1.5 * few[0] < more[0] < 0.4


def test_galaxies_that_scatter_as_expected_leave_the_scatter_as_it_is():
    """However well each is known: those of half of the information count a quarter, in the sum and
    in their number."""
    variance = np.array([0.1, 0.1, 0.7, 0.7])[:, None] * GALAXY_SCATTER**2
    off = np.sqrt(GALAXY_SCATTER**2 - variance) * np.array([1, -1, 1, -1])[:, None]
    given = off[None], variance[None], np.ones((1, 4), bool)
    common, own, _ = em_step(*given, np.zeros((1, 2)), GALAXY_SCATTER[None])
    np.testing.assert_allclose(common, 0, atol=1e-12)
    np.testing.assert_allclose(own, GALAXY_SCATTER[None], rtol=1e-12)


def test_only_whole_galaxies_of_scenes_with_several_are_learned_from():
    home = frame()
    scenes = (
        [
            GalaxyProfile(home),
            StarProfile(home, free=True),
            GalaxyProfile(home),
            FixedProfile(np.ones((3, 3))),
        ],
        [GalaxyProfile(home)],
        [GalaxyProfile(home, 0, 2), GalaxyProfile(home, 1, 2), GalaxyProfile(home)],
    )
    shapes = [shape for scene in scenes for shape in scene]
    scene = np.repeat([0, 1, 2], [len(s) for s in scenes])
    index = np.concatenate([np.arange(len(s)) for s in scenes])
    one = PopulationPrior(shapes, scene, index, 3, 4, 4)
    mean, scatter = one.mean.copy(), one.scatter.copy()
    theta = mean + 0.5
    before = one.penalty(np.array([2, 0]), theta)
    # galaxies' parameters have Student's tails, a star's place has none
    away, smooth = 0.25 / scatter**2, np.zeros(mean.shape[:2], bool)
    smooth[0, [0, 2]] = smooth[1, 0] = smooth[2, :3] = True
    tails = np.where(smooth[..., None], STUDENT_DOF * np.log1p(away / STUDENT_DOF), away)
    tails[smooth, 1] = -2 * np.log(density(0.5**0.5) / density(0.0))
    tails[smooth, 2] = 0
    np.testing.assert_allclose(before, tails[[2, 0]].sum(axis=(1, 2)))
    one.update(np.arange(3), theta, np.tile(1e4 * np.eye(4), (3, 4, 1, 1)))
    changed = np.zeros(mean.shape, bool)
    changed[0, [[0], [2]], LEARNED] = True
    assert ((one.mean != mean) == changed).all() and ((one.scatter != scatter) == changed).all()
    # two that are well known have moved half of the way and more
    assert (one.mean - mean)[changed] == pytest.approx(0.5, abs=0.25)
    assert one.penalty(np.array([0]), theta)[0] < before[1]
    alone = one.mean.copy()
    one.update(np.array([1]), theta, np.tile(np.eye(4), (1, 4, 1, 1)))
    assert (one.mean == alone).all()


def test_a_faint_galaxy_is_taken_for_what_its_neighbours_are(device):
    """One of which the data say little is fitted larger among large ones than small ones."""
    places = ((10, 10), (10, 50), (50, 10), (50, 50))
    faint, sizes = ((30, 30), (1.6, 1.2, 1.4), 2.5), []
    for sigma in (1.5, 4.5):
        objects = (faint, *((p, (300, 250, 280), sigma) for p in places))
        one = Fit(blend(objects, shape=(60, 60), seed=3), Settings(), device, np.float32, pad=1)
        start_fits([one])
        sizes.append([theta[0] for theta in one.start.thetas])
    small, large = np.array(sizes)
    np.testing.assert_allclose(large[1:], np.log(4.5), atol=0.05)
    np.testing.assert_allclose(small[1:], np.log(1.5), atol=0.05)
    assert large[0] - small[0] > 0.15


def test_shapes_are_doubted_for_the_light_of_other_sources(monkeypatch):
    """By what a neighbour's light counts in units of the noise, seen as the galaxy sees its own.

    In the channels that tell most.
    """
    rng = np.random.default_rng(2)
    images, light = rng.uniform(0, 1, (2, 3, 40)), rng.uniform(1, 9, (2, 3))  # channels, components
    light[:, 1] *= 30
    images[:, 2, :20] = 0
    images[:, 0, 20:] = 0  # the first one and the third one have no pixel in common
    source, stars = np.array([[0, 1, 2]]), np.zeros((1, 3), bool)
    seen = light[..., None] * images
    normal = np.einsum("cip,cjp->cij", images, images)[None]
    expected = np.full(3, np.inf)
    for i in range(3):
        others = seen.sum(1) - seen[:, i]
        own, beside = (seen[:, i] ** 2).sum(axis=1), (seen * seen[:, i, None]).sum(axis=(0, 2))
        alike = np.minimum(1, own.sum() / (seen**2).sum(axis=(0, 2)))
        beside[i] = 0
        held = OWN_LIGHT * (beside @ alike) / beside.sum()
        for some in ([0], [1], [0, 1]):  # channels
            wrong = max((others * seen[:, i])[some].sum() - held * own[some].sum(), 0)
            factor = 1 + NEIGHBOUR_MODEL_ERROR**2 * wrong**2 / own[some].sum()
            expected[i] = min(expected[i], factor * own.sum() / own[some].sum())
    assert np.count_nonzero(expected > 1) >= 2
    found = contamination_factors(normal, light[None], source, stars)[0]
    np.testing.assert_allclose(found, expected)
    # components of one source do not doubt each other, and one without light is not doubted
    np.testing.assert_allclose(contamination_factors(normal, light[None], 0 * source, stars), 1)
    apart = np.where(np.eye(3), normal, -1e-20)  # rounding
    np.testing.assert_allclose(contamination_factors(apart, light[None], source, stars), 1)
    dark = contamination_factors(normal, light[None] * [1, 0, 1], source, stars)[0]
    assert dark[1] == 1 and (dark[[0, 2]] < found[[0, 2]]).all()
    # a star beside them counts by the error of a PSF
    only = np.array([[1.0, 0, 1]])
    stars[0, 2], less = True, STAR_MODEL_ERROR / NEIGHBOUR_MODEL_ERROR
    monkeypatch.setattr(population, "OWN_LIGHT", 0.0)
    pair = contamination_factors(np.abs(normal), light[None] * only, source, np.zeros_like(stars))
    beside = contamination_factors(np.abs(normal), light[None] * only, source, stars)
    np.testing.assert_allclose(beside[0, 0] - 1, less**2 * (pair[0, 0] - 1))
    assert beside[0, 2] == pair[0, 2]


def density(g):
    """Of a galaxy's ellipticity at |g|: round within a scatter, or any e of |e| < 1."""
    near = np.exp(-(g**2) / 2 / ELLIPTICITY_SCATTER**2) / (2 * np.pi * ELLIPTICITY_SCATTER**2)
    return (1 - ANY_SHAPE) * near + ANY_SHAPE / (np.pi * (1 + g**2) ** 2)


def test_flat_galaxies_are_rare_and_not_impossible():
    """The prior is a density, its precision the slope of the penalty; an axis ratio of 0.2 costs
    15."""
    g = np.geomspace(1e-4, 1e4, 20000)
    assert np.trapezoid(2 * np.pi * g * density(g), g) == pytest.approx(1, abs=1e-3)
    one, scenes = PopulationPrior([GalaxyProfile(frame())], [0], [0], 1, 1, 4), np.arange(1)

    def penalty(g):
        return one.penalty(scenes, one.mean + [0, 0.6 * g, 0.8 * g, 0])[0]

    for g in (0.1, 0.5, 1.0, 2.4):
        found = one.precision(scenes, one.mean + [0, 0.6 * g, 0.8 * g, 0])[0, 0, 1:3]
        slope = (penalty(g + 1e-6) - penalty(g - 1e-6)) / 2e-6
        np.testing.assert_allclose(found, np.full(2, slope / (2 * g)), rtol=1e-5)
    assert penalty(0.3) == pytest.approx((0.3 / ELLIPTICITY_SCATTER) ** 2, rel=0.1)
    assert penalty(0.5) < penalty(2.4) == pytest.approx(15.1, abs=0.1)


def test_doubt_holds_a_galaxy_as_if_its_data_said_less():
    """Ten times as doubtful as another one, it is held ten times as strongly; what is learned of
    both is what data of a tenth of the weight would have taught."""
    home, scenes = frame(), np.arange(2)
    shapes, at = [GalaxyProfile(home) for _ in range(4)], (np.repeat(scenes, 2), np.tile([0, 1], 2))
    one = PopulationPrior(shapes, *at, 2, 2, 4)
    theta, data = one.mean + 0.3, 50.0
    plain = one.penalty(scenes, theta)
    one.set_contamination(np.array([0]), np.full((1, 2), 10.0))
    np.testing.assert_allclose(one.penalty(scenes, theta), plain * [10, 1])
    # the second scene's data say a tenth as much
    weight = np.array([data, data / 10])[:, None, None] + one.precision(scenes, theta)
    one.update(scenes, theta, weight[..., None] * np.eye(4))
    np.testing.assert_allclose(one.mean[0], one.mean[1])
    np.testing.assert_allclose(one.scatter[0], one.scatter[1])


def test_places_of_stars_are_not_doubted():
    home = frame()
    one = PopulationPrior(
        [GalaxyProfile(home, 0, 2), StarProfile(home, free=True)], [0, 0], [0, 1], 1, 2, 4
    )
    one.set_contamination(np.array([0]), np.array([[7.0, 9.0]]))
    assert one.contamination.tolist() == [[7, 1]]


def test_shapes_are_doubted_in_a_group_as_alone(device):
    """Of scenes that end after different numbers of steps, in none of which rows are mixed up."""
    rng, blends = np.random.default_rng(6), []
    for n in (2, 5, 1, 4, 5):
        objects = [
            (
                tuple(rng.uniform(12, 48, 2)),
                tuple(10 ** rng.uniform(2, 4.5) * rng.uniform(0.5, 1, 3)),
                rng.uniform(0.8, 4),
            )
            for _ in range(n)
        ]
        blends.append(blend(objects, shape=(60, 60), seed=n))
    together, alone = (
        [Fit(b, Settings(), device, np.float32, pad=1) for b in blends] for _ in range(2)
    )
    start_fits(together)
    for one, other in zip(alone, together, strict=True):
        start_fits([one])
        for a, b in zip(one.start.thetas, other.start.thetas, strict=True):
            np.testing.assert_allclose(b, a, atol=1e-4)


def test_a_faint_galaxy_takes_less_of_what_is_wrong_with_a_bright_one(device, monkeypatch):
    """A bright galaxy with an arm of 0.5 % of its light is no smooth profile; the faint one beside
    it is round, and drawn out along the arm less far where its shape is doubted."""
    bright, faint = ((30, 24), (6e4, 5e4, 7e4), 3.6), ((30, 34), (300, 240, 270), 2.0)
    arm = [((30 - 2 * k, 31 + k), (60, 54, 66), 1.5) for k in range(5)]
    seen = observe((bright, faint, *arm), shape=(60, 60), seed=5)
    shapes = []
    for wrong in (0.0, NEIGHBOUR_MODEL_ERROR):
        monkeypatch.setattr(population, "NEIGHBOUR_MODEL_ERROR", wrong)
        given = Blend(seen, sources((bright, faint)), frame((60, 60)))
        one = Fit(given, Settings(), device, np.float32, pad=1)
        start_fits([one])
        shapes.append(one.start.thetas)
    before, after = (np.hypot(*thetas[1][1:3]) for thetas in shapes)
    assert before > 1.2 and after < 0.7 * before
    # that of the bright one hardly changes
    np.testing.assert_allclose(shapes[1][0][:3], shapes[0][0][:3], atol=0.1)


@pytest.mark.parametrize("spoilt", [False, True])
def test_two_bright_galaxies_that_are_alike_have_their_own_shapes(device, monkeypatch, spoilt):
    """Each is known by its own light, though the other one has as much at its place; also where one
    of them had become small and doubted."""
    pair = ((26, 24), (3000, 2500, 2100), 6.0), ((28, 27), (3000, 2500, 2100), 6.0)

    def run(fit):
        fit.theta[0, 1] = np.log(1.5), 0, 0, np.log(6.5)
        fit._take(np.arange(1))
        assert fit.population.contamination[0, 1] > 10
        run_without_doubt(fit, np.arange(1), np.arange(1))

    if spoilt:
        monkeypatch.setattr(ProfileFit, "run", run)
    one = Fit(blend(pair, shape=(56, 56), seed=6), Settings(), device, np.float32, pad=1)
    start_fits([one])
    wanted = (np.log(6.0), 0.2, -0.1)
    np.testing.assert_allclose([theta[:3] for theta in one.start.thetas], [wanted] * 2, atol=0.02)


def test_shapes_of_galaxies_far_fainter_than_those_they_overlap_stay_doubted(device, monkeypatch):
    bright = ((26, 24), (30000, 25000, 21000), 4.0)
    others = ((34, 30), 0.01), ((18, 30), 0.2), ((50, 50), 0.01)  # the last one is far away
    faint = [(place, tuple(part * f for f in bright[1]), 3.0) for place, part in others]
    seen = []
    monkeypatch.setattr(profile_fit, "run_without_doubt", lambda fit, *_: seen.append(fit))
    given = blend((bright, *faint), shape=(64, 64), seed=6)
    start_fits([Fit(given, Settings(), device, np.float32, pad=1)])
    assert 0.01 < MIN_BRIGHT < 0.2
    assert _is_faint(seen[0], np.arange(1)).tolist() == [[False, True, False, False]]
