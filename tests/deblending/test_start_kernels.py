"""The start's kernels against NumPy: profiles, windows, sums; on builds for CPUs and GPUs."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.geometries import affine, operator, turn
from helpers.scenes import frame
from helpers.solver import close, every_type
from test_boxed_start import view_of

from clresample.deblending.linear.component_batch import (
    ComponentBatch,
    StartComponent,
    listed_by_scene,
    peaks_of,
)
from clresample.deblending.linear.slot_observation import SlotObservation, smoothed_light
from clresample.deblending.profiles import GalaxyProfile
from clresample.device.tuning import Tuning
from clresample.resampling.plan import Precision
from clresample.sky.psf import PSF

SHAPE = 70, 75  # more rows than a group has work-items, and columns that 8 do not divide
# scene, first pixel and size of each slot's window, number of its images
WINDOWS = np.array(
    [
        (0, 3, 5, 66, 60, 5),
        (0, -4, -7, 20, 21, 5),
        (1, 60, 66, 30, 17, 3),
        (0, 40, 70, 33, 9, 1),
        (1, 69, 74, 1, 1, 5),
        (1, -9, 4, 90, 70, 5),
        (0, 80, 10, 5, 6, 5),
        (1, 12, -30, 8, 30, 1),
    ]
)
N_BANDS, ERROR = 2, 0.3


@every_type
@pytest.mark.parametrize("slopes", [True, False])
def test_galaxies_are_drawn_as_their_formula(build, slopes, dtype):
    """In boxes that cut them; of many widths and wings, one of them so faint that it ends."""
    if dtype == np.float64 and not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    shape, rng = GalaxyProfile(frame()), np.random.default_rng(0)
    thetas = [*rng.normal(scale=(0.4, 0.6, 0.6, 1.0), size=(4, 4)), np.array([-3.0, 0.5, 0, 4])]
    boxes = [((-3, 2), (24, 20)), ((5, 9), (13, 35)), ((0, 0), (1, 1)), ((9, 4), (40, 7))]
    boxes += [((-7, -5), (40, 44))]
    places = [np.array((12.3, 13.8)) + 0.3 * i for i in range(5)]
    components = [StartComponent(i % 2, i, i, shape, p, (60, 60)) for i, p in enumerate(places)]
    slots = ComponentBatch(components, thetas, boxes, slopes=slopes)
    images = build.get(slots.draw(build, dtype, Tuning.of(build, dtype), {}))
    for row, i in enumerate(slots.order):
        wanted = shape.draw_box(thetas[i], places[i], *boxes[i], slopes=slopes)
        begin = slots.begin[row]
        found = images[begin : begin + wanted.size].reshape(wanted.shape)
        close(found, wanted, dtype)
        near = wanted[0] > 0.1 * wanted[0].max()
        away = np.abs(found[0][near] / wanted[0][near] - 1).max()
        # of the sum q and of e^x, times the exponent ln 10, and of the sum of Gaussians
        assert i == 4 or away < 24 * np.finfo(dtype).eps
        part = found[0] / peaks_of(components, thetas)[i]
        assert (np.abs(part[part != 0]) > 1e-30).all()  # rather 0 than a denormal number
        assert i < 4 or (part == 0).any()


class Posed:
    """A Sight of two scenes whose pixels, windows and images are random numbers; in NumPy too."""

    def __init__(self, build, dtype):
        if dtype == np.float64 and not build.has_fp64:
            pytest.skip(f"{build.name} has no double precision")
        rng, mapping = np.random.default_rng(1), affine(turn(0, 1.0), SHAPE, SHAPE)
        op = operator(build, mapping, PSF.gaussian(0.8), PSF.gaussian([1.5, 2.0]), dtype)
        self.root = rng.uniform(0.5, 1.5, (2, N_BANDS, *SHAPE))
        self.root[:, :, 10:13, 7:30] = 0
        self.data = rng.normal(size=self.root.shape)
        views = [view_of(op, r, d) for r, d in zip(self.root, self.data, strict=True)]
        self.views = views
        own = build, dtype, Tuning.of(build, dtype), Precision.of(np.float32), 0.0
        self.sight = s = SlotObservation(views, slice(1, 1 + N_BANDS), *own)
        scene, low, size, n = WINDOWS[:, 0], WINDOWS[:, 1:3], WINDOWS[:, 3:5], WINDOWS[:, 5]
        sizes = n * N_BANDS * size.prod(axis=1)
        begin = np.cumsum(sizes) - sizes + 3  # anywhere
        seen = rng.normal(size=sizes.sum() + 5)
        s.place = np.column_stack([scene, low, size, n, begin])
        s.lit = s.place[:, 1:5]
        s.place_on_device = build.put(s.place.astype(np.int32))
        s.seen = build.put(seen, dtype)
        self.slots = SimpleNamespace(scene=scene, lists=self.lists)
        self.images = [
            seen[b : b + m].reshape(k, N_BANDS, *shape)
            for b, m, k, shape in zip(begin, sizes, n, size, strict=True)
        ]

    def lists(self, device, scenes):
        return [device.put(a, np.int32) for a in listed_by_scene(self.slots.scene, scenes)]

    def on_pixels(self, images, i):
        """Images (n, bands, wy, wx) of slot i over the observation, 0 where its window is not."""
        whole = np.zeros((*images.shape[:2], *(3 * np.array(SHAPE))))
        y, x = WINDOWS[i, 1:3] + SHAPE
        whole[:, :, y : y + images.shape[2], x : x + images.shape[3]] = images
        return whole[:, :, SHAPE[0] : 2 * SHAPE[0], SHAPE[1] : 2 * SHAPE[1]]


@every_type
def test_windows_are_whitened_where_there_are_pixels(build, dtype):
    p = Posed(build, dtype)
    p.sight.whiten()
    seen = build.get(p.sight.seen)
    for i, (images, place) in enumerate(zip(p.images, p.sight.place, strict=True)):
        found = seen[place[6] : place[6] + images.size].reshape(images.shape)
        wanted = p.on_pixels(images, i) * p.root[place[0]]
        close(p.on_pixels(found, i), wanted, dtype)
        assert np.count_nonzero(found) == np.count_nonzero(wanted)  # nothing beyond


@every_type
def test_residuals_weights_and_their_sums(build, dtype):
    """Of the scenes that are looked at; a slot without light in a channel adds nothing."""
    p, rng = Posed(build, dtype), np.random.default_rng(2)
    n_channels = 4
    spectra, sky = rng.normal(size=(len(WINDOWS), n_channels)), rng.normal(size=(2, n_channels))
    spectra[0, 1] = 0
    on_device = [p.sight.device.put(values, dtype) for values in (spectra, sky)]
    for scenes in (np.array([0, 1]), np.array([1])):
        sums = p.sight.compute_residuals(scenes, p.slots, *on_device, ERROR)
        residual, weight = build.get(p.sight.residual), build.get(p.sight.weight)
        for row, b in enumerate(scenes):
            model = sky[b, 1:3, None, None] * p.root[b]
            for i in np.flatnonzero(p.slots.scene == b):
                model = model + spectra[i, 1:3, None, None] * p.on_pixels(p.images[i][:1], i)[0]
            rest = p.data[b] * p.root[b] - model
            light = smoothed_light(p.views[b]) - sky[b, 1:3, None, None] * p.root[b]
            weighs = 1 / (1 + (ERROR * light) ** 2)
            close(residual[b], rest, dtype)
            close(weight[b], weighs, dtype)
            products = rest**2, rest * p.root[b], p.root[b] ** 2
            wanted = [(weighs * product).sum(axis=(1, 2)) for product in products]
            close(sums[row], np.stack(wanted, axis=-1), dtype)


@every_type
@pytest.mark.parametrize("n_images", [1, 5])
def test_products_of_windows_that_meet(build, n_images, dtype):
    """Images that a slot does not have repeat its last."""
    p, rng = Posed(build, dtype), np.random.default_rng(3)
    s = p.sight
    weight, residual = rng.uniform(size=(2, *p.root.shape))
    build.upload(weight.astype(dtype), s.weight)
    build.upload(residual.astype(dtype), s.residual)
    table, pairs = s.overlapping_pairs()
    meeting = {tuple(pair) for pair in table[:, :2].tolist()}
    lit = [p.on_pixels(np.ones_like(images), i)[0].any() for i, images in enumerate(p.images)]
    assert [i for i, on in enumerate(lit) if not on] == [6, 7]
    found, pull = s.gram(pairs, n_images), s.residual_products(n_images)
    which = np.minimum(np.arange(n_images), WINDOWS[:, 5, None] - 1)
    whole = [p.on_pixels(images, i)[which[i]] for i, images in enumerate(p.images)]
    for i, j in np.ndindex(len(whole), len(whole)):
        scene = p.slots.scene[i]
        if scene != p.slots.scene[j]:
            assert (i, j) not in meeting
            continue
        gram = np.einsum("icyx,cyx,jcyx->cij", whole[i], weight[scene], whole[j])
        if (i, j) in meeting:
            (row,) = np.flatnonzero((table[:, :2] == (i, j)).all(axis=1))
            close(found[row], gram, dtype)
        elif (j, i) not in meeting:
            assert not gram.any()
    for i, images in enumerate(whole):
        scene = p.slots.scene[i]
        other = np.stack([residual[scene], p.root[scene]])
        wanted = np.einsum("icyx,cyx,kcyx->cik", images, weight[scene], other)
        close(pull[i], wanted, dtype)
