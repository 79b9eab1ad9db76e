"""Components of sources, starting points, and sources far from light, on numbers made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import frame

from clresample.deblending.profiles import FixedProfile, GalaxyProfile, StarProfile
from clresample.deblending.start import profile_start as room
from clresample.deblending.start.profile_start import StartInput
from clresample.sky.sources import ExtendedSource, PointSource

PLACES = np.array([(8.2, 9.4), (20.0, 25.3), (14.6, 5.1)])
FAR = np.array([(11.0, 30.2)])


def patches():
    """Three sources, of one, two and one component, and one of one."""
    home, y = frame(), np.arange(30)[:, None]
    profile = np.exp(-0.5 * ((y - 14) ** 2 + (np.arange(36) - 5) ** 2) / 4)
    some = [
        PointSource(position_px=PLACES[0], free_position=True),
        ExtendedSource(position_px=PLACES[1], n_components=2),
        ExtendedSource(position_px=PLACES[2], profile=profile),
    ]
    return [
        StartInput(home, some, PLACES, []),
        StartInput(home, [ExtendedSource(position_px=FAR[0])], FAR, []),
    ]


def test_components_are_numbered_by_their_scene():
    sources, found = room._components(patches())
    assert sources.tolist() == [0, 1, 1, 2, 0] == [c.source for c in found]
    assert [(c.scene, c.index) for c in found] == [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0)]
    assert [type(c.shape) for c in found] == [
        StarProfile,
        GalaxyProfile,
        GalaxyProfile,
        FixedProfile,
        GalaxyProfile,
    ]
    places = [c.position.tolist() for c in found]
    assert places == [*PLACES[[0, 1, 1, 2]].tolist(), *FAR.tolist()]
    assert {c.frame for c in found} == {(30, 36)}


def test_a_starting_point_is_of_profiles_with_maximum_1():
    """Free stars are where they were found; shapes are drawn from where they were given to be."""
    rng, given = np.random.default_rng(0), patches()
    sources, components = room._components(given)
    thetas = [np.array([0.3, -0.4]), *(c.shape.mean + 0.1 for c in components[1:])]
    n, scene = len(components), np.array([c.scene for c in components])
    normal = rng.uniform(1, 2, (2, 3, 5, 5))
    looking = SimpleNamespace(
        scene=scene, components=components, normal=normal, spectra=rng.random((n, 3)),
        sky=rng.random((2, 3)),
    )  # fmt: skip
    own = {"flux_estimate": rng.random((n, 3, 3)), "flux_doubt": rng.random((n, 3, 2))}
    fit = SimpleNamespace(looking=looking, **own)
    for b, places in ((0, PLACES), (1, FAR)):
        dark = np.zeros(len(places), bool)
        found = room._point(given[b], fit, thetas, sources, b, dark)
        own = np.flatnonzero(scene == b)
        for name in ("flux_estimate", "flux_doubt"):
            parts = [getattr(fit, name)[own[sources[own] == i]] for i in range(len(places))]
            np.testing.assert_allclose(getattr(found, name), [part.sum(0) for part in parts])
        drawn = [components[i].shape.draw(thetas[i], components[i].position)[0] for i in own]
        peaks = np.array([image.max() for image in drawn])
        np.testing.assert_allclose(found.peaks, peaks, rtol=1e-4)  # boxes have FFTs of their own
        peaks = found.peaks
        np.testing.assert_allclose(found.spectra, looking.spectra[own] * peaks[:, None])
        power = np.array([[normal[b, c, k, k] for c in range(3)] for k in range(len(own))])
        np.testing.assert_allclose(found.spectrum_curvature, power / peaks[:, None] ** 2)
        moved = places + (np.array([(0.3, -0.4), (0, 0), (0, 0)]) if b == 0 else 0)
        np.testing.assert_allclose(found.positions, moved)
        np.testing.assert_array_equal(found.drawn_positions, places[found.source])
        assert found.source.tolist() == sources[own].tolist() and found.undetected is dark
        assert found.shapes == [components[i].shape for i in own] and len(found) == len(own)
        np.testing.assert_array_equal(found.sky, looking.sky[b])
        assert found.sky.base is None  # its own
        for k, image in enumerate(drawn):
            part = found.drawn(k, (3, 4), (10, 12))
            np.testing.assert_allclose(part, image[3:13, 4:16] / peaks[k], atol=1e-4)
    np.testing.assert_array_equal(given[0].positions, PLACES)  # the patch keeps what was given


def test_stars_come_with_their_spectra_for_unit_integral():
    given = patches()
    sources, components = room._components(given)
    one = room.StartingPoint(
        source=sources[:4], positions=PLACES, undetected=None, drawn_positions=None,
        sky=None, spectrum_curvature=None,
        shapes=[c.shape for c in components[:4]], thetas=None,
        peaks=np.array([0.5, 1, 1, 1]), spectra=np.arange(12.0).reshape(4, 3) + 1,
    )  # fmt: skip
    ((shape, source, place, spectrum),) = one.stars()
    assert shape is components[0].shape and source == 0
    assert place.tolist() == PLACES[0].tolist() and spectrum.tolist() == [2, 4, 6]


@pytest.mark.parametrize("beside", [4.0, 0.1])
def test_sources_are_dark_where_no_light_lies_beside_them(beside):
    """A source shines if any of its components does; the others are looked at once more as galaxies
    six times wider than is expected, all of them at their own places."""
    given, looked = patches(), []
    given.append(
        StartInput(
            frame(), [ExtendedSource(position_px=(3.0, 4.0))] * 2, np.array([(3.0, 4), (5, 6)]), []
        )
    )
    sources, components = room._components(given)
    scene = np.array([c.scene for c in components])
    #                star    two of the second   third   alone   two more
    seen = np.array([[0.5, 0], [0.1, 0], [9.0, 0], [0, 1], [50, 60], [1.0, 1.0], [-7.0, 0.2]])
    sky = np.ones((3, 2))

    def instead(wide):
        def look(scenes, thetas, brightness, *, slopes):
            assert [np.ptp(t - c.shape.mean) for t, c in zip(thetas, wide, strict=True)] == [0] * 4
            assert not brightness.any() and brightness.shape == (4,) and not slopes
            looked.append((scenes.tolist(), wide))

        snr = np.array([[0, 0.2], [beside, 0], [0, beside], [0.3, 0.1]])
        return SimpleNamespace(
            scene=np.array([c.scene for c in wide]), render=look,
            signal_to_noise=lambda level: snr if level is sky else None,
        )  # fmt: skip

    looking = SimpleNamespace(
        scene=scene, sky=sky, with_components=instead,
        signal_to_noise=lambda level: seen if level is sky else None,
    )  # fmt: skip
    found = [dark.tolist() for dark in room._dark(given, sources, looking)]
    still = beside < 3
    assert found == [[True, False, still], [False], [still, True]]
    ((scenes, wide),) = looked
    assert scenes == [0, 2]
    assert [(c.scene, c.index, c.source) for c in wide] == [
        (0, 0, 0),
        (0, 1, 2),
        (2, 0, 0),
        (2, 1, 1),
    ]
    places = [PLACES[0], PLACES[2], (3, 4), (5, 6)]
    np.testing.assert_array_equal([c.position for c in wide], places)
    usual = GalaxyProfile(frame()).mean
    for c in wide:
        np.testing.assert_allclose(c.shape.mean - usual, [np.log(6), 0, 0, 0])
    looking.signal_to_noise = lambda level: np.full((7, 2), 99.0)
    assert not any(dark.any() for dark in room._dark(given, sources, looking)) and len(looked) == 1


def test_known_parameters_are_those_of_sources_with_as_many_components():
    thetas = [np.array([0.1, 0.2])], [np.zeros(4), np.ones(4)], [np.zeros(0)]
    first, second = patches()
    known = replace(first, thetas=thetas), replace(second, thetas=([np.ones(4)] * 2,))
    found = room._known(known, room._components(known)[1])
    assert {k: theta.tolist() for k, theta in found.items()} == {
        0: [0.1, 0.2], 1: [0.0] * 4, 2: [1.0] * 4, 3: [],
    }  # fmt: skip
    assert room._known([first, replace(second, thetas=(None,))], room._components(known)[1]) == {}
