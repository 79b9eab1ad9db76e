"""Single rules of errors, on arrays made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import scenes

from clresample.deblending.linear.normal import UnknownLayout
from clresample.deblending.posterior import posterior
from clresample.deblending.posterior.errors import PosteriorSampler
from clresample.deblending.posterior.modes import STRENGTH, Solution, clipped_power, gauged
from clresample.deblending.posterior.moments import light_sums
from clresample.deblending.posterior.profile_modes import (
    FAR_LIGHT,
    profile_modes,
)
from clresample.deblending.posterior.smooth_modes import _gaussians
from clresample.deblending.profiles import FixedProfile, GalaxyProfile, StarProfile
from clresample.deblending.solver.multiscale.prior import MultiscalePrior

PRIOR = MultiscalePrior(scales_px=(0.8, 2.2, 5.0), strengths=(0.005, 0.1, 0.02))


def solution(
    origin, profiles, *, spectra=None, fixed=(), chi2=1.0, peaks=1.0, pulls=None, **findings
):
    """Components in boxes, of which all else is as the profiles say."""
    n = len(profiles)
    fixed = np.isin(np.arange(n), fixed)
    rows = {"origin": np.array(origin), "profile": profiles, "fixed": fixed}
    scene = SimpleNamespace(**rows, ties=None, known_sky=np.zeros(3))
    given = {"energies": np.ones((n, 3)), "n_effective": np.ones((n, 3))}
    given |= {"strengths": np.tile([0.01, 0.05, 0.03], (n, 1))}
    return Solution(
        scene,
        [p / peaks for p in profiles],
        np.full(n, peaks),
        np.full((n, 2), 10.0) if spectra is None else np.array(spectra, float),
        np.full((n, 2), 0.5),
        [None] * n,
        [None] * n,
        np.zeros((n, 2)),
        np.arange(n),
        SimpleNamespace(**(given | findings)),
        np.full(n, chi2),
        PRIOR,
        [np.zeros(p.shape) for p in profiles] if pulls is None else pulls,
    )


def spot(n=9, sigma=2.0):
    y, x = np.indices((n, n)) - n // 2
    return np.exp(-0.5 * (y**2 + x**2) / sigma**2)


@pytest.mark.parametrize("chi2", [0.5, 4.0])
def test_unlikeness_is_what_the_scale_next_to_two_pixels_shows(chi2):
    """Under ten pixels' worth of 5 %; misfit makes it less, and 1 of stars."""
    energies, determined = np.array([[9, 0.8, 9]] * 2), np.array([[1, 30, 1]] * 2)
    given = {"energies": energies, "n_effective": determined, "chi2": chi2}
    one = solution([(0, 0), (9, 0)], [spot()] * 2, fixed=(1,), **given)
    wanted = np.sqrt((0.8 / max(chi2, 1) + 10 * 0.05**2) / 40) / 0.05
    assert one.structure_excess(0) == pytest.approx(wanted) and one.structure_excess(1) == 1
    assert STRENGTH == 0.05
    np.testing.assert_allclose(
        one.strengths(0), [0.01 * wanted**3.5, 0.05 * wanted, 0.03 * wanted**3.5]
    )
    np.testing.assert_array_equal(one.findings.strengths[0], [0.01, 0.05, 0.03])  # left as it is
    assert [clipped_power(unlike, 2.0) for unlike in (0.5, 3.0, 7.0)] == [0.25, 9.0, 9.0]


@pytest.mark.parametrize("alone, wanted", [(0.8, 0.8), (1.35, 1.0), (6.0, 1.3)])
def test_misfit_makes_no_galaxy_more_like_its_profile(alone, wanted):
    """Of unlikeness `alone` without it: no less than that, or than 1."""
    energy = 40 * (0.05 * alone) ** 2 - 10 * 0.05**2
    given = {"energies": np.full((1, 3), energy), "n_effective": np.full((1, 3), 30.0)}
    one = solution([(0, 0)], [spot()], chi2=25.0, **given)
    assert one.structure_excess(0) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("level, share", [(0.0, 0.0), (0.1, 1 / 22), (9.0, 0.45)])
def test_structure_is_stronger_where_light_may_be_a_neighbours(level, share):
    """By a fifth where a fifth of its light is others', in proportion below.

    A neighbour of 0.1 over half of a source has 1 / 11 of the light there; one beside it has none,
    nor has the source's second component.
    """
    own, half = np.ones((4, 6)), np.ones((4, 3))
    boxes, spectra = [(5, 5), (5, 8), (5, 11), (5, 5)], np.outer([1, level, 20, 5], [3.0, 4.0])
    one = solution(boxes, [own, half, half, own], spectra=spectra)
    one.source[3] = 0
    wanted = (1 + 0.2 * min(1, share / 0.2)) * solution(boxes[:1], [own]).strengths(0)
    np.testing.assert_allclose(one.strengths(0), wanted)
    np.testing.assert_array_equal(one.findings.strengths[0], [0.01, 0.05, 0.03])  # as the fit's


def test_what_bumps_change_counts_in_errors_of_flux_and_size():
    """Light at the middle changes the flux by its part; at a distance r, also the size:
    1 + r^2 / <r^2> times as much."""
    profile = spot(21)
    one = solution([(0, 0)], [profile], spectra=[[3.0, 4.0]])
    images = np.zeros((3, 21, 21))
    images[0, 10, 10] = images[1, 10, 14] = images[2, 7, 10] = 0.01
    mean = 2 * 4.0  # of r^2 in a Gaussian of sigma 2
    wanted = 0.01 / profile.sum() * 10 * np.array([1, 1 + 16 / mean, 1 + 9 / mean])
    np.testing.assert_allclose(one.flux_change_sigma(0, images), wanted, rtol=1e-3)
    np.testing.assert_allclose(one.flux_change_sigma(0, -images), one.flux_change_sigma(0, images))


def test_modes_leave_the_spectrum_and_pixels_at_their_bound_alone():
    """The part along the profile is removed; pixels at a free morphology's bound do not change."""
    rng = np.random.default_rng(0)
    one = solution([(0, 0)] * 2, [spot(), spot()], fixed=(1,))
    for m in one.morphs:
        m[2, 3] = m[5] = 0
    profile = spot()
    given = rng.normal(size=(3, 9, 9))
    wanted = given - np.tensordot(given, profile, 2)[:, None, None] * profile / (profile**2).sum()
    for i in range(2):
        one.scene.profile[i] = profile
        found = given.copy()
        along = one.remove_profile_part(i, found)
        np.testing.assert_allclose(along, np.tensordot(given, profile, 2) / (profile**2).sum())
        inside = one.morphs[i] > 0
        assert not inside.all()
        np.testing.assert_allclose(found, wanted * (inside if i == 0 else 1), atol=1e-12)


def test_light_of_a_neighbour_on_a_box():
    """All channels in quadrature; 0 where its own box does not reach."""
    boxes = [np.full((4, 5), 0.5), np.full((3, 3), 1.0)]
    one = solution([(2, 3), (4, 6)], boxes, spectra=[[3, 4], [6, 8]], peaks=2.0)
    found = one._light(1, 0)
    wanted = np.zeros((4, 5))
    wanted[2:, 3:] = 10 / 2
    np.testing.assert_allclose(found, wanted)
    np.testing.assert_allclose(one._light(0, 0), 5 / 2 * 0.5)


def test_light_is_exchanged_where_a_neighbour_has_a_part_of_it_and_both_are_seen():
    """More than `ratio` of the source's own; both above `faint` [noise]; boxes that meet alone."""
    own = np.ones((1, 6))
    own[0, 5] = 0.02
    other = np.array([[0.04, 0.06, 0.5, 0.5, 0.5, 0.5]])
    limits = {"faint": 0.3, "ratio": 0.05}

    def shared(level, *more):
        spectra = [[level, 0], [level, 0]] + [[1e3, 0]] * len(more)
        boxes = [own, other, *[np.ones((1, 1))] * len(more)]
        one = solution([(3, 3), (3, 3), *more], boxes, spectra=spectra)
        return one.overlap_mask(0, **limits).tolist()[0]

    assert shared(100.0) == [False, True, True, True, True, True]
    assert shared(10.0) == [False, True, True, True, True, False]  # its own 0.2 are not seen
    assert shared(0.7) == [False, False, True, True, True, False]
    assert shared(0.5) == [False] * 6
    assert shared(0.5, (3, 3)) == [True] + [False] * 5
    for beside in ((3, 2), (3, 9), (2, 3), (4, 3)):
        assert shared(0.5, beside) == [False] * 6
    limits = {}  # for errors: above 0.05 of the noise
    assert shared(1.0) == [False, True, True, True, True, False]


def test_sums_of_light_are_those_of_its_pixels():
    """Times powers of their positions in the frame; of modes from which the profile was taken."""
    rng = np.random.default_rng(2)
    images, low = rng.random((3, 8, 10)), np.array([5, -3])
    y, x = np.indices((8, 10)) + low[:, None, None]
    wanted = np.array([(images * v).sum((1, 2)) for v in (1, y, x, y * y, y * x, x * x)])
    found = light_sums(images, low)
    np.testing.assert_allclose(found, wanted)
    along = np.array([0.1, 0.2, 0.3, 0.4])  # of two modes more, which come first
    expected = np.concatenate([np.zeros((6, 2)), wanted[:, 1:]], axis=1)
    out = gauged(found, along)
    np.testing.assert_allclose(out[:, 1:], expected - np.outer(wanted[:, 0], along))
    np.testing.assert_allclose(out[:, 0], wanted[:, 0])


@pytest.mark.parametrize("side, margin", [(20, 10), (21, 10), (49, 24), (80, 24)])
def test_light_beyond_a_box_is_followed_for_half_its_side(side, margin):
    """24 px at most; there halos are 0.2 times as large."""
    shape, theta = GalaxyProfile(scenes.frame()), np.array([1.0, 0.1, 0.2, 3.0])
    position, low = np.array([60.3, 59.8]), np.array([60, 60]) - side // 2
    size = side + 2 * margin
    whole = shape.draw(theta, position - low + margin, (size, size))[0]
    profile = whole[margin:-margin, margin:-margin]
    _, _, far = profile_modes(shape, theta, position, profile / whole.max(), low)
    rest = whole.sum() - profile.sum()
    assert far[0, 0] == pytest.approx(rest / whole.max(), rel=1e-9)
    halo = np.sqrt(whole / whole.max())
    rest = halo.sum() - halo[margin:-margin, margin:-margin].sum()
    assert far[0, -1] == pytest.approx(0.2 * rest, rel=1e-9)


@pytest.mark.parametrize("log_beta", [-3.0, 1.0])
def test_wings_are_followed_to_the_edge_of_the_frame(log_beta):
    """Of a profile that has ended before, less than FAR_LIGHT is left."""
    frame = scenes.frame((96, 120))
    position, low = np.array([46.2, 60.3]), np.array([41, 54])
    shape, theta = GalaxyProfile(frame), np.array([1.2, 0.3, 0.1, log_beta])
    whole = shape.draw(theta, position)[0]
    box = shape.draw_box(theta, position, low, (12, 12), slopes=False)[0]
    _, _, far = profile_modes(shape, theta, position, box / whole.max(), low)
    found = box.sum() + far[0, 0] * whole.max()
    if log_beta > 0:
        assert 1 - FAR_LIGHT < found < whole.sum() * (1 + 1e-9)
    else:
        assert found == pytest.approx(whole.sum(), rel=1e-9)


def test_light_beyond_a_box_is_that_of_a_morphology_of_maximum_1():
    """Of a source whose structure has doubled the peak of its profile."""
    shape, theta, place = (
        GalaxyProfile(scenes.frame()),
        np.array([1.5, 0, 0, 0.5]),
        np.array([10.3, 9.8]),
    )
    whole = shape.draw(theta, place, (21, 21))[0]
    box = whole[5:16, 5:16] / whole.max()
    beyond = []
    for peak in (1.0, 2.0):
        one = solution([(5, 5)], [box], fixed=(0,), peaks=peak)
        one.shapes[0], one.thetas[0], one.positions[0] = shape, theta, place
        beyond.append(one.modes(0)[2][:, 0])
    np.testing.assert_allclose(beyond[0], 2 * beyond[1])


def test_how_far_profiles_and_places_may_be_off():
    """A tenth of a pixel; of the peak 0.1 in the core and 0.01 in the halo, or a part of those; a
    galaxy's parameters as galaxies scatter, more than fits expect, a star's place as they do."""
    home, position = scenes.frame(), np.array([10.0, 11.0])
    galaxy, star, box = GalaxyProfile(home), StarProfile(home, free=True), np.ones((9, 9))
    kinds = [
        (galaxy, galaxy.mean, [0.4, 0.26, 0.26, 2.5, 0.1, 0.1]),
        (FixedProfile(box), np.zeros(0), [0.1, 0.1]),
    ]
    for shape, theta, wanted in kinds:
        for radial in (1.0, 0.5):
            _, scatter, _ = profile_modes(shape, theta, position, box, [6, 7], radial=radial)
            np.testing.assert_allclose(scatter, [*wanted, 0.1 * radial, 0.01 * radial])
    assert profile_modes(star, np.zeros(2), position, box, [6, 7])[1] is star.scatter


def test_bumps_stand_on_every_hth_pixel_of_the_frame_to_beyond_both_ends():
    """Of a box of 23 pixels from 13 on: from the multiple of 8 before that at its first pixel."""
    found = _gaussians(13, 23, 8)
    centres = np.array([0, 8, 16, 24, 32, 40, 48]) - 13
    wanted = np.exp(-0.5 * ((np.arange(23) - centres[:, None]) / 4) ** 2)
    np.testing.assert_allclose(found, wanted)


def test_where_unknowns_lie():
    counts = np.array([3, 0, 2])
    plain = UnknownLayout(counts, 4)
    assert plain.sizes.tolist() == [7, 4, 6] and plain.common == 3 and plain.shift(1) is None
    full = UnknownLayout(counts, 4, n_sky=4, n_shifts=4)
    assert full.sizes.tolist() == [7, 4, 6, 8] and full.shift(0) is None
    assert full.shift(1).tolist() == [4, 5] and full.shift(2).tolist() == [6, 7]
    assert UnknownLayout(counts, 4, n_shifts=2).shift(1).tolist() == [0, 1]


def test_unknowns_are_modes_spectra_sky_levels_and_shifts_of_all_but_the_first(monkeypatch):
    """The first image of a component is its morphology, the others are its modes."""
    monkeypatch.setattr(posterior, "normal_matrix", lambda *given: given[-2])
    asked = []
    variances = [0.5] * 5, [2.0, 0.125] + [0.5] * 5
    known = SimpleNamespace(block=lambda i, j: np.diag(variances[i]))
    factor = SimpleNamespace(inverse=lambda: known, solve=asked.append)
    monkeypatch.setattr(posterior, "BlockCholesky", lambda _: factor)
    images = [np.arange(k).reshape(k, 1, 1) for k in (1, 3)]
    one = SimpleNamespace(
        spectra=np.ones((2, 5)),
        held=np.array([[0.0] * 5, [0, -1, 0, 0, -30]]),
        scene=SimpleNamespace(ties=None),
        modes=lambda i: (
            images[i],
            images[i][1:],
            np.zeros((6, len(images[i]))),
            np.arange(1.0, 2 * i + 1),
        ),
    )
    for sky, shifts in ((False, False), (True, False), (False, True), (True, True)):
        made = posterior.Posterior(one, [0, 0, 0], fit_sky=sky, fit_shifts=shifts)
        assert [m.ravel().tolist() for m in made.modes] == [[], [1, 2]]
        assert made.layout.n_modes.tolist() == [0, 2] and made.layout.n_channels == 5
        assert (made.layout.n_sky, made.layout.n_shifts) == (5 * sky, 4 * shifts)
        right = [part.tolist() for part in asked.pop()]
        n_common = [5 * sky + 4 * shifts] if sky or shifts else []
        of_spectra = [0, -1, 0, 0, pytest.approx(-30 * 9 / 450)]  # the last would move sqrt(450)
        assert right == [[0.0] * 5, [1, 2, *of_spectra], *([0.0] * n for n in n_common)]
    made._released([np.zeros(0), np.array([30.0, -40.0])])  # sqrt(2000) errors
    np.testing.assert_allclose(asked.pop()[1][:2], np.array([30, -40]) * 9 / 2000)


def test_the_bound_holds_modes_where_there_is_no_light():
    """By the slopes there, of free components alone; peaks are divided out of modes."""
    profile = spot(21)
    rng = np.random.default_rng(0)
    pulls = [rng.normal(size=(21, 21)) for _ in range(2)]
    one = solution([(0, 0)] * 2, [profile] * 2, fixed=(1,), pulls=pulls)
    for morph in one.morphs:
        morph[:5] = 0
    images = rng.normal(size=(3, 21, 21))
    wanted = (images[:, :5] * pulls[0][:5]).sum((1, 2))
    np.testing.assert_allclose(one._held(0, images), wanted, rtol=1e-12)
    assert one._held(1, images).tolist() == [0, 0, 0]


def test_draws_are_numbers_times_modes_and_spectra_in_counts():
    rng = np.random.default_rng(0)
    modes = [rng.normal(size=(2, 3, 4)), np.zeros((0, 2, 2))]
    values = [np.array([1.0, 2.0, 3.0, 4.0]), np.array([5.0, 6.0])]
    asked = []
    factor = SimpleNamespace(sizes=np.array([4, 2, 1]), draw=lambda x: asked.append(x) or values)
    sums = [np.array([7.0, 0.5, 0.25]), np.array([2.0])]
    sampler = PosteriorSampler(modes, sums, factor, np.array([10.0, 100.0]), np.array([3, 1]))
    morphs, spectra = sampler.draw(rng)
    assert asked[0].shape == (7,)
    np.testing.assert_allclose(morphs[0], 3 * (modes[0][0] + 2 * modes[0][1]))
    assert morphs[1].shape == (2, 2) and not morphs[1].any()
    np.testing.assert_allclose(spectra, [[90, 1200], [50, 600]])
    found = sampler.draw_fluxes(np.array([[20.0, 30.0], [1.0, 1.0]]), rng)
    light = 3 * (0.5 + 2 * 0.25)  # of the first one's modes
    expected = [[20 * light + 7 * 90, 30 * light + 7 * 1200], [2 * 50, 2 * 600]]
    np.testing.assert_allclose(found, expected)
