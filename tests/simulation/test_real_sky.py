"""A real sky's fields: seeded, with their truth, and each fault by itself."""

import numpy as np
import pytest

from clresample import Spoilers, simulate_field, simulate_scene
from clresample.simulation.counts import (
    GALAXIES_TO_BREAK,
    GALAXY_BREAK,
    GALAXY_SLOPES,
    cumulative_counts,
    galaxy_magnitudes,
    half_light_arcsec,
)
from clresample.simulation.real_sky import bright_sources
from clresample.simulation.spoilers import add_cosmic_rays, gap_pixels, saturate

pytest.importorskip("galsim")
SMALL = {"n_pixels": 96, "rubin_bands": ("i",)}


def field(**options):
    return simulate_field(3, **(SMALL | {"sky": "real"} | options))


@pytest.fixture(scope="module")
def clean():
    return field(spoilers=Spoilers.none())


def test_a_seed_gives_one_field():
    one, other = field(), field()
    for a, b in zip(one.mosaics, other.mosaics, strict=True):
        np.testing.assert_array_equal(a.data, b.data)


def changed(clean, **kept):
    """The largest change of data [sigma], of WCS [px], of PSFs, and the pixels that went bad."""
    other = field(spoilers=Spoilers.none(**kept))
    found = {"data": 0.0, "wcs": 0.0, "psf": 0.0, "bad": 0}
    for a, b in zip(clean.mosaics, other.mosaics, strict=True):
        good = ~a.bad_pixels & ~b.bad_pixels
        change = (np.abs(a.data - b.data) / a.noise_sigma[:, None, None])[:, good]
        found["data"] = max(found["data"], float(np.median(change)))
        pixel = np.array(a.grid.pixel(*b.grid.sky(10.0, 10.0)))
        found["wcs"] = max(found["wcs"], float(np.hypot(*(pixel - 10.0))))
        found["psf"] = max(found["psf"], float(np.abs(a.psf_images - b.psf_images).max()))
        found["bad"] += int((a.bad_pixels != b.bad_pixels).sum())
    return found


@pytest.mark.parametrize(
    ("kept", "what", "low", "high"),
    [
        ({"wcs_offset_px": (0.2, 0.2)}, "wcs", 0.19, 0.21),
        ({"psf_width": (0.02, 0.02)}, "psf", 1e-4, 1e-2),
        ({"sky_sigma": 0.3}, "data", 0.29, 0.31),
        ({"gaps": 1}, "bad", 96 * 24, 5000),
    ],
)
def test_a_spoiler_changes_its_own_part_of_the_field(clean, kept, what, low, high):
    found = changed(clean, **kept)
    assert low <= found.pop(what) <= high
    if what != "bad":
        assert found.pop("bad") == 0
    assert max(found.values()) < 1e-6


def test_spoilers_scale_and_refuse_what_is_below_zero():
    assert Spoilers().scaled(0) == Spoilers.none()
    assert Spoilers().scaled(2).sky_sigma == 0.6
    with pytest.raises(ValueError, match="sky_sigma is -1, must be 0 or more"):
        Spoilers(sky_sigma=-1)
    with pytest.raises(ValueError, match="factor is -1"):
        Spoilers().scaled(-1)


def test_saturation_keeps_the_charge_and_fills_its_columns():
    data = np.zeros((80, 9))
    data[40, 4] = 1000.0
    full = saturate(data, 100.0)
    assert data.max() == 100 and full.sum() >= 9 and not full[:, 3].any()
    assert data.sum() == pytest.approx(1000, rel=1e-6)


def test_cosmic_rays_are_short_and_bright():
    data = np.zeros((1, 200, 200))
    add_cosmic_rays(data, np.ones(1), np.random.default_rng(0), 200.0)
    assert 0 < (data > 0).sum() < 8 * 3 * 16 and data.max() > 20


def test_gaps_are_whole_rows_or_columns():
    bad = gap_pixels((60, 50), np.random.default_rng(1), 2)
    assert bad.any(axis=0).all() or bad.any(axis=1).all()


def test_counts_and_sizes_follow_their_relations():
    rng = np.random.default_rng(0)
    mag = galaxy_magnitudes(rng, 400.0, 25.0)
    expected = 400 * cumulative_counts(25.0, GALAXIES_TO_BREAK, GALAXY_BREAK, GALAXY_SLOPES)
    assert expected == pytest.approx(400 * 46, rel=1e-6)
    assert len(mag) == pytest.approx(expected, rel=0.03)
    sizes = [np.median([half_light_arcsec(rng, m) for _ in range(400)]) for m in (14.0, 18.5, 23.0)]
    np.testing.assert_allclose(sizes, (14.2, 1.79, 0.534), rtol=0.1)


def test_the_bright_field_holds_what_it_promises():
    sources = bright_sources(np.random.default_rng(2), 1024 * 0.101)
    large = [s for s in sources if s.size_arcsec > 0.79]
    assert len(large) == 6 and len(sources) == 171
    assert sum(s.kind == "star" for s in sources) == 5
    assert any(len(p.clump_fractions) == 30 for s in large for p in s.parts)


def test_clumps_name_their_galaxy_and_hold_part_of_its_flux():
    sky = simulate_field(5, sky="bright", n_pixels=256, rubin_bands=("i",))
    total = np.bincount(sky.clumps["group"], sky.clumps["flux_VIS"], len(sky.truth["y"]))
    assert (total <= 0.7 * sky.truth["flux_VIS"]).all() and total.max() > 0
    assert set(sky.truth["kind"][np.unique(sky.clumps["group"])]) == {"galaxy"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sky": "blue"}, "sky is 'blue', must be one of plain, real, bright"),
        ({"sky": "plain", "spoilers": Spoilers()}, "spoilers change nothing of a plain sky"),
        ({"sky": "plain", "n_large": 1}, "n_large is 1, must be 0 or more: pass it with"),
    ],
)
def test_bad_input_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        field(**options)


def test_scenes_take_galaxies_of_a_real_sky():
    plain, real = (simulate_scene(4, n_sources=2, sky=sky) for sky in ("plain", "real"))
    np.testing.assert_array_equal(plain.positions_arcsec, real.positions_arcsec)
    np.testing.assert_array_equal(plain.euclid.counts, real.euclid.counts)
    assert not np.allclose(plain.euclid.truth, real.euclid.truth, atol=1e-3)
    with pytest.raises(ValueError, match='sky is \'dark\', must be "plain", or "real"'):
        simulate_scene(4, sky="dark")
