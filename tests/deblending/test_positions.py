"""Positions of sources: in the pixels of an observation, and far from any light."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from helpers.headers import grid_of, header
from helpers.scenes import GALAXIES, SHAPE, blend, fit, frame, same

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.inspection.inspect import InputWarning
from clresample.deblending.settings import Settings
from clresample.paper.image_profiles import with_image_profiles
from clresample.sky.frame import model_frame
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource, SourceWarning

SHORT = Settings(max_iter=10)


def in_pixels_of(observation, position, home=None):
    """A position (y, x) [px] of the model frame in an observation's pixels."""
    home = frame().grid if home is None else home
    return tuple(home.positions_in(observation.grid, *np.array(position, float)))


def test_a_position_in_an_observations_pixels(device):
    """The same fit as from the frame's own pixels, upright and turned ones."""
    b = blend()
    sharp, turned = b.observations
    given = [
        ExtendedSource(position_px=in_pixels_of(o, p), observation=o.name, name=o.name)
        for o, (p, _, _) in zip((turned, sharp), GALAXIES, strict=True)
    ]
    assert np.hypot(*np.subtract(given[0].position_px, GALAXIES[0][0])) > 3  # another place
    result = deblend(b.observations, given, frame=b.frame, device=device, settings=SHORT)
    same(result, fit(b, device, settings=SHORT))
    for source, (position, _, _), name in zip(result.sources, GALAXIES, "re", strict=True):
        assert source.observation is None and source.name == name
        np.testing.assert_allclose(source.position_px, position, atol=1e-9)


def test_the_default_frame_need_not_be_known(device):
    """The model frame begins elsewhere than any image: positions are right all the same."""
    b = blend(angle=40)
    sharp = b.observations[0]
    given = [ExtendedSource(position_px=p, observation="e") for p, _, _ in GALAXIES]
    result = deblend(b.observations, given, device=device, settings=SHORT)
    assert result.frame.shape != SHAPE
    found = result.frame.positions_of(result.sources)
    offset = sharp.grid.positions_in(result.frame.grid, 0.0, 0.0)
    assert np.abs(offset).max() > 2
    np.testing.assert_allclose(found - offset, [p for p, _, _ in GALAXIES], atol=1e-9)
    (many,) = deblend_many(
        [replace(b, frame=None, sources=tuple(given))], settings=SHORT, device=device
    )
    same(many, result)


def test_known_shifts_move_positions_along(device):
    shift = (1.2, -0.8)
    b = replace(blend(shift=shift), shifts=np.array([(0, 0), shift]))
    moved = b.observations[1]
    at = np.array(GALAXIES[0][0])
    source = PointSource(position_px=in_pixels_of(moved, at - shift), observation="r")
    found = b.frame.positions_of([source], b.observations, b.shifts)
    np.testing.assert_allclose(found, [at], atol=1e-9)
    (profiled,) = with_image_profiles(
        replace(b, sources=(ExtendedSource(position_px=source.position_px, observation="r"),)),
        device=device,
    ).sources
    peak = np.unravel_index(np.argmax(profiled.profile), SHAPE)
    assert np.abs(np.subtract(peak, at)).max() < 2


def test_on_the_sky_reference_systems_are_converted():
    """FK5 and ICRS differ by some 20 mas: a third of these pixels."""
    cards = header((20, 22), scale=0.05 / 3600)
    near = header((24, 24), CROTA2=30.0)
    near["RADESYS"], cards["RADESYS"] = "FK5", "ICRS"
    one, other = grid_of(cards, (20, 22)), grid_of(near, (24, 24))
    psf = PSF.gaussian(1.0)
    seen = [
        Observation(np.zeros(g.shape), psf, g, weights=1.0, name=name, channels=(name,))
        for g, name in ((one, "one"), (other, "other"))
    ]
    home = model_frame(seen)
    source = PointSource(position_px=(11.0, 13.0), observation="other")
    (found,) = home.positions_of([source], seen)
    np.testing.assert_allclose(found, other.map_to(home.grid).at(11, 13), atol=1e-4)
    by_numbers = home.grid.pixel(*other.sky(11.0, 13.0))
    assert 0.1 < np.abs(found - by_numbers).max() < 1


def test_what_an_observation_is_called():
    o, p = blend().observations
    unnamed = Observation(o.data, o.psf, o.grid, weights=1.0, channels=("v",))
    source = PointSource(position_px=(3, 4), observation="with channels v")
    np.testing.assert_array_equal(frame().positions_of([source], [unnamed, p]), [(3, 4)])
    lost = PointSource(position_px=(3, 4), observation="VIS")
    for given, words in (
        ([o, p], "'VIS', but no observation has this name: given are 'e', 'r'"),
        ([], "'VIS', but no observation has this name: given are none"),
    ):
        with pytest.raises(ValueError, match=words):
            frame().positions_of([lost], given)
    twice = Observation(p.data, p.psf, p.grid, weights=1.0, channels=("x", "y"), name="e")
    with pytest.raises(ValueError, match="'e', but 2 observations have this name: .*'e', 'e'"):
        frame().positions_of([PointSource(position_px=(3, 4), observation="e")], [o, twice])
    with pytest.raises(ValueError, match="observation is 'e', but the position is on the sky"):
        PointSource(sky_deg=(3, 4), observation="e")


def test_flat_images_in_a_frame_on_the_sky_are_refused():
    o, _ = blend().observations
    home = model_frame([replace_grid(o, grid_of(header((20, 22)), (20, 22)))])
    with pytest.raises(ValueError, match="flat"):
        home.positions_of([PointSource(position_px=(3, 4), observation="e")], [o])


def replace_grid(o, grid):
    data = np.zeros(grid.shape)
    return Observation(data, o.psf, grid, weights=1.0, channels=o.channels, name=o.name)


def wide_blend(*extra):
    """The two galaxies in the corner of images of 12" a side, and more sources."""
    b = blend(shape=(120, 120))
    return replace(b, sources=(*b.sources, *extra))


def test_a_source_far_from_any_light_is_warned_about(device):
    """By its number and place, in one blend and in many; the others are not."""
    b = wide_blend(ExtendedSource(position_px=(90, 95)), PointSource(position_px=(100, 20)))
    two = "no light above 3 sigma at or near 2 source positions"
    with pytest.warns(SourceWarning, match=f"{two}: see") as caught:
        result = fit(b, device, settings=SHORT)
    assert [w.category for w in caught].count(SourceWarning) == 1  # compilers may say more
    assert [m.split("; no image")[0] for m in result.messages] == [
        "a source lies far from any light: source 2 at (y, x) = (90.0, 95.0) [px] in the model "
        "frame",
        "a source lies far from any light: source 3 at (y, x) = (100.0, 20.0) [px] in the model "
        "frame",
    ]
    with pytest.warns(SourceWarning, match=f"{two} of blends that were fitted together"):
        results = deblend_many([b, wide_blend()], settings=SHORT, device=device)
    assert results[0].messages == result.messages and results[1].messages == ()


@pytest.mark.parametrize(
    "extra",
    [
        (
            ExtendedSource(position_px=(13, 40)),
            ExtendedSource(position_px=(30, 18)),
        ),  # beside a galaxy
        (PointSource(position_px=(15, 18), free_position=True),),
    ],
    ids=["beside", "between"],
)
def test_beside_light_no_source_is_warned_about(device, extra):
    with warnings.catch_warnings():
        warnings.simplefilter("error", SourceWarning)
        assert fit(wide_blend(*extra), device, settings=SHORT).messages == ()


def test_what_one_instrument_sees_alone_is_light(device):
    """A star in one channel of the turned image; the same position without it is dark."""
    place, star = (90.0, 95.0), (90.0, 95.0)
    for flux, n_dark in ((0.0, 1), (4.0, 0)):
        drawn = (*GALAXIES, (star, (0, 0, flux), 0))
        b = blend(drawn, shape=(120, 120))
        b = replace(b, sources=(*b.sources[:2], ExtendedSource(position_px=place)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SourceWarning)
            assert len(fit(b, device, settings=SHORT).messages) == n_dark


def test_a_background_that_is_fitted_is_no_light(device):
    b = blend(shape=(120, 120), sky=(0.5, 0.5, 0.5))
    b = replace(b, sources=(*b.sources, ExtendedSource(position_px=(90, 95))))
    with pytest.warns(InputWarning, match="sky is left in"):
        found = fit(b, device, settings=replace(SHORT, fit_sky=False)).messages
    assert not any("far from any light" in m for m in found)
    for fit_sky, n_images in ((True, 0), ("auto", 2)):
        with pytest.warns(SourceWarning):
            result = fit(b, device, settings=replace(SHORT, fit_sky=fit_sky))
        assert len(result.messages) == 1 + n_images


def test_where_nothing_was_seen_there_is_no_light(device):
    """A corner of the model frame that no image covers, far from the galaxies."""
    b = blend(shape=(60, 60), angle=45)
    home = model_frame(b.observations)
    assert min(home.shape) > 70
    corner = ExtendedSource(position_px=tuple(n - 2.0 for n in home.shape))
    seen = ExtendedSource(position_px=GALAXIES[0][0], observation="e")
    with pytest.warns(SourceWarning, match="1 source position:"):
        result = deblend(b.observations, [seen, corner], device=device, settings=SHORT)
    assert any("any light: source 1 at" in m for m in result.messages)
