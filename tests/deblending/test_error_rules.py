"""Parts of errors: pixels along the model's axes, and sums over modes and spectra."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.linear import aligned_observation as module
from clresample.deblending.linear.aligned_observation import (
    AlignedObservation,
    BandLimitedTransfer,
)
from clresample.deblending.linear.block_matrix import BlockMatrix
from clresample.deblending.linear.normal import UnknownLayout
from clresample.deblending.posterior import posterior as posterior_module
from clresample.deblending.posterior.posterior import FAR_ERROR, Posterior
from clresample.deblending.result import Component
from clresample.deblending.settings import Settings
from clresample.measurement.shapes import moments
from clresample.paper.settings import PaperSettings
from clresample.sky.psf import PSF


def exposure(y, x, reach):
    return AlignedObservation(np.array(y, float), np.array(x, float), None, reach, None, None)


def test_a_window_holds_the_pixels_within_reach():
    """Of a box of 3 x 2 pixels that starts at (4, 5): rows from 2 to 8 at a reach of 2."""
    one = exposure(range(20), np.arange(0, 20, 0.5), 2.0)
    assert one.window((4, 5), (3, 2)).tolist() == [[2, 6], [8, 16]]
    assert exposure(range(20), range(20), 2.25).window((4, 5), (3, 2)).tolist() == [[2, 3], [9, 9]]
    low, high = one.window((30, 5), (3, 2))
    assert low[0] == high[0] == 20  # none


def test_few_modes_at_a_time_are_seen_as_all_at_once(monkeypatch):
    """Also where the last ones are fewer, and each with its channel's root weights; and by several
    threads."""
    psf, rng = PSF.gaussian(1.2, n_pixels=25), np.random.default_rng(3)
    root, images = rng.uniform(1, 2, (1, 9, 11)), rng.standard_normal((5, 7, 8))
    place = np.arange(9) * 2.0, np.arange(11) * 2.0
    one = AlignedObservation(
        *place, root.astype("f4"), 4.0, BandLimitedTransfer(2.0 * np.eye(2), psf, psf), None
    )
    found = []
    for size in (1, 2 * one.transfer.at((7, 8), 4.0)[2].size, 1 << 30):
        monkeypatch.setattr(module, "CACHED", size)
        found.append(one.observe(images.astype("f4"), 0, np.array([3, 4]), (1, 2), (9, 10)))
    assert found[0].shape == (1, 5, 8, 8) and np.abs(found[0]).max() > 0.1
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-5)
    monkeypatch.setattr(module, "CACHED", 1)
    monkeypatch.setattr(module, "MIN_THREADED_ELEMENTS", 1)
    shared = replace(one, n_threads=3)
    again = shared.observe(images.astype("f4"), 0, np.array([3, 4]), (1, 2), (9, 10))
    np.testing.assert_array_equal(again, found[0])


def test_exposures_are_those_of_views_as_they_are(monkeypatch):
    """Of each observation with its own view; sources and shifts may be others at any time."""
    monkeypatch.setattr(module.AlignedObservation, "of", lambda *given: given)
    blend, start = SimpleNamespace(observations=(1, 2)), SimpleNamespace(source=np.array([0, 2]))
    fit = SimpleNamespace(views=("a", "b"), blend=blend, start=start, frame="frame")
    found = module.align_observations(fit)
    assert found == [("a", "frame", 1, start.source), ("b", "frame", 2, start.source)]


def seen_as(monkeypatch, view, pixel):
    """Rows, columns, root weights of a view's AlignedObservation, whose band asks for pixels of
    `pixel`."""
    psf = PSF.gaussian(1.0, n_pixels=15)
    view.coefficients, view.op.plans = None, [SimpleNamespace(psfs=(psf, psf))]
    view.op.device = "device"
    monkeypatch.setattr(module, "host_threads", {"device": 5}.get)
    monkeypatch.setattr(module, "_transfer", lambda *_: SimpleNamespace(nyquist_px=pixel))
    observation = SimpleNamespace(psf=psf)
    made = AlignedObservation.of(view, SimpleNamespace(psf=psf), observation, np.zeros(1, int))
    scale = np.sqrt(abs(np.linalg.det(view.mapping.matrix)))
    assert made.reach_px == pytest.approx(1.5 * psf.fwhm_px.max() * scale)
    few, many = (np.empty((n, 1 << 10)) for n in (1 << 10, (1 << 10) + 1))
    assert (made.threads_for(few), made.threads_for(many)) == (1, 5)
    return made.y, made.x, made.sqrt_weights


@pytest.mark.parametrize(
    "matrix", [((2, 0), (0, 1)), ((-2, 0), (0, 1)), ((0, 2), (-1, 0)), ((0, -2), (-1, 0))]
)
def test_parallel_pixels_keep_their_weights(monkeypatch, matrix):
    """Turned and mirrored: rows and columns of the model, ascending."""
    matrix = np.array(matrix, float)
    root = np.arange(24.0).reshape(2, 3, 4)
    offset, shift = np.array([20.0, 30.0]), np.array([0.25, -0.5])
    mapping = SimpleNamespace(matrix=matrix, offset=offset, geometry="aligned")
    view = SimpleNamespace(mapping=mapping, sqrt_weights=root, op=SimpleNamespace(shift=shift))
    y, x, found = seen_as(monkeypatch, view, 0.5)
    assert (np.diff(y) > 0).all() and (np.diff(x) > 0).all()
    for n in range(3):
        for m in range(4):
            place = matrix @ (n, m) + offset + shift
            i, j = np.argmin(np.abs(y - place[0])), np.argmin(np.abs(x - place[1]))
            np.testing.assert_allclose((y[i], x[j]), place)
            np.testing.assert_array_equal(found[:, i, j], root[:, n, m])


def test_weights_spread_over_the_model_keep_their_density(monkeypatch):
    """Of even weights turned by 30 degrees: what two pixels of noise 1 say, one of theirs does."""
    c, s = 0.8 * np.cos(np.pi / 6), 0.8 * np.sin(np.pi / 6)
    matrix = np.array([[c, -s], [s, c]])
    n, shift = 60, np.array([2.3, -1.7])

    class Mapping:
        area, shape_in, shape_out, geometry = None, (24, 26), (n, n), "affine"

        def __init__(self):
            self.matrix = matrix

        def at(self, a, b):
            away = np.stack([a - n / 2, b - n / 2], axis=-1)
            return away @ matrix.T + [12, 13] - shift

    view = SimpleNamespace(
        mapping=Mapping(),
        covered=np.ones((n, n), bool),
        sqrt_weights=np.full((1, n, n), 3.0),
        op=SimpleNamespace(shift=shift),
    )
    y, x, root = seen_as(monkeypatch, view, 0.8)
    np.testing.assert_allclose(np.diff(y), 0.8)
    np.testing.assert_allclose([y[0], x[0]], -0.8)
    assert y[-1] >= 24 and x[-1] >= 26
    np.testing.assert_allclose(root[0, 4:-4, 4:-4], 3, rtol=1e-5)  # of the frame all is seen
    half = view.sqrt_weights.copy()
    n_y, m = np.indices((n, n))
    half[0][view.mapping.at(n_y, m)[..., 0] + shift[0] < 12] = 0
    y, _, root = seen_as(monkeypatch, SimpleNamespace(**{**vars(view), "sqrt_weights": half}), 0.8)
    assert root[0, y < 10.5, 5:-5].max() == 0 and root[0, (y > 13.5) & (y < 22), 5:-5].min() > 2.9


def test_periods_hold_a_box_and_what_its_light_reaches():
    """Multiples of 8 px, and one; frequencies of half a plane, counted twice but for row 0."""
    psf = PSF.gaussian(1.2, n_pixels=25)
    transfer = BandLimitedTransfer(2.0 * np.eye(2), psf, psf)
    nu_y, nu_x, d = transfer.at((11, 13), 4.0)
    assert nu_y[1] == pytest.approx(1 / 25) and nu_x[len(nu_x) // 2 + 1] == pytest.approx(1 / 25)
    assert transfer.at((17, 17), 4.0)[0][1] == pytest.approx(1 / 33)
    assert transfer.at((16, 17), 4.0)[0][1] == pytest.approx(1 / 25)
    middle = len(nu_x) // 2
    assert nu_y[0] == 0 and nu_x[middle] == 0 and len(nu_x) % 2
    # at frequency 0 all light of one pixel, 4 of the model's, over the period's square
    assert d[0, 0, middle].real == pytest.approx(4 / 25**2, rel=1e-4)
    assert np.abs(d[1, 0, middle]) > 1.2 * d[0, 0, middle].real
    assert transfer.at((11, 13), 4.0)[2] is d  # kept


def test_errors_at_fixed_morphologies_are_those_of_the_normal_matrix(monkeypatch):
    """And no less than float64's rounding of the spectrum, 1e-9 of it."""
    made = []
    monkeypatch.setattr(posterior_module, "Posterior", lambda s, *_a, **_k: made.append(s))
    monkeypatch.setattr(posterior_module, "local_chi2", lambda *_: np.ones(2))
    monkeypatch.setattr(posterior_module, "negative_chi2_gradient", lambda *_: [])
    covariance = np.array([[[1e-8, 5.0], [5.0, 4.0]], [[0.0, 0], [0, -1e-20]]])
    spectra = np.array([[3.0, 3.0], [1e6, 0.0]])
    start = SimpleNamespace(source=np.array([0, 1]), shapes=0, thetas=0, positions=np.eye(2))
    scene = SimpleNamespace(channels=lambda: [], ties=None)
    fit = SimpleNamespace(
        settings=Settings(), scene=scene, strength_estimates=1, views=[], start=start, frame=None
    )
    fit.blend = SimpleNamespace(observations=[])
    seen = SimpleNamespace(
        spectra=spectra, covariance=covariance, observed=(), residuals=lambda *_: [], held=0
    )
    _, messages = posterior_module.posterior_of(fit, [], np.ones(2), seen)
    assert messages == []
    wanted = [[1e-4, 3e-9], [2.0, 1e-150]]
    np.testing.assert_allclose(made[0].fixed_error, wanted)
    assert posterior_module.posterior_of(
        SimpleNamespace(settings=PaperSettings(), scene=None, strength_estimates=None),
        [],
        0,
        seen,
    ) == (None, [])


def made_up(rng, *, fixed=(), n_common=2):
    """A Posterior of three components, two of source 1, in two channels, of random numbers, and its
    covariance of all unknowns."""
    sizes, counts, n_channels = [(3, 4), (4, 3), (5, 5)], np.array([2, 0, 3]), 2
    made = object.__new__(Posterior)
    made.modes = [rng.normal(size=(k, *size)) for k, size in zip(counts, sizes, strict=True)]
    made.beyond = [
        np.column_stack([np.abs(rng.normal(size=6)) + 1, rng.normal(size=(6, k))]) for k in counts
    ]
    made.layout = UnknownLayout(counts, n_channels, n_sky=n_common)
    nodes = made.layout.sizes
    root = rng.normal(size=(nodes.sum(), 3 * nodes.sum()))
    dense = root @ root.T / 100
    ends = np.cumsum([0, *nodes])
    made.covariance = BlockMatrix(nodes)
    for i in range(len(nodes)):
        for j in range(i, len(nodes)):
            made.covariance.block(i, j)[:] = dense[ends[i] : ends[i + 1], ends[j] : ends[j + 1]]
    made.inverted = []  # each time that its factor is
    made.factor = SimpleNamespace(inverse=lambda: made.inverted.append(1) or made.covariance)
    made.released = [1e-4 * rng.normal(size=k) for k in nodes]
    made.solution = SimpleNamespace(
        spectra=rng.uniform(5, 9, (3, n_channels)),
        morphs=[rng.uniform(1, 2, size) for size in sizes],
        scene=SimpleNamespace(
            origin=np.array([[2, 3], [0, 1], [4, 0]]), fixed=np.isin(np.arange(3), fixed)
        ),
        structure_excess=lambda i: 1.0 + i,
    )
    return made, dense[: ends[3], : ends[3]]


OWNER = np.array([1, 0, 1])


def shifted(made, values):
    """Morphologies, light beyond and spectra with all unknowns changed by `values`."""
    parts = np.split(values, np.cumsum(made.layout.sizes[:3])[:-1])
    out = []
    for i, part in enumerate(parts):
        k = len(made.modes[i])
        morph = made.solution.morphs[i] + np.tensordot(part[:k], made.modes[i], 1)
        far = made.beyond[i] @ np.append(1, part[:k])
        out.append((morph, far, made.solution.spectra[i] + part[k:]))
    return out


def fluxes(made, values):
    """(S, C)."""
    out = np.zeros((2, 2))
    for owner, (morph, far, spectrum) in zip(OWNER, shifted(made, values), strict=True):
        out[owner] += spectrum * (morph.sum() + far[0])
    return out


def shapes(made, values, source, weight):
    """Centroid and second moments (5,) of a source, components weighted by their light."""
    parts, light, beyond = [], [], []
    for i, (morph, far, spectrum) in enumerate(shifted(made, values)):
        if OWNER[i] == source:
            parts.append(Component(0, tuple(made.solution.scene.origin[i]), morph, spectrum))
            light.append(spectrum @ weight * morph.sum())
            beyond.append(far)
    c, q = moments(parts, np.array(light), np.array(beyond))
    return np.array([*c, q[0, 0], q[1, 0], q[1, 1]])


def slopes(function, n, step=1e-5):
    """By each of n unknowns, by central differences."""
    unit = step * np.eye(n)
    return np.array([(function(u) - function(-u)) / (2 * step) for u in unit]).T


def test_errors_follow_from_the_covariance_of_all_unknowns():
    """Fluxes, colours, shapes and maps, by finite differences; in counts; with the floor, which
    grows with the cube of a component's structure, and a part of the light beyond boxes; three
    times as large at 15 sigma."""
    made, covariance = made_up(np.random.default_rng(0))
    n, unit, wide, floor = len(covariance), np.array([10.0, 3.0]), np.array([1, 3]), 0.02
    run = OWNER, np.array([[1.0, np.nan], [15.0, 3.0]]), unit
    floors = made.floors(*run, floor)
    errors = made.errors(*run, floors)
    draws = made.draws(*run)
    by = slopes(lambda v: fluxes(made, v).ravel(), n)  # (S C, n)
    full = (by @ covariance @ by.T).reshape(2, 2, 2, 2)
    released = np.concatenate(made.released[:3])
    np.testing.assert_allclose(
        errors.flux_correction, (by @ released).reshape(2, 2) * unit, rtol=1e-6
    )
    own, beyond = np.zeros((2, 2, 2))
    for i, (morph, far, spectrum) in enumerate(shifted(made, np.zeros(n))):
        own[OWNER[i]] += floor * (1.0 + i) ** 3 * spectrum * (morph.sum() + far[0])
        beyond[OWNER[i]] += FAR_ERROR * spectrum * far[0]
    for c in range(2):
        wanted = full[:, c, :, c] * np.outer(wide, wide)
        np.testing.assert_allclose(errors.flux[c], wanted * unit[c] ** 2, rtol=1e-5)
        both = np.stack([own[:, c], beyond[:, c]]) * wide * unit[c]
        np.testing.assert_allclose(floors[:, :, c], both, rtol=1e-6)
    for s in range(2):
        wanted = full[s, :, s]
        scale = np.outer(unit, unit) * wide[s] ** 2
        np.testing.assert_allclose(errors.colour[s], wanted * scale, rtol=1e-5)
        weight = 1 / np.sqrt(np.diag(wanted) + own[s] ** 2 + beyond[s] ** 2)
        by = slopes(lambda v, s=s, w=weight: shapes(made, v, s, w), n)
        if s == 1:  # the other has no mode: nothing is known of its shape's error
            np.testing.assert_allclose(errors.moments[s], 9 * by @ covariance @ by.T, rtol=1e-4)
            np.testing.assert_allclose(errors.moment_bound_bias[s], by @ released, rtol=1e-4)
    assert np.isnan(errors.moments[0]).all() and not errors.moment_bound_bias[0].any()
    for (morph, far, _), sums in zip(shifted(made, np.zeros(n)), draws.sums, strict=True):
        assert sums[0] == pytest.approx(morph.sum() + far[0])
    ends = np.cumsum([0, *made.layout.sizes])
    assert len(errors.morphology) == 3 and not made.inverted
    for i, modes in enumerate(made.modes):
        block = covariance[ends[i] : ends[i] + len(modes), ends[i] : ends[i] + len(modes)]
        wanted = np.sqrt(np.einsum("kyx,kl,lyx->yx", modes, block, modes))
        np.testing.assert_allclose(errors.morphology[i], wide[OWNER[i]] * wanted, rtol=1e-5)
    assert len(made.inverted) == 1  # when the first one was read, for all
    np.testing.assert_array_equal(errors.outside_box_moments, [far[:, 0] for far in made.beyond])


def test_a_component_without_light_leaves_the_shape_of_its_source_known():
    made, covariance = made_up(np.random.default_rng(0))
    made.solution.spectra[np.flatnonzero(OWNER == 1)[0]] = 0
    errors = made.errors(OWNER, np.zeros((2, 2)), np.ones(2), 0.0)
    weight = 1 / np.sqrt(np.diag(errors.colour[1]))
    by = slopes(lambda v: shapes(made, v, 1, weight), len(covariance))
    np.testing.assert_allclose(errors.moments[1], by @ covariance @ by.T, rtol=1e-4)


def test_second_moments_of_stars_have_no_error_and_are_not_released():
    """Their places have, and are; a source with one free component has both."""
    for fixed, known in (((0, 2), False), ((0,), True)):
        made, _ = made_up(np.random.default_rng(1), fixed=fixed, n_common=0)
        errors = made.errors(OWNER, np.zeros((2, 2)), np.ones(2), 0.0)
        found, moved = errors.moments[1], errors.moment_bound_bias[1]
        assert np.isfinite(found[:2, :2]).all() and np.isfinite(found[2:, 2:]).all() == known
        assert np.isnan(found[:2, 2:]).all() != known
        assert (moved[:2] != 0).all() and ((moved[2:] != 0) == known).all()


@pytest.mark.parametrize("times", [1e5, 1e8])
def test_no_flux_is_corrected_by_more_than_three_errors(times):
    """However far the bounds' release moves the unknowns together."""
    made, _ = made_up(np.random.default_rng(0))
    made.released = [times * change for change in made.released]
    errors = made.errors(OWNER, np.ones((2, 2)), np.ones(2), 0.0)
    error = np.sqrt(np.einsum("css->sc", errors.flux))
    assert np.abs(errors.flux_correction / error).max() <= 3 + 1e-9
