"""Single sources without their neighbours: sums, noise, errors, sizes, names, refusals."""

import numpy as np
import pytest
from astropy import units as u
from helpers import scenes
from helpers.blends import SCALE, blend, observe, round_component, two_sources

from clresample.deblending.cutouts.choice import MissingSource
from clresample.deblending.cutouts.cutout import separate
from clresample.deblending.cutouts.separation import KINDS
from clresample.files.results import read_result, write_result
from clresample.measurement.photometry import redistribute
from clresample.resampling.resampler import Resampler
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.varying_psf.field import FunctionPSF

GRID = Grid.flat((60, 70), SCALE)


@pytest.fixture(scope="module")
def made():
    """Two sources by hand on noise, with a sky and a masked pixel that holds NaN."""
    rng = np.random.default_rng(0)
    data = 3 + 0.1 * rng.normal(size=(2, 60, 70))
    data[1, 30, 33] = np.nan
    o = observe(GRID, ("g", "r"), data=data, weights=100.0, zero_points=[23.9, 26.4], name="one")
    return two_sources(observations=[o], sky=np.array([0.5, -0.5]))


@pytest.fixture(scope="module")
def fitted():
    """A blend seen by pixels turned against the model, fitted; and each source's own light."""
    device = None
    b = scenes.blend(scenes.BRIGHT, noise=0.05)
    result = scenes.fit(b, device)
    own = []
    for k, (grid, psf) in enumerate(zip(scenes.grids(), (scenes.SHARP, scenes.BLURRED))):
        part = (slice(0, 1), slice(1, 3))[k]
        op = Resampler(Grid.flat(scenes.SHAPE, 0.1), scenes.MODEL_PSF, grid, psf)
        own.append([op(scenes.truth([o])[part].astype(np.float32)) for o in scenes.BRIGHT])
    return result, own


def place(cut):
    """Slices of the image that a cutout shows."""
    y, x = -int(cut.meta["LTV2"]), -int(cut.meta["LTV1"])
    return slice(y, y + cut.shape[-2]), slice(x, x + cut.shape[-1])


def test_data_is_model_plus_residual_and_all_parts_add_up(made):
    cut = {what: made.cutout(0, "one", what) for what in KINDS}
    here = place(cut["data"])
    np.testing.assert_allclose(cut["data"].data, cut["model"].data + cut["residual"].data)
    whole = made.observations[0].data[:, *here] - np.array([0.5, -0.5])[:, None, None]
    whole[~(made.observations[0].weights[:, *here] > 0)] = np.nan
    np.testing.assert_allclose(cut["data"].data + cut["neighbours"].data, whole)
    np.testing.assert_allclose(cut["model"].data, made.source_model(0, 0)[:, *here])
    np.testing.assert_allclose(cut["neighbours"].data, made.source_model(1, 0)[:, *here])
    shares = redistribute(made, 0)[0][:, *here]
    np.testing.assert_allclose(cut["redistributed"].data, shares, rtol=1e-12)


def test_pixels_without_weight_are_masked_and_nan_where_data_are_shown(made):
    for what in KINDS:
        cut = made.cutout(0, 0, what, size=41)
        y, x = 30 - place(cut)[0].start, 33 - place(cut)[1].start
        assert cut.mask[1, y, x] and cut.mask.sum() == 1
        assert np.isnan(cut.data[1, y, x]) == (what not in ("model", "neighbours"))
        assert np.isfinite(cut.data).sum() >= cut.data.size - 1


def test_a_group_is_the_sum_of_its_members_and_has_no_neighbours_left(made):
    both = made.cutout([0, 1], "g", "model", size=61)
    alone = [made.cutout(i, "g", "model", size=(61, 201)) for i in (0, 1)]
    y, x = place(both)
    total = np.zeros((60, 70))
    for one in alone:
        rows, columns = place(one)
        image = np.pad(total, 200)[200 + rows.start : 200 + rows.stop]
        assert image.shape[0] == 61
        total += np.nan_to_num(one.data)[-rows.start :, -columns.start :][:60, :70]
    inside = np.nan_to_num(both.data)[max(-y.start, 0) :, max(-x.start, 0) :]
    expected = total[max(y.start, 0) : y.stop, max(x.start, 0) : x.stop]
    np.testing.assert_allclose(inside[: expected.shape[0], : expected.shape[1]], expected)
    assert not np.nan_to_num(made.cutout([0, 1], 0, "neighbours").data).any()


def test_an_image_has_place_unit_psf_and_noise(made):
    counts, micro = (made.cutout(1, "r", size=21, unit=unit) for unit in (None, "uJy"))
    assert counts.unit == u.ct and micro.unit == u.uJy and counts.shape == (21, 21)
    np.testing.assert_allclose(micro.data, counts.data * 10 ** (-0.4 * (26.4 - 23.9)))
    assert counts.meta["MAGZERO"] == 26.4 and "MAGZERO" not in micro.meta
    np.testing.assert_array_equal(counts.psf, made.observations[0].psf.images[1])
    y, x = (part.start for part in place(counts))
    assert (y, x) == (20, 34)
    lon, lat = counts.wcs.all_pix2world(0, 0, 0)
    np.testing.assert_allclose(GRID.to_wcs().all_pix2world(x, y, 0), (lon, lat), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        made.cutout(1, "r", "residual", size=21).uncertainty.array[5, 5], 0.1
    )
    assert made.cutout(1, 0).shape[0] == 2  # of two channels a cube


@pytest.mark.parametrize(
    ("size", "shape"),
    [
        (7, (7, 7)),
        ((5, 9), (5, 9)),
        (1.0 * u.arcsec, (10, 10)),
        ((6 * u.pix), (6, 6)),
        ((0.5 * u.arcsec, 1 * u.arcsec), (5, 10)),
    ],
)
def test_sizes_are_pixels_or_angles(made, size, shape):
    assert made.cutout(0, "g", size=size).shape == shape


def test_what_lies_beyond_the_image_is_masked():
    o = observe(GRID, ("g",), weights=1.0)
    result = blend([round_component(0, (10, 12), (1.0,))], observations=[o])
    cut = result.cutout(0, 0, "model", size=41)
    assert cut.shape == (41, 41) and place(cut)[0].start == -10
    assert np.isnan(cut.data[:10]).all() and cut.mask[:10].all() and not cut.mask[10:, 8:].any()
    np.testing.assert_allclose(cut.data[10:, 8:], result.source_model(0, 0)[0, :31, :33])


def test_a_source_outside_of_an_observation_is_refused():
    away = Grid.flat((20, 20), SCALE, center_arcsec=(30, 30))
    both = [observe(GRID, ("g",), weights=1.0), observe(away, ("r",), weights=1.0, name="far")]
    result = blend([round_component(0, (30, 30), (1.0, 1.0))], observations=both)
    for size in (None, 5):
        with pytest.raises(MissingSource, match="source 0 lies outside of observation 'far'"):
            result.cutout(0, "far", size=size)
    assert result.cutout(0, "g", size=5).shape == (5, 5)


def test_a_psf_that_varies_is_that_of_the_cutouts_middle():
    def psf(y, x):
        return PSF.gaussian(1 + 0.01 * x, n_pixels=21)

    data = np.zeros((60, 70))
    o = Observation(data, FunctionPSF(psf), GRID, weights=1.0, channels=["g"])
    result = blend([round_component(0, (30, 50), (1.0,))], observations=[o])
    cut = result.cutout(0, "g", size=11)
    np.testing.assert_allclose(cut.psf, psf(30, 50).images[0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((2, 0), "source is 2, must be a number from 0 to 1"),
        ((-1, 0), "source is -1"),
        (("a", 0), "source is 'a'"),
        (((), 0), "source is empty"),
        ((0, 1), "observation is 1, must be a number from 0 to 0"),
        ((0, "x"), "observation is 'x', .* 'one', 'g', 'r'"),
        ((0, 0, "light"), "what is 'light', must be one of 'data', 'model'"),
    ],
)
def test_names_that_are_none_are_refused(made, given, message):
    with pytest.raises(ValueError, match=message):
        made.cutout(*given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"size": 0}, "size is 0, must be one or two whole numbers"),
        ({"size": 2.5}, "size is 2.5"),
        ({"size": 3 * u.s}, "size is"),
        ({"unit": "m"}, "unit is 'm', must be None or ct"),
    ],
)
def test_sizes_and_units_that_are_none_are_refused(made, given, message):
    with pytest.raises(ValueError, match=message):
        made.cutout(0, 0, **given)


def test_a_unit_takes_zero_points():
    result = two_sources()
    with pytest.raises(ValueError, match="has no zero_points"):
        result.cutout(0, 0, unit="uJy")


def test_known_covariances_of_two_fluxes_give_the_errors_of_their_images():
    """Without draws: models right up to a factor, whose errors the normal matrix has."""
    covariance = np.tile([[0.04, -0.03], [-0.03, 0.05]], (2, 1, 1))
    parts = [round_component(0, (30, 30), (5.0, 5.0)), round_component(1, (30, 35), (4.0, 4.0))]
    result = blend(parts, observations=[observe(GRID, ("g", "r"))], covariance=covariance)
    found, (y, x) = separate(result, (0,), 0, size=21)
    a, b = (result.rendered[0][i][:, y : y + 21, x : x + 21] for i in (0, 1))
    np.testing.assert_allclose(found.variance("model"), 0.04 * a**2, atol=1e-12)
    np.testing.assert_allclose(found.variance("neighbours"), 0.05 * b**2, atol=1e-12)
    extra = np.maximum(0.06 * a * b - 0.05 * b**2, 0)
    np.testing.assert_allclose(found.variance("data"), 1 + extra, rtol=1e-9)
    assert extra.max() > 0.001


def test_without_its_neighbour_a_source_has_the_noise_of_its_own_image(fitted):
    """By true models and by the fit's; the stated error holds what the fit's add."""
    result, own = fitted
    pulls, scatter, true = [], [], []
    for i, o in enumerate(result.observations):
        sigma = o.weights**-0.5
        for s in (0, 1):
            cut = result.cutout(s, i)
            here = place(cut)
            shown = (slice(None) if cut.data.ndim == 3 else 0, *here)
            away = cut.data - own[i][s][shown]
            scatter.append((away / sigma[shown]).ravel())
            pulls.append((away / cut.uncertainty.array).ravel())
            neighbours = sum(own[i]) - own[i][s]
            true.append(((o.data - neighbours - own[i][s])[shown] / sigma[shown]).ravel())
    rms = [float(np.sqrt(np.mean(np.concatenate(v) ** 2))) for v in (true, scatter, pulls)]
    n = sum(map(len, scatter))
    assert n > 1400
    assert abs(rms[0] - 1) < 3 / np.sqrt(2 * n) + 0.01
    assert abs(rms[1] - 1) < 3 / np.sqrt(2 * n) + 0.02
    assert rms[2] < 1 + 3 / np.sqrt(2 * n)


def test_the_model_of_neighbours_adds_error_where_sources_overlap(fitted):
    result, _ = fitted
    found, _ = separate(result, (0,), 1, size=15)
    added = np.nan_to_num(found.variance("data") * found.weights - 1)
    assert added.min() >= -1e-12 and 0.02 < added.max() < 5
    overlap = np.nan_to_num(np.minimum(found.own, found.others))
    assert added[overlap > 0.5 * overlap.max()].mean() > 3 * added[overlap < 0.01].mean()


def test_a_result_from_a_file_gives_the_same_images(fitted, tmp_path):
    result, _ = fitted
    write_result(tmp_path / "result.fits", result)
    again = read_result(tmp_path / "result.fits")
    for what in KINDS:
        one, other = (r.cutout(1, "r", what, size=15) for r in (result, again))
        np.testing.assert_allclose(other.data, one.data, rtol=1e-6, atol=1e-6)
    noise = again.cutout(1, "r", "residual", size=15).uncertainty.array
    stated = again.cutout(1, "r", size=15).uncertainty.array
    assert np.nanmin(stated / noise) >= 1 - 1e-12 and np.nanmax(stated / noise) > 1.001
