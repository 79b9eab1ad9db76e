"""A catalogue's names, flags, and sources that were not fitted."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from helpers.blends import (
    MIDDLE,
    SCALE,
    blend,
    observe,
    one_source,
    round_component,
    two_sources,
)
from helpers.headers import grid_of, header

from clresample.files.results import read_result, write_result
from clresample.measurement.catalogue import FLAG_MEANINGS, Flag, catalogue
from clresample.measurement.photometry import redistribute
from clresample.measurement.quality import summary
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.sources import ExtendedSource, PointSource, group_rows, join_groups


def test_names_and_frame_are_those_of_the_wcs():
    cards = header((60, 70), CTYPE1="GLON-TAN", CTYPE2="GLAT-TAN")
    result = blend([round_component(0, MIDDLE, (1, 1))], grid=grid_of(cards, (60, 70)))
    table = catalogue(result)
    assert {"glon", "glat_centroid"} <= set(table.colnames)
    assert table.meta["frame"] == "galactic"
    assert list(catalogue(two_sources())["name"]) == ["0", "1"]


def flags(result):
    return [Flag(value) for value in catalogue(result)["flags"]]


def test_a_good_source_has_no_flag():
    assert flags(two_sources()) == [Flag(0), Flag(0)]


def test_every_flag_has_a_meaning_and_a_bit_of_its_own():
    assert set(FLAG_MEANINGS) == set(Flag)
    assert sorted(flag.value for flag in Flag) == [1 << i for i in range(len(Flag))]
    assert Flag(np.int32(3)) == Flag.EDGE | Flag.NOT_CONVERGED


def test_edge_is_light_at_the_frames_edge_not_a_box():
    assert flags(blend([round_component(0, (14, 35), (1, 1), n=29)])) == [Flag(0)]
    wide = round_component(0, (14, 35), (1, 1), n=29, sigma=4.8)  # 1.4 % of the peak on row 0
    assert flags(blend([wide])) == [Flag.EDGE]
    narrow = round_component(0, (14, 35), (1, 1), n=29, sigma=4.4)  # 0.6 %
    assert flags(blend([narrow])) == [Flag(0)]


def test_edge_is_light_beside_sky_that_no_observation_saw():
    grid = Grid.flat((60, 70), SCALE)

    def seen(weights):
        return flags(one_source(observations=[observe(grid, ("g", "r"), weights=weights)]))

    weights = np.ones((2, 60, 70))
    weights[:, :, 38:] = 0
    assert seen(weights) == [Flag.EDGE]
    weights[1] = 1  # one channel sees it
    assert seen(weights) == [Flag(0)]
    half = Grid.flat((30, 19), 0.2, center_arcsec=(0, -1.6))  # ends at column 37
    assert flags(one_source(observations=[observe(half, ("g", "r"))])) == [Flag.EDGE]
    holes = np.ones((2, 60, 70))
    holes[:, 31:34, 36:39] = 0  # a masked patch is no edge
    assert seen(holes) == [Flag(0)]
    for width, expected in ((3, Flag(0)), (4, Flag.EDGE)):  # the PSF's FWHM is 3 px
        strip = np.ones((2, 60, 70))
        strip[:, :, 38 : 38 + width] = 0  # from edge to edge
        assert seen(strip) == [expected], width


def test_masked_is_the_centres_own_pixel():
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[1, 30, 36] = 0
    observations = [observe(grid, ("g", "r"), weights=weights)]
    for x, expected in (
        (35.4, 0),
        (35.6, Flag.CENTER_MASKED),
        (36.4, Flag.CENTER_MASKED),
        (36.6, 0),
    ):
        sources = (ExtendedSource(position_px=(30.0, x)),)
        assert flags(one_source(observations=observations, sources=sources)) == [Flag(expected)]


def test_saturated_is_a_star_with_masked_pixels_in_its_core():
    grid = Grid.flat((60, 70), SCALE)
    for source, away, expected in (
        (PointSource, (0, 0), Flag.SATURATED | Flag.CENTER_MASKED),
        (PointSource, (0, 1), Flag.SATURATED),  # the PSF's FWHM is 3 px
        (PointSource, (-1, 1), Flag.SATURATED),  # 1.4 px away
        (PointSource, (0, 2), Flag(0)),
        (ExtendedSource, (0, 1), Flag(0)),
    ):
        weights = np.ones((2, 60, 70))
        weights[1, 30 + away[0], 36 + away[1]] = 0
        given = {
            "observations": [observe(grid, ("g", "r"), weights=weights)],
            "sources": (source(position_px=(30.0, 36.0)),),
        }
        assert flags(one_source(**given)) == [expected]


@pytest.mark.parametrize("reach, light, expected", [(1, 50, True), (0, 50, False), (1, 5, False)])
def test_saturated_is_a_bright_galaxy_with_half_of_its_core_masked(reach, light, expected):
    grid = Grid.flat((60, 70), SCALE)
    weights = np.ones((2, 60, 70))
    weights[1, 30 - reach : 31 + reach, 36 - reach : 37 + reach] = 0
    data = np.zeros((2, 60, 70))
    data[1, 30, 38] = light
    o = observe(grid, ("g", "r"), weights=weights)
    o = Observation(data, o.psf, grid, weights=weights, channels=o.channels, name=o.name)
    source = (ExtendedSource(position_px=(30.0, 36.0)),)
    (found,) = flags(one_source(observations=[o], sources=source))
    assert bool(found & Flag.SATURATED) == expected


def test_masks_all_over_an_image_do_not_show_that_a_galaxy_is_saturated():
    grid, rng = Grid.flat((60, 70), SCALE), np.random.default_rng(0)
    data = np.zeros((2, 60, 70))
    data[1, 28:33, 34:39] = 50.0
    source = (ExtendedSource(position_px=(30.0, 36.0)),)
    for part, expected in ((0.0, Flag.SATURATED), (0.4, Flag(0))):
        weights = np.broadcast_to(rng.uniform(size=(60, 70)) >= part, (2, 60, 70)).astype(float)
        weights[:, 29:32, 35:38] = 1
        weights[:, 30:32, 35:38] = 0  # six of the nine pixels of the core
        o = observe(grid, ("g", "r"), weights=weights)
        o = Observation(data, o.psf, grid, weights=weights, channels=o.channels, name=o.name)
        (found,) = flags(one_source(observations=[o], sources=source))
        assert found & Flag.SATURATED == expected


def test_a_core_is_as_large_as_the_psf_of_larger_pixels():
    """Of twice the size, a FWHM of 3 px: what is 1 px away is in it, 2 px are not; mirrored."""
    grid = Grid.flat((30, 35), 2 * SCALE, flip=True)
    for away, expected in (((1, 0), Flag.SATURATED), ((-1, 1), Flag.SATURATED), ((0, 2), Flag(0))):
        weights = np.ones((2, 30, 35))
        weights[1, 15 + away[0], 17 + away[1]] = 0
        given = {
            "observations": [observe(grid, ("g", "r"), weights=weights)],
            "sources": (PointSource(position_px=(30.5, 34.5)),),
        }
        assert flags(one_source(**given)) == [expected]


def test_no_coverage_is_a_centre_off_an_image():
    full = observe(Grid.flat((60, 70), SCALE), ("g",))
    left = observe(Grid.flat((30, 17), 0.2, center_arcsec=(0, -1.8)), ("r",))  # to column 33
    assert flags(one_source(observations=[full, left])) == [Flag.NO_COVERAGE]
    assert flags(one_source((30, 33), observations=[full, left])) == [Flag(0)]
    moved = np.array([[0, 0], [0, 3.0]])  # its pixels lie 3 px further right than its WCS says
    assert flags(one_source(observations=[full, left], shifts=moved)) == [Flag(0)]


def test_sources_of_one_group_have_its_flux_and_a_flag(tmp_path):
    """By default of their own groups; sources without any have rows of their own."""
    places = ((30, 20), (30, 28), (30, 44))
    components = [round_component(i, place, (1.0 + i, 2.0)) for i, place in enumerate(places)]
    result = blend(components)
    assert "group_id" not in catalogue(result).colnames
    own = [replace(s, group=g) for s, g in zip(result.sources, (None, 7, 7), strict=True)]
    grouped = replace(result, sources=tuple(own))
    table = catalogue(grouped)
    write_result(tmp_path / "grouped.fits", grouped)
    assert read_result(tmp_path / "grouped.fits").sources == grouped.sources
    assert list(table["group_id"]) == [0, 1, 1] and list(table["n_group"]) == [1, 2, 2]
    assert [Flag(f) & Flag.GROUP for f in table["flags"]] == [Flag(0), Flag.GROUP, Flag.GROUP]
    flux, total = table["flux_g"].value, table["group_flux_g"].value
    np.testing.assert_allclose(total, [flux[0], flux[1] + flux[2], flux[1] + flux[2]])
    given = catalogue(result, groups=[5, 1, 1])
    np.testing.assert_array_equal(given["group_flux_g"], table["group_flux_g"])
    assert not any(Flag(f) & Flag.GROUP for f in given["flags"])  # may be any the caller likes


def test_late_sources_are_in_the_groups_of_their_hosts():
    sources = [ExtendedSource(position_px=(1, i), group=g) for i, g in enumerate((None, 3, None))]
    more = [ExtendedSource(position_px=(2, i)) for i in range(4)]
    found = join_groups(sources, more, [2, 1, -1, 2])
    assert [s.group for s in found] == [None, 3, 4, 4, 3, None, 4]
    assert group_rows(found) == [0, 1, 2, 2, 1, 5, 2]
    with pytest.raises(ValueError, match="group is -1, must be 0 or more"):
        ExtendedSource(position_px=(1, 1), group=-1)


def test_numbers_of_groups_and_draws_are_checked():
    with pytest.raises(ValueError, match=r"groups has the shape \(2,\), must be \(1,\): give a"):
        catalogue(one_source(), groups=[1, 2])
    for draw in (one_source().sample, one_source().sample_fluxes):
        with pytest.raises(ValueError, match="n is -2, must be 0 or more"):
            draw(-2)


def test_zero_flux_and_not_converged():
    assert flags(blend([round_component(0, MIDDLE, (1, 0))])) == [Flag.ZERO_FLUX]
    assert flags(blend([round_component(0, MIDDLE, (1, 1e-6))])) == [Flag(0)]
    covariance = np.array([1, np.inf])[:, None, None]
    unseen = blend([round_component(0, MIDDLE, (1, 0))], covariance=covariance)
    assert flags(unseen) == [Flag.NO_COVERAGE]
    assert flags(one_source(status="iteration limit")) == [Flag.NOT_CONVERGED]


def test_a_source_outside_the_frame_is_listed_and_not_measured():
    sources = (
        ExtendedSource(position_px=MIDDLE),
        PointSource(position_px=(30.0, 90.0), name="far"),
    )
    table = catalogue(one_source(sources=sources))
    assert list(table["flags"]) == [0, Flag.OUTSIDE_FRAME]
    assert table["name"][1] == "far"
    assert table["x"][1] == 90 * u.pix
    for name in table.colnames:
        if name == "ambiguous_with":
            assert table[name][1] == -1
        elif name not in ("name", "flags", "n_components", "y", "x", "y_sky", "x_sky"):
            value = u.Quantity(table[name]).value[1]
            assert np.isnan(value), name


def test_nothing_fitted_is_still_a_catalogue():
    data = np.full((2, 60, 70), 3.0)
    observation = observe(Grid.flat((60, 70), SCALE), ("g", "r"), data=data)
    far = (PointSource(position_px=(30.0, 90.0)),)
    result = blend([], sources=far, observations=[observation], sky=np.array([1.0, 3.0]))
    assert flags(result) == [Flag.OUTSIDE_FRAME]
    assert summary(result)["chi2"] == {"g": 4.0, "r": 0.0}
    assert not redistribute(result, 0).any()
    assert len(catalogue(blend([], sources=()))) == 0


def test_a_failed_fit_with_nan_is_still_a_catalogue():
    table = catalogue(blend([round_component(0, MIDDLE, (np.nan, 1))], status="failed"))
    assert table["flags"][0] & Flag.NOT_CONVERGED
    assert np.isnan(table["flux_g"][0]) and np.isnan(table["rms_size"][0])


def test_a_source_without_light_is_not_at_the_edge():
    dark = round_component(0, (14, 35), (0, 0), n=29)
    dark.morphology[:] = 0
    sources = (ExtendedSource(position_px=(14.0, 35.0)),)
    assert Flag.EDGE not in flags(blend([dark], sources=sources))[0]


def test_columns_have_units():
    """Positions and shapes as the docstring says; of channels with zero points uJy and mag."""
    grid = Grid.flat((60, 70), SCALE)
    observations = (
        observe(grid, ("a", "b"), weights=1e-12, name="raw"),
        observe(grid, ("g", "r", "i"), weights=1e-12, zero_points=25.0, name="cam"),
    )
    table = catalogue(
        blend([round_component(0, MIDDLE, (1, 2, 3, 4, 5))], observations=observations),
        magnitudes=True,
    )
    units = {name: table[name].unit for name in table.colnames if name not in ("name", "flags")}
    for name in ("g", "r", "i"):
        assert units.pop(f"flux_{name}") == units.pop(f"flux_err_{name}") == u.uJy
        assert units.pop(f"mag_{name}") == units.pop(f"mag_err_{name}") == u.mag
    for name in ("a", "b"):
        assert units.pop(f"flux_{name}") == units.pop(f"flux_err_{name}") == u.ct
    for name in ("g_r", "r_i"):  # not of those without zero points, nor between the two
        assert units.pop(f"colour_{name}") == units.pop(f"colour_err_{name}") == u.mag
    for name in ("y", "x"):
        sky = f"{name}_sky"
        assert {units.pop(name), units.pop(f"{name}_centroid")} == {u.pix}
        assert {units.pop(sky), units.pop(f"{sky}_centroid")} == {u.arcsec}
        assert units.pop(f"{name}_centroid_err") == u.pix
        assert units.pop(f"{sky}_centroid_err") == u.arcsec
    assert units.pop("rms_size") == units.pop("rms_size_err") == u.arcsec
    assert units.pop("position_angle") == units.pop("position_angle_err") == u.deg
    plain = {"snr", "n_components", "chi2_raw", "chi2_cam", "e1", "e2", "e1_err", "e2_err"}
    plain |= {f"max_residual_{name}" for name in "abgri"}
    plain |= {"misfit_sigma", "misfit_fraction", "ambiguous_with"}
    assert all(table[name].info.description for name in table.colnames)
    assert set(units) == plain
    assert all(units[name] in (None, u.dimensionless_unscaled) for name in plain)
    magnitudes = 25 - 2.5 * np.log10(table["flux_g"].value / 10 ** ((23.9 - 25) / 2.5))
    np.testing.assert_allclose(table["mag_g"].value, magnitudes)
