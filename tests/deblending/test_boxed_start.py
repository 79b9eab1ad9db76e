"""The start's normal equations, boxes and least squares, against whole frames, NumPy and scipy."""

from dataclasses import dataclass

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH, operator
from helpers.scenes import GALAXIES, SHAPE, frame, observe, sources
from helpers.start import rendered, view, views
from scipy.optimize import lsq_linear

from clresample.deblending.linear.component_batch import ComponentBatch, StartComponent, boxes_of
from clresample.deblending.linear.equations import normal_equations
from clresample.deblending.linear.linearised_scenes import linearise
from clresample.deblending.linear.slot_observation import smoothed_light
from clresample.deblending.linear.spectra import nnls_batch, spectrum_covariance
from clresample.deblending.profiles import GalaxyProfile, StarProfile
from clresample.deblending.start import profile_fit, profile_start as start_module
from clresample.deblending.start.profile_fit import ProfileFit
from clresample.deblending.start.profile_start import StartInput
from clresample.deblending.view import WhitenedView
from clresample.device.tuning import Tuning
from clresample.resampling.cache import cached_resampler
from clresample.resampling.plan import Precision
from clresample.sky.box import box_slices, intersect_boxes
from clresample.sky.psf import PSF
from clresample.sky.sources import PointSource

FLUX = (100.0, 80.0, 90.0)


def profile_fit_of(device, catalogue, observations, *, precision=None, **given):
    positions = np.array([s.position_px for s in catalogue], float)
    v = views(device, observations)
    patches = [StartInput(frame(), list(catalogue), positions, v)]
    _, components = start_module._components(patches)
    own = (precision, 0.0) if precision else (start_module.PRECISION, start_module.TOLERANCE)
    looking = linearise([v], components, *own, **given)
    noise = np.concatenate([w.pixel_noise for w in v])[None]
    return ProfileFit(looking, noise)


def test_slopes_of_chi2(device, monkeypatch):
    """By shapes and a star's place, the spectra and the sky following: -2 of the right side."""
    monkeypatch.setattr(profile_fit, "MODEL_ERROR", 0.0)  # weights that stay
    catalogue = (*sources(), PointSource(position_px=(8, 28), free_position=True))
    objects = (*GALAXIES, ((8.3, 27.8), FLUX, 0))
    fit = profile_fit_of(device, catalogue, observe(objects), fit_sky=True)
    fit.begin()
    used = np.arange(4) < fit.counts[:, None]
    scatter = 0.1 * np.random.default_rng(0).normal(size=fit.theta.shape) * used
    fit.theta = fit.population.mean + scatter
    every = np.arange(1)

    def chi2(theta):
        fit._look(every, theta, slopes=False)
        for _ in range(3):
            fit.looking.solve(0.0)
        return fit._chi2(every, theta)[0]

    chi2(fit.theta)
    fit._look(every, fit.theta, slopes=True)
    fit.looking.compute_residuals(0.0)
    fit._take_equations(every)
    right = fit._equations(every)[2][0]
    assert (fit.looking.spectra > 0).all()  # no spectrum is held at zero
    step = 1e-4
    for i, unit in enumerate(step * np.eye(used.size).reshape(-1, *used.shape)):
        if unit[~used].any():
            continue
        slope = (chi2(fit.theta + unit) - chi2(fit.theta - unit)) / (2 * step)
        assert slope == pytest.approx(-2 * right[i], rel=1e-5), i


def test_held_profiles_have_no_slopes_and_leave_those_of_others(device):
    """In whatever place: the equations of what moves are as if all moved."""
    star = PointSource(position_px=(8, 28), free_position=True)
    observations = observe((*GALAXIES, ((8.3, 27.8), FLUX, 0)))
    fit = profile_fit_of(device, (*sources(), star), observations, fit_sky=True)
    fit.begin()
    fit._take(np.arange(1))  # in the boxes of their light
    whole, right = fit.normal[0], fit.right[0].copy()
    for held in ([0], [1, 2]):
        fit.moves[0] = ~np.isin(np.arange(fit.moves.shape[1]), held)
        fit._take(np.arange(1))
        moves = np.repeat(fit.moves[0], 4)
        slots = fit.looking.slots
        drawn = dict(zip(fit.looking.at.tolist(), slots.n_images.tolist(), strict=True))
        assert all((drawn[i] == 1) == (i in held) for i in drawn)
        assert not fit.normal[0][~moves].any() and not fit.right[0][~moves].any()
        scale = np.abs(np.diagonal(whole)[moves])
        change = fit.normal[0][np.ix_(moves, moves)] - whole[np.ix_(moves, moves)]
        assert np.all(np.abs(change) <= 1e-4 * np.sqrt(scale[:, None] * scale))
        np.testing.assert_allclose(
            fit.right[0][moves], right[moves], atol=1e-3 * np.sqrt(scale.max())
        )


@pytest.mark.parametrize("angle", [0, 25, 90])
@pytest.mark.parametrize("fit_sky", [False, True])
def test_normal_matrices_are_those_of_whole_frames(device, angle, fit_sky):
    """Of boxes and windows: as images over the frame give them by NumPy, in float64."""
    catalogue = (*sources(), PointSource(position_px=(8.4, 27), free_position=True))
    observations = observe((*GALAXIES, ((8.3, 26.8), FLUX, 0)), angle=angle)
    precision = Precision.of(np.float64)
    fit = profile_fit_of(device, catalogue, observations, precision=precision, fit_sky=fit_sky)
    fit.begin()
    fit._measure_brightness(fit.theta)
    looking, v = fit.looking, [s.views[0] for s in fit.looking.sights]
    fit._look(np.arange(1), fit.theta, slopes=True)
    assert (looking.slots.size < SHAPE).all(axis=1).any()
    looking.compute_residuals(profile_fit.MODEL_ERROR)
    normal, right = normal_equations(looking)
    whole = [c.shape.draw(t, c.position) for c, t in zip(looking.components, fit.thetas())]
    for images, i in zip(whole, np.argsort(looking.at), strict=True):
        inside = np.zeros(SHAPE, bool)
        inside[box_slices(looking.slots.origin[i], looking.slots.size[i])] = True
        images[:, ~inside] = 0
    wanted, towards = reference(whole, v, looking, fit_sky)
    own = np.flatnonzero((np.arange(4) < fit.counts[:, None]).ravel())
    scale = np.sqrt(np.diag(wanted))
    found = normal[0][np.ix_(own, own)] / scale[:, None] / scale
    wanted = wanted / scale[:, None] / scale
    np.testing.assert_allclose(found[:8, :8], wanted[:8, :8], atol=3e-4)
    np.testing.assert_allclose(found, wanted, atol=3e-3)  # where a box ends, rings of the star do
    away = np.abs(right[0][own] - towards) / scale
    assert away.max() < 2e-3 * np.abs(towards / scale).max()
    looking.solve(0.0)
    heads = [rendered(w, np.array([images[0] for images in whole])) for w in v]
    channel = 0
    for unit in heads:
        for c in range(unit.shape[1]):
            gram = unit[:, c] @ unit[:, c].T
            size = np.sqrt(np.diag(gram))
            away = looking.normal[0, channel, :3, :3] - gram
            assert np.abs(away / size[:, None] / size).max() < 1e-4
            channel += 1


def reference(whole, v, looking, fit_sky):
    """Normal matrix and right side of all parameters, spectra eliminated, by whole frames."""
    sizes = [len(images) for images in whole]
    heads = np.cumsum([0, *sizes])[:-1]
    slopes = np.setdiff1d(np.arange(sum(sizes)), heads)
    owner = np.repeat(np.arange(len(whole)), np.array(sizes) - 1)
    matrix, side, channel = 0.0, 0.0, 0
    for w in v:
        seen = rendered(w, np.concatenate(whole))
        for c in range(seen.shape[1]):
            a, root = looking.spectra[:, channel], w.sqrt_weights[c].ravel()
            model = a @ seen[heads, c] + looking.sky[0, channel] * root
            light = smoothed_light(w)[c].ravel() - looking.sky[0, channel] * root
            weight = 1 / (1 + (profile_fit.MODEL_ERROR * light) ** 2)
            rest = w.data[c].ravel() * root - model
            columns = a[owner, None] * seen[slopes, c]
            lit = np.concatenate([seen[heads, c][a > 0], root[None][: int(fit_sky)]])
            inner = (lit * weight) @ lit.T
            spectra = np.arange(len(lit)) < len(lit) - fit_sky
            inner += 1e-8 * np.trace(inner[np.ix_(spectra, spectra)]) * np.diag(spectra)
            cross = (lit * weight) @ columns.T
            solved = np.linalg.solve(inner, cross)
            matrix = matrix + (columns * weight) @ columns.T - cross.T @ solved
            side = side + (columns * weight) @ rest - solved.T @ ((lit * weight) @ rest)
            channel += 1
    return matrix, side


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.61)])
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_windows_show_what_the_whole_operator_shows(device, name, shift):
    """Of every geometry: images in boxes, as the operator of the whole frame renders them."""
    mapping, dtype = GEOMETRIES[name](), np.float64 if device.has_fp64 else np.float32
    psf_in, psf_out = PSF.gaussian(1.3, n_pixels=15), PSF.gaussian([1.4, 1.5], n_pixels=21)
    op = operator(device, mapping, psf_in, psf_out, dtype)
    op.shift = shift
    rng, shape = np.random.default_rng(0), op.shape_out
    v = [view_of(op, np.ones(shape), rng.normal(size=shape))]
    home = Home(mapping.shape_in, psf_in)
    places = np.array([(0.4, 0.45), (0.7, 0.3)]) * mapping.shape_in
    components = [
        StartComponent(0, i, i, StarProfile(home, free=True), p, home.shape)
        for i, p in enumerate(places)
    ]
    looking = linearise([v], components, Precision.of(dtype), 0.0, fit_sky=False)
    thetas = [np.zeros(2)] * 2
    looking.render([0], thetas, np.full(2, 1.0), slopes=True, whiten=False)
    (sight,) = looking.sights
    assert (looking.slots.size < home.shape).any()
    seen = device.get(sight.seen)
    for row, i in enumerate(looking.at):
        _, y0, x0, wy, wx, n, begin = sight.place[row]
        found = seen[begin : begin + n * sight.n_bands * wy * wx].reshape(n, -1, wy, wx)
        box = box_slices(looking.slots.origin[row], looking.slots.size[row])
        images = np.zeros((n, *home.shape))
        images[:, *box] = components[i].shape.draw(thetas[i], places[i])[:, *box]
        wanted = op.render(images.astype(dtype))
        inside, there = intersect_boxes((0, 0), shape[1:], (y0, x0), (wy, wx))
        whole = np.zeros_like(wanted)
        whole[:, :, *inside] = found[:, :, *there]
        away = np.abs(np.where(op.covered, whole - wanted, 0)).max(axis=(1, 2, 3))
        assert (away < 1e-3 * np.abs(wanted).max(axis=(1, 2, 3))).all()


def view_of(op, root, data):
    return WhitenedView(op, op.mapping, op.covered, np.ones(len(data)), root, data)


@dataclass(frozen=True)
class Home:
    """Of a Frame, what a StarProfile takes."""

    shape: tuple
    psf: PSF


@pytest.mark.parametrize("n_scenes", [1, 2])
def test_work_and_memory_are_linear_in_the_sources(device, n_scenes):
    """Counted: elements that are drawn and seen, pixels of products. Fields of equal density."""
    counts = []
    for n in (2, 4, 8):  # tiles a side of a field
        shape = 40 * n, 40 * n
        places = [(20.0 + 40 * i, 22.0 + 40 * j) for i in range(n) for j in range(n)]
        objects = [(place, FLUX, 1.5) for place in places]
        home = frame(shape)
        seen = observe((), shape=shape, angle=12)
        patches = []
        for _ in range(n_scenes):
            v = []
            for o in seen:
                op = cached_resampler(home, o.grid, o.psf, dtype=np.float32, device=device)
                v.append(view(op, o))
            patches.append(StartInput(home, list(sources(objects)), np.array(places), v))
        _, components = start_module._components(patches)
        own = start_module.PRECISION, start_module.TOLERANCE
        looking = linearise([p.views for p in patches], components, *own, fit_sky=False)
        thetas = [c.shape.mean for c in components]
        looking.render(np.arange(n_scenes), thetas, np.full(len(thetas), 30.0), slopes=True)
        elements = [looking.slots.n_elements] + [s.n_elements for s in looking.sights]
        products = [s.n_pixels for s in looking.sights]
        counts.append(np.array(elements + products) / len(components))
    # sources at an edge are seen in part: fewer pixels of products
    assert (counts[1] <= 1.5 * counts[0]).all() and (counts[2] <= 1.25 * counts[1]).all()
    np.testing.assert_allclose(counts[1][:3], counts[2][:3], rtol=0.02)


def test_many_least_squares_at_once():
    """As scipy's bounded ones; some with columns that are equal, or 0."""
    rng, n = np.random.default_rng(1), 7
    rows = rng.normal(size=(40, n, 12)) + 0.5
    rows[3, 2] = rows[3, 1]
    rows[5, 4] = 0
    target = rng.normal(size=(40, 12)) + 0.3 * rows.sum(axis=1)
    found = nnls_batch(rows @ rows.swapaxes(1, 2), np.einsum("mip,mp->mi", rows, target))
    assert (found >= 0).all()
    for x, a, d in zip(found, rows, target, strict=True):
        best = lsq_linear(a.T, d, (0, np.inf), tol=1e-14).x
        rest, least = (np.sum((y @ a - d) ** 2) for y in (x, best))
        assert rest < least * (1 + 1e-6) + 1e-9
    assert found[5, 4] == 0 and np.isinf(spectrum_covariance(rows[5] @ rows[5].T)[4, 4])
    np.testing.assert_allclose(found[3, 1], found[3, 2], rtol=1e-4)


def test_galaxies_in_boxes_of_other_sizes_are_drawn_together(device):
    home, place = frame((70, 60)), np.array([33.2, 29.6])
    thetas = [np.array([np.log(size), 0.2, -0.1, np.log(5)]) for size in (0.5, 5.0)]
    chosen = [StartComponent(0, k, k, GalaxyProfile(home), place, home.shape) for k in range(2)]
    boxes = boxes_of(chosen, thetas, np.full(2, 0.01))
    slots = ComponentBatch(chosen, thetas, boxes, slopes=True)
    assert slots.size[0].max() < slots.size[1].min()
    images = device.get(slots.draw(device, np.float32, Tuning.of(device, np.float32), {}))
    for k, c in enumerate(slots.components):
        drawn = images[slots.begin[k] :][: 5 * slots.size[k].prod()].reshape(5, *slots.size[k])
        wanted = c.shape.draw(slots.thetas[k], place - slots.origin[k], tuple(slots.size[k]))
        for one, other in zip(drawn, wanted, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(other).max())
