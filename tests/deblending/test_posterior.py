"""Errors that are the posterior's, beside dense float64 references, draws, and truth."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes
from helpers.posterior import capture, dense_error, full_matrix
from helpers.scenes import BRIGHT, blend

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.inspection.inspect import InputWarning
from clresample.deblending.linear import aligned_observation
from clresample.deblending.posterior import posterior
from clresample.deblending.posterior.moments import light_sums, moment_derivatives
from clresample.deblending.settings import Settings
from clresample.files import results as store
from clresample.files.atomic import FileError
from clresample.files.results import read_result, write_result
from clresample.measurement.catalogue import Flag, catalogue
from clresample.measurement.photometry import fluxes
from clresample.measurement.shapes import moments
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.prior import SingleScalePrior
from clresample.sky.observation import Observation
from clresample.sky.sources import ExtendedSource, PointSource

ALONE = (((14.3, 17.6), (60, 40, 80), 2.0),)
BARE = Settings(flux_error_floor=0)
PAIR = (((14.0, 12.0), (80, 50, 90), 2.0), ((15.5, 16.5), (60, 70, 50), 1.6))


def errors(result):
    """Of the fluxes (S, C)."""
    return np.sqrt(np.einsum("css->sc", fluxes(result)[1]))


@pytest.fixture(scope="module")
def fitted(device):
    return scenes.fit(blend(BRIGHT), device, settings=BARE)


def test_the_error_of_a_lone_source_is_the_dense_one(device, monkeypatch):
    """Over all pixels' structure: a few bumps reach 97 % of it, and never more."""
    kept = capture(monkeypatch)
    result = scenes.fit(blend(ALONE), device, settings=BARE)
    dense = dense_error(kept[0], 0)
    ratio = errors(result)[0] / dense
    assert (ratio < 1.005).all() and (ratio > 0.97).all()
    fixed = errors(replace(result, errors=None))[0]
    assert (errors(result)[0] > 1.1 * fixed).all()


def test_blended_sources_exchange_light(device, monkeypatch):
    shapes, given, exchanged = {}, [], posterior.exchanged_light
    monkeypatch.setattr(posterior, "doubted_shapes", lambda _: shapes)
    monkeypatch.setattr(
        posterior, "exchanged_light", lambda *own: given.append(own[2]) or exchanged(*own)
    )
    monkeypatch.setattr(posterior, "flux_changes", lambda *_: None)
    kept = capture(monkeypatch)
    result = scenes.fit(blend(PAIR), device, settings=BARE)
    assert given[0] is shapes  # light is searched for where it would be if these are wrong
    for i in (0, 1):
        ratio = errors(result)[i] / dense_error(kept[0], i)
        assert (ratio < 1.005).all() and (ratio > 0.85).all()
    correlation = result.errors.flux[0, 0, 1] / np.prod(errors(result)[:, 0])
    assert correlation < -0.5


@pytest.mark.parametrize("free", [{}, {"fit_sky": True, "fit_shifts": True}], ids=["", "free"])
@pytest.mark.parametrize("objects", [BRIGHT, PAIR], ids=["apart", "blended"])
@pytest.mark.parametrize("angle", [0, 20])
def test_the_normal_matrix_is_that_of_the_rendered_frame(device, monkeypatch, objects, free, angle):
    """By the operators, on all pixels of whole frames; turned pixels are replaced by others."""
    found, kept = [], capture(monkeypatch)
    for reach in (aligned_observation.REACH_FWHM, 100.0):
        monkeypatch.setattr(aligned_observation, "REACH_FWHM", reach)
        settings = Settings(flux_error_floor=0, **free)
        found.append(scenes.fit(blend(objects, angle=angle), device, settings=settings))
    for one, tolerance in zip(kept, (3e-2, 3e-2 if angle else 3e-3), strict=True):
        wanted = full_matrix(one)
        scale = np.sqrt(np.diag(wanted))
        scale = scale[:, None] * scale
        np.testing.assert_allclose(one.matrix / scale, wanted / scale, atol=tolerance)
    np.testing.assert_allclose(errors(found[0]), errors(found[1]), rtol=0.01)


def test_fluxes_count_what_lies_beyond_boxes(fitted):
    total = fluxes(fitted)[0] - fitted.errors.flux_correction
    for i, c in enumerate(fitted.components):
        more = 1 + fitted.errors.outside_box_moments[i, 0] / c.morphology.sum()
        assert 1 < more < 1.2
        np.testing.assert_allclose(total[i], c.flux * more)


def test_draws_scatter_as_the_errors_say(fitted):
    """But for what lies beyond the boxes, where draws end, and pixels at 0, where they stay."""
    rng, found, centroids, pixels = np.random.default_rng(0), [], [], []
    for components in fitted.sample(500, rng):
        found.append([c.flux for c in components])
        centroids.append([moments([c], [1.0])[0] for c in components])
        pixels.append(components[0].morphology)
    inverse = fitted.draws.factor.inverse()
    for i, (c, modes) in enumerate(zip(fitted.components, fitted.draws.modes, strict=True)):
        covariance, k = inverse.block(i, i), len(modes)
        modes = modes * (c.morphology > 0)
        unit = np.diag(fitted.draws.unit)
        by_unknown = [np.outer(c.spectrum, modes.sum((1, 2))), c.morphology.sum() * unit]
        rows = np.concatenate(by_unknown, axis=1)
        wanted = np.sqrt(np.diag(rows @ covariance @ rows.T))
        np.testing.assert_allclose(np.std(found, axis=0)[i], wanted, rtol=0.12)
        assert (wanted < 1.01 * errors(fitted)[i]).all() and (
            wanted > 0.8 * errors(fitted)[i]
        ).all()
        by_sums = moment_derivatives(light_sums(c.morphology[None], c.origin)[:, 0])
        rows = by_sums[:2] @ light_sums(modes, c.origin)
        wanted = np.sqrt(np.diag(rows @ covariance[:k, :k] @ rows.T))
        np.testing.assert_allclose(np.std(centroids, axis=0)[i], wanted, rtol=0.15)
    bright = fitted.components[0].morphology > 0.3
    spread = np.std(pixels, axis=0)[bright]
    np.testing.assert_allclose(spread, fitted.errors.morphology[0][bright], rtol=0.2)
    assert len(fitted.sample(0, rng)) == 0


def test_draws_of_misfitted_sources_scatter_as_the_catalogue_says(fitted, device):
    """Two pixels that no model follows, as those that a cosmic ray hits, one on each galaxy."""
    b = blend(BRIGHT)
    sharp, other = b.observations
    data = sharp.data.copy()
    data[0, 15, 14] -= 1.25
    data[0, 19, 24] += 2.0
    hit = Observation(data, sharp.psf, sharp.grid, weights=sharp.weights, channels=("v",))
    exact = replace(BARE, psf_error=0)  # draws of morphologies hold no error of the PSF
    result = deblend([hit, other], b.sources, frame=b.frame, device=device, settings=exact)
    found = {}
    for name, one in (("well fitted", fitted), ("misfitted", result)):
        table = catalogue(one)
        error = np.stack([np.asarray(table[f"flux_err_{c}"]) for c in "vgr"], axis=1)
        drawn = one.sample(500, np.random.default_rng(0))
        found[name] = np.std([[c.flux for c in parts] for parts in drawn], axis=0) / error
        flagged = table["flags"] & Flag.MISFIT != 0  # of the flux of one 2 %, of the other one 4 %
        assert flagged.tolist() == [False, name == "misfitted"]
        for column in ("max_residual_v", "misfit_sigma"):
            assert (table[column] > 9).all() == (name == "misfitted")
    np.testing.assert_allclose(found["misfitted"], found["well fitted"], rtol=0.2)
    assert (found["misfitted"] > 0.7).all() and (found["misfitted"] < 1.1).all()
    wide = deblend([hit, other], b.sources, frame=b.frame, device=device, settings=BARE)
    drawn = wide.sample_fluxes(500, np.random.default_rng(0)).std(axis=0)
    np.testing.assert_allclose(drawn / errors(wide), 1, atol=0.2)
    assert (errors(wide) / errors(result)).max() > 1.5  # by the PSF's width


def test_errors_hold_the_truth(device):
    """68 % of what is measured on 30 scenes of other noise: a smoke test, of 180 fluxes.

    They scatter by no more than the errors, which hold the prior's pull as well: of six fluxes the
    scatter of 30 is known to 13 %, its rms to 6 %.
    """
    blends = [blend(BRIGHT, seed=seed) for seed in range(30)]
    pulls = {"flux": [], "y_centroid": [], "x_centroid": []}
    found = []
    for result in deblend_many(blends, device=device):
        table = catalogue(result)
        found.append((fluxes(result)[0], errors(result)))
        truth = np.array([flux for _, flux, _ in BRIGHT])
        pulls["flux"] += ((fluxes(result)[0] - truth) / errors(result)).ravel().tolist()
        for k, name in enumerate(("y_centroid", "x_centroid")):
            where = np.array([position[k] for position, _, _ in BRIGHT])
            pulls[name] += ((table[name].value - where) / table[f"{name}_err"].value).tolist()
    for name, values in pulls.items():
        held = (np.abs(values) < 1).mean()
        assert 0.5 < held < 0.9, (name, held)
    flux, error = np.swapaxes(found, 0, 1)
    scatter = np.std(flux, axis=0) / np.sqrt(np.mean(error**2, axis=0))
    assert 0.7 < np.sqrt(np.mean(scatter**2)) < 1.2


def test_stars(device):
    """Free ones have errors of their places, others of fluxes alone."""
    objects = (((13.2, 12.1), (60, 40, 80), 0), ((16.0, 23.3), (50, 120, 100), 0), BRIGHT[0])
    objects = (*objects[:2], ((22.0, 14.0), (60, 90, 50), 1.5))
    sources = (
        PointSource(position_px=objects[0][0], free_position=True),
        PointSource(position_px=objects[1][0]),
        ExtendedSource(position_px=objects[2][0]),
    )
    b = replace(blend(objects), sources=sources)
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    table = catalogue(result)
    assert np.isfinite(table["y_centroid_err"]).tolist() == [True, False, True]
    assert np.isfinite(table["rms_size_err"]).tolist() == [False, False, True]
    assert 0.003 < table["y_centroid_err"][0].value < 0.1
    assert np.isfinite(errors(result)).all()


def test_the_floor_is_added_in_quadrature_and_leaves_colours(device, fitted, monkeypatch):
    """Times the cube of how unlike smooth profiles the sources are, found to be near 1."""
    kept = capture(monkeypatch)
    floored = scenes.fit(blend(BRIGHT), device, settings=Settings(flux_error_floor=0.01))
    flux = fluxes(fitted)[0] - fitted.errors.flux_correction
    unlike = np.array([kept[0].posterior.solution.structure_excess(i) for i in (0, 1)])
    assert ((unlike > 0.5) & (unlike < 1.5)).all()
    floor = 0.01 * unlike[:, None] ** 3 * flux
    np.testing.assert_allclose(errors(floored) ** 2, errors(fitted) ** 2 + floor**2, rtol=1e-6)
    for a, b, f in zip(fitted.errors.colour, floored.errors.colour, flux, strict=True):
        slope = np.array([1 / f[0], -1 / f[1], 0])  # of ln(f_0 / f_1)
        assert slope @ b @ slope == pytest.approx(slope @ a @ slope, rel=1e-6)
    with pytest.raises(ValueError, match="flux_error_floor"):
        Settings(flux_error_floor=-0.1)


@pytest.mark.parametrize(
    "given", [{"prior": SingleScalePrior()}, {"prior": None}, {"errors": False}], ids=str
)
def test_others_keep_errors_of_fixed_morphologies(device, given):
    kind = PaperSettings if "prior" in given else Settings
    result = scenes.fit(blend(BRIGHT), device, settings=kind(max_iter=20, **given))
    assert result.errors is None and result.draws is None
    sums = np.array([c.morphology.sum() for c in result.components])
    wanted = np.sqrt(np.einsum("css->sc", result.covariance)) * sums[:, None]
    np.testing.assert_allclose(errors(result), wanted, rtol=1e-12)
    assert np.isnan(catalogue(result)["rms_size_err"]).all()
    with pytest.raises(ValueError, match="draw"):
        result.sample(1, np.random.default_rng(0))


def test_a_channel_that_sees_nothing(device):
    """Its fluxes are unknown, which is warned about; the others' are known."""
    b = blend(BRIGHT)
    dark = b.observations[1].weights.copy()
    dark[1] = 0
    o = b.observations[1]
    changed = type(o)(o.data, o.psf, o.grid, weights=dark, channels=o.channels, name=o.name)
    with pytest.warns(
        InputWarning, match="r: no pixel of r has a weight: nothing is measured there"
    ):
        result = deblend((b.observations[0], changed), b.sources, frame=b.frame, device=device)
    assert any("no pixel of r has a weight" in line for line in result.messages)
    table = catalogue(result, magnitudes=True, groups=[0] * len(b.sources))
    drawn = result.sample_fluxes(3, 0)
    for values in (
        *(fluxes(result)[0], errors(result), *drawn),
        *(np.stack([table[f"{k}_{c}"].value for c in "vgr"], 1) for k in ("flux", "group_flux")),
    ):
        assert np.isnan(values[:, 2]).all() and np.isfinite(values[:, :2]).all()
    for name in ("flux_err_r", "group_flux_err_r"):
        assert np.isnan(table[name]).all()
    assert np.isfinite(result.errors.moments).all()


def test_drawn_fluxes_scatter_about_the_catalogues(fitted):
    flux, error = fluxes(fitted)[0], errors(fitted)
    drawn = fitted.sample_fluxes(400, 1)
    assert drawn.shape == (400, *flux.shape)
    assert (np.abs(drawn.mean(0) - flux) < 0.2 * error).all()  # 4 of its errors
    assert (np.abs(drawn.std(0) / error - 1) < 0.12).all()


def test_stored_and_read_back(fitted, tmp_path):
    write_result(tmp_path / "blend.fits", fitted)
    found = read_result(tmp_path / "blend.fits")
    for name in (
        "flux",
        "colour",
        "moments",
        "outside_box_moments",
        "flux_correction",
        "moment_bound_bias",
        "residuals",
    ):
        np.testing.assert_array_equal(getattr(found.errors, name), getattr(fitted.errors, name))
    for one, other in zip(found.errors.morphology, fitted.errors.morphology, strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(found.sample(2, 5), fitted.sample(2, 5), strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.morphology, b.morphology)
            np.testing.assert_array_equal(a.spectrum, b.spectrum)
    np.testing.assert_array_equal(found.sample_fluxes(2, 5), fitted.sample_fluxes(2, 5))
    assert (found.sample_fluxes(2, 6) != fitted.sample_fluxes(2, 5)).any()
    one, other = catalogue(found), catalogue(fitted)
    for name in other.colnames:
        np.testing.assert_array_equal(one[name], other[name])


def test_results_of_an_older_format_are_refused(fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "FORMAT", 1)
    write_result(tmp_path / "blend.fits", fitted)
    monkeypatch.undo()
    with pytest.raises(FileError, match="has format 1, this version reads 7: fit it again"):
        read_result(tmp_path / "blend.fits")
