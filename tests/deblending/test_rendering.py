"""Scenes as linear operators, by each method of rendering, on builds for CPUs and for GPUs.

They are compared with the operator on composed frames and pass the dot test; the selection of
the method is tested too.
"""

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH, operator, psfs
from helpers.scene_operators import MorphologyOperator, SpectraOperator
from helpers.scenes import blend, fit
from helpers.solver import BOXES, CLOSE, PRIOR, changed, engine, every_type, posed

from clresample.deblending.settings import Settings
from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.gradient import LossGradient
from clresample.deblending.solver.rendering import stage_selection
from clresample.deblending.solver.rendering.stages import BoxTransformRendering
from clresample.deblending.solver.scene_model import compose
from clresample.device.program import LaunchList
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint, dense

SHAPE = 31, 26  # of the geometries' models
# Boxes (y0, x0, ny, nx) of three scenes in them: at all edges, of all of the frame, of one pixel.
SCENES = (
    ((2, 3, 11, 14), (0, 0, 9, 8), (20, 17, 11, 9)),
    ((30, 25, 1, 1),),
    ((4, 0, 7, 26), (0, 0, 31, 26), (5, 17, 9, 8), (0, 0, 9, 17)),
)
KINDS = (MorphologyOperator, SpectraOperator)
every_depth = pytest.mark.parametrize("depth", [0, 1, 2])


def pairs_of(device, mapping, dtype, *, own=False):
    """Scenes of one observation of two bands; with PSFs of their own, or the same operator."""
    narrow, wide = psfs()
    ops = [operator(device, mapping, narrow, wide, dtype)] * len(SCENES)
    if own:
        widths = (1.4, 1.9), (1.7, 1.8), (1.5, 2.2)
        ops = [operator(device, mapping, narrow, PSF.gaussian(list(w)), dtype) for w in widths]
    found = []
    for i, (boxes, op) in enumerate(zip(SCENES, ops, strict=True)):
        rng = np.random.default_rng(i)
        found.append(
            posed(
                device,
                dtype,
                boxes=boxes,
                seed=i,
                fixed=(1,) if len(boxes) > 1 else (),
                shape=SHAPE,
                unpadded_shape=SHAPE,
                ops=[op],
                data=[rng.normal(0, 3, op.shape_out)],
                weights=[rng.uniform(0.5, 1.5, op.shape_out) * op.covered],
                spectra=rng.uniform(0.5, 2, (len(boxes), 2)),
                sky=rng.normal(size=2),
            )
        )
    return found


def buffers_of(pairs, device, dtype):
    scenes, states = map(list, zip(*pairs, strict=True))
    return SceneBuffers(scenes, states, device, dtype, PRIOR)


def operator_of(scenes):
    """One operator of all scenes."""
    ops = [scene.ops[0] for scene in scenes]
    if all(op is ops[0] for op in ops):
        return ops[0]
    plans = [op.plans[0] for op in ops]
    return Resampler.from_plans(plans, dtype=ops[0].dtype, device=ops[0].device)


def scene_operator(kind, pairs, device, dtype, depth):
    b = buffers_of(pairs, device, dtype)
    op = operator_of(b.scenes)
    return kind(b, op, stage_selection.select_rendering(b, 0, op, depth))


CASES = pytest.mark.parametrize(
    "name, own", [(n, False) for n in ONE_OF_EACH] + [("crossed", True), ("30 degrees", True)]
)


@CASES
@every_depth
@every_type
def test_a_scene_is_the_operator_on_its_composed_frame(build, name, own, depth, dtype):
    """To rounding: 1e-13 in double precision."""
    if dtype == np.float64 and not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    pairs = pairs_of(build, GEOMETRIES[name](), dtype, own=own)
    for kind in KINDS:
        op = scene_operator(kind, pairs, build, dtype, depth)
        b = op.buffers
        images = op.forward(build.get(b.morph if kind is MorphologyOperator else b.spectra))
        for found, (scene, state) in zip(images, pairs, strict=True):
            model = compose(scene.shape, scene.origin, state.morph, state.spectra)
            wanted = scene.ops[0].forward(model.astype(dtype))
            scale = np.abs(wanted).max()
            atol = scale * {np.float32: 3e-6, np.float64: 1e-13}[dtype]
            np.testing.assert_allclose(found, wanted, rtol=0, atol=atol)


@CASES
@every_depth
def test_adjoints_pass_the_dot_test(build, name, own, depth):
    pairs = pairs_of(build, GEOMETRIES[name](), np.float32, own=own)
    for kind in KINDS:
        check_adjoint(
            scene_operator(kind, pairs, build, np.float32, depth), np.random.default_rng(0)
        )


@pytest.mark.parametrize("name", ["mirrored", "crossed", "30 degrees"])
def test_gradients_are_the_same_at_every_depth(build, name):
    """Of all free sources, also when their launches are repeated at other spectra.

    What is fixed, and what lies between boxes, stays as it was.
    """
    if not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    pairs, found = pairs_of(build, GEOMETRIES[name](), np.float64, own=True), []
    for depth, repeated in ((0, False), (0, True), (1, True), (2, True)):
        b = buffers_of(pairs, build, np.float64)
        gradient = LossGradient(b, depth=depth)
        queue, spectra = gradient.queue, build.get(b.spectra)
        queue = LaunchList(build, queue) if repeated else queue
        for factor in (2, 1):
            build.upload(factor * spectra, b.spectra)
            queue()  # what is added to is written first
        arrays = b.d_morph, b.d_spectra, gradient.rows_loss, gradient.rows_pull
        found.append([build.get(array) for array in arrays])
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * np.abs(a).max())


@every_type
def test_fits_are_the_same_at_every_depth(device, monkeypatch, dtype):
    """To rounding, after 20 iterations, each of which builds on those before it."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    b, found = blend(), []
    for depth in (0, 1, 2):
        counts = [float(k != depth) for k in range(3)]
        monkeypatch.setattr(stage_selection, "stage_flops", lambda *batch, counts=counts: counts)
        settings = Settings(max_iter=20)
        found.append(fit(b, device, settings=settings, dtype=dtype))
    for other in found[1:]:
        rtol = {np.float32: 1e-4, np.float64: 1e-11}[dtype]
        np.testing.assert_allclose(other.losses, found[0].losses, rtol=rtol)
        for k, o in enumerate(b.observations):
            away = (other.model(k) - found[0].model(k)) * np.sqrt(o.weights)
            assert np.abs(away).max() < {np.float32: 0.05, np.float64: 1e-8}[dtype]  # sigma


class Forgetful(MorphologyOperator):
    """Leaves out the fixed source, as the solver's own launch may: no adjoint any more."""

    def _adjoint(self, y, out):
        self.device.copy(self._zeros, out)
        self.rendering.back_project(y[0])
        self.rendering.gather_morph(self.buffers.spectra, out, self.buffers.free)


class Doubled(MorphologyOperator):
    """Adds its answer twice."""

    def _adjoint(self, y, out):
        super()._adjoint(y, out)
        b = self.buffers
        self.rendering.gather_morph(b.spectra, out, b.boxes.everyone, add=True)


class Stale(SpectraOperator):
    """Takes morphologies of before."""

    def _adjoint(self, y, out):
        self.buffers.morph, kept = self.buffers.amplitude, self.buffers.morph
        super()._adjoint(y, out)
        self.buffers.morph = kept


class Shifted(SpectraOperator):
    """Gathers from the bands of another observation."""

    def _adjoint(self, y, out):
        self.rendering._composition._spectra.bind(channel=1)
        super()._adjoint(y, out)


@every_depth
@pytest.mark.parametrize("kind", [Forgetful, Doubled, Stale, Shifted])
def test_the_dot_test_finds_a_broken_adjoint(device, kind, depth):
    pairs = pairs_of(device, GEOMETRIES["30 degrees"](), np.float32)
    with pytest.raises(AssertionError, match=r"of \|Ax\|\|y\|"):
        check_adjoint(
            scene_operator(kind, pairs, device, np.float32, depth), np.random.default_rng(0)
        )


def test_a_product_of_a_wrong_size_is_found(device, monkeypatch):
    """The oracle sees a box that is one column too narrow on its way to frequencies."""
    made = BoxTransformRendering.__init__

    def narrow(self, *arguments):
        made(self, *arguments)
        self._boxes._columns = self._boxes._columns - 1

    monkeypatch.setattr(BoxTransformRendering, "__init__", narrow)
    pairs = pairs_of(device, GEOMETRIES["mirrored"](), np.float32)
    op = scene_operator(MorphologyOperator, pairs, device, np.float32, 2)
    scene, state = pairs[0]
    model = compose(scene.shape, scene.origin, state.morph, state.spectra)
    wanted = scene.ops[0].forward(model.astype(np.float32))
    found = op.forward(device.get(op.buffers.morph))[0]
    assert np.abs(found - wanted).max() > 1e-3 * np.abs(wanted).max()


def test_operators_are_matrices_of_the_scene(device):
    """Of one source of one pixel, column by column; a batch of items is refused."""
    scene, state = posed(device, np.float32, boxes=BOXES[3:4])
    b = engine([(scene, state)], device, np.float32).buffers
    op = SpectraOperator(b, scene.ops[1], stage_selection.select_rendering(b, 1, scene.ops[1]))
    columns = dense(op).reshape(2, -1, 3)
    y, x = BOXES[3][:2]
    pixel = np.zeros((2, *scene.shape), np.float32)
    pixel[:, y, x] = state.morph[0][0, 0]
    wanted = scene.ops[1].forward(pixel).reshape(2, -1, 1) * np.eye(3)[1:, None]
    np.testing.assert_allclose(columns, wanted, rtol=0, atol=CLOSE[np.float32] * wanted.max())
    with pytest.raises(ValueError, match="batch of 2 items is given; SpectraOperator takes one"):
        op.forward(np.zeros((2, 1, 3)))


def test_what_takes_least_is_chosen(device):
    """Few small sources are transformed one by one, many large ones as frames; an operator that
    returns its input is left alone."""
    few = pairs_of(device, GEOMETRIES["mirrored"](), np.float32)[:1]
    many = [changed(*few[0])]
    scene, state = many[0]
    n = 40
    many[0] = posed(
        device,
        np.float32,
        boxes=((0, 0, 31, 26),) * n,
        shape=SHAPE,
        unpadded_shape=SHAPE,
        ops=scene.ops,
        data=scene.data,
        weights=scene.weights,
        spectra=np.ones((n, 2)),
        sky=state.sky,
    )
    depths = []
    for pairs in (few, many):
        b = buffers_of(pairs, device, np.float32)
        op = operator_of(b.scenes)
        counts = stage_selection.stage_flops(b, op, op.executor())
        depths.append(stage_selection.select_rendering(b, 0, op).depth)
        assert counts[depths[-1]] == min(counts)
    assert depths[0] > 0
    assert depths[1] == 0
    scene, state = posed(device, np.float32)
    b = engine([(scene, state)], device, np.float32).buffers
    home = scene.ops[0]
    same = Resampler.from_mapping(
        GEOMETRIES["mirrored"]().__class__(
            scene.shape, scene.shape, np.eye(2), np.zeros(2), "aligned", 0.0
        ),
        PSF.gaussian(1.0),
        PSF.gaussian(1.0),
        device=device,
    )
    assert same.is_identity and not home.is_identity
    assert stage_selection.select_rendering(b, 0, same).depth == 0
