"""Lists that leave a source out, or call a galaxy a point: flagged, errors that hold."""

import numpy as np
import pytest

from clresample.deblending.assessment.unlisted import beside_unlisted_light
from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.start import profile_start
from clresample.files.results import read_result, write_result
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.quality import summary
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource, PointSource

SHAPE, PSF_SIGMA = (64, 72), 1.6
# place [px], flux, sigma [px] of round galaxies; 0 is a point
BRIGHT, FAINT, FAR = ((30.2, 30.4), 2500.0, 1.5), ((34.0, 32.8), 500.0, 2.5), ((14, 58), 900.0, 2.0)
POINT = (*BRIGHT[:2], 0.0)


def scene(drawn, listed=None, seed=0, kinds=(ExtendedSource,) * 3):
    data = np.random.default_rng(seed).normal(size=(2, *SHAPE))
    y, x = np.indices(SHAPE)
    for place, flux, sigma in drawn:
        s2 = sigma**2 + PSF_SIGMA**2
        away = (y - place[0]) ** 2 + (x - place[1]) ** 2
        data += (
            np.array([1.0, 0.8])[:, None, None] * flux * np.exp(-away / (2 * s2)) / (2 * np.pi * s2)
        )
    psf = PSF.gaussian(PSF_SIGMA, n_bands=2, pixel=False)
    o = Observation(data, psf, Grid.flat(SHAPE, 0.2), weights=1.0, channels=["g", "r"])
    rows = zip(drawn if listed is None else listed, kinds, strict=False)
    sources = tuple(kind(position_px=place) for (place, *_), kind in rows)
    return Blend((o,), sources, model_frame([o]))


def fitted(b, device):
    return deblend(b.observations, b.sources, frame=b.frame, device=device)


def pulls(result, drawn):
    table = catalogue(result)
    flux, error = table["flux_g"].value, table["flux_err_g"].value
    return (flux - [row[1] for row in drawn]) / error, flux, error


def test_sources_that_hold_an_unlisted_ones_light_are_flagged(device, tmp_path):
    result = fitted(scene((BRIGHT, FAR, ((42, 44), 2500.0, 1.5)), listed=(BRIGHT, FAR)), device)
    assert result.unlisted and result.unlisted[0][0] == 0
    np.testing.assert_allclose(result.unlisted[0][1:], (42, 44), atol=1)
    holding = beside_unlisted_light(result)
    assert holding.any() and not summary(result)["good"]
    flags = [Flag(f) & Flag.UNLISTED for f in catalogue(result)["flags"]]
    assert [bool(f) for f in flags] == holding.tolist()
    write_result(tmp_path / "blend.fits", result)
    assert read_result(tmp_path / "blend.fits").unlisted == result.unlisted


def test_a_star_beside_an_unlisted_one_is_not_flagged(device):
    """Its model has some of the light there, which is not what is observed."""
    drawn = (POINT, FAR, ((30.2, 39.0), 2500.0, 0.0))
    result = fitted(scene(drawn, listed=drawn[:2], kinds=(PointSource, ExtendedSource)), device)
    assert result.unlisted and not beside_unlisted_light(result).any()


def test_a_whole_list_has_no_unlisted_light(device):
    drawn = (BRIGHT, FAR, ((42, 44), 2500.0, 1.5))
    result = fitted(scene(drawn), device)
    assert result.unlisted == () and not beside_unlisted_light(result).any()
    assert summary(result)["good"]


@pytest.mark.parametrize("seed", range(2))
def test_errors_hold_what_a_galaxy_listed_as_a_point_leaves_to_others(device, seed, monkeypatch):
    """Its neighbour has several times its own flux at the noise's chi2."""
    drawn = BRIGHT, FAINT, FAR
    b = scene(drawn, seed=seed, kinds=(PointSource, ExtendedSource, ExtendedSource))
    result = fitted(b, device)
    pull, flux, _ = pulls(result, drawn)
    assert flux[0] < 0.8 * BRIGHT[1] and flux[1] > 1.5 * FAINT[1]
    assert (np.abs(pull) < 3).all()
    assert any(
        "wider than the PSF, or lies elsewhere: with a galaxy in the place of source 0" in m
        for m in result.messages
    )
    monkeypatch.setattr(profile_start, "points_in_wide_light", lambda fit, galaxies: [])
    blind, same, _ = pulls(fitted(b, device), drawn)
    assert np.abs(blind[:2]).min() > 3.5
    np.testing.assert_allclose(same, flux, rtol=1e-3)  # the point stays one


def test_points_stay_unnamed(device):
    """Stars on a galaxy, beside one, bright ones; galaxies as galaxies."""
    point, extended = PointSource, ExtendedSource
    some = [scene((POINT, FAINT, FAR), seed=s, kinds=(point, extended, extended)) for s in range(3)]
    wide = (BRIGHT[0], 9000.0, 6.0)
    some += [scene((wide, (FAINT[0], 2000.0, 0.0), FAR), seed=5, kinds=(extended, point, extended))]
    some += [scene((BRIGHT, FAINT, FAR), seed=6)]
    for result in deblend_many(some, device=device):
        assert result.messages == () and summary(result)["good"]
