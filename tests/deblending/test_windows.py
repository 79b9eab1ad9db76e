"""Large scenes in windows, on builds for CPUs and for GPUs.

They are compared with the operator on composed frames and pass the dot test, with shifts and in
parts; their selection is tested too.
"""

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, affine, operator, psfs, turn
from helpers.scene_operators import MorphologyOperator, SpectraOperator
from helpers.solver import every_type, posed
from test_rendering import KINDS, SCENES, buffers_of, operator_of, pairs_of

from clresample.deblending.solver.gradient import LossGradient
from clresample.deblending.solver.rendering import stage_selection
from clresample.deblending.solver.rendering.windows import WindowGroups, WindowRendering
from clresample.deblending.solver.scene_model import compose
from clresample.device.program import LaunchList
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint

NAMES = "mirrored", "crossed", "30 degrees"
every_geometry = pytest.mark.parametrize("name", NAMES)
# Frames and windows have periods of their own, and what the kernel holds beyond the wrap radius
# comes in again elsewhere: with these PSFs up to 5e-6 of an image's peak, in either precision.
CLOSE = 1e-5


def in_windows(kind, pairs, device, dtype, parts=None):
    """The operator of scenes rendered in windows, in one part or in the Groups given."""
    b = buffers_of(pairs, device, dtype)
    op = operator_of(b.scenes)
    if parts is None:
        return kind(b, op, stage_selection.select_rendering(b, 0, op, 3))
    groups = [WindowGroups(b.host_boxes, np.array(which), (16, 13)) for which in parts]
    return kind(b, op, WindowRendering(b, 0, op, groups, stage_selection._in_frames))


def away(op, pairs, device):
    """Largest difference, over the largest value, from the operators on composed frames.

    Pixels that these do not cover are left out.
    """
    b = op.buffers
    found = op.forward(device.get(b.morph if isinstance(op, MorphologyOperator) else b.spectra))
    worst = 0.0
    for seen, (scene, state) in zip(found, pairs, strict=True):
        model = compose(scene.shape, scene.origin, state.morph, state.spectra)
        wanted = scene.ops[0].forward(model.astype(seen.dtype))
        off = (seen - wanted) * scene.ops[0].covered
        worst = max(worst, np.abs(off).max() / np.abs(wanted).max())
    return worst


@every_geometry
@every_type
def test_windows_are_the_operator_on_the_composed_frame(build, name, dtype):
    if dtype == np.float64 and not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    pairs = pairs_of(build, GEOMETRIES[name](), dtype)
    for kind in KINDS:
        assert away(in_windows(kind, pairs, build, dtype), pairs, build) < CLOSE


@every_geometry
def test_adjoints_pass_the_dot_test(build, name):
    pairs = pairs_of(build, GEOMETRIES[name](), np.float32)
    for kind in KINDS:
        check_adjoint(in_windows(kind, pairs, build, np.float32), np.random.default_rng(0))


@every_geometry
def test_parts_add_up(build, name):
    """Sources with windows of their own, in two parts: the same image, and adjoints of it."""
    pairs = pairs_of(build, GEOMETRIES[name](), np.float32)
    n = sum(map(len, SCENES))
    parts = [i for i in range(n) if i % 3], list(range(0, n, 3))
    for kind in KINDS:
        op = in_windows(kind, pairs, build, np.float32, parts)
        assert away(op, pairs, build) < CLOSE
        check_adjoint(op, np.random.default_rng(0))


def test_windows_follow_shifts(device):
    """Of several observed pixels too, which move the windows themselves."""
    pairs = pairs_of(device, GEOMETRIES["30 degrees"](), np.float32)
    op = in_windows(MorphologyOperator, pairs, device, np.float32)
    for shift in ((0.4, -0.3), (5.2, 3.9)):
        pairs[0][0].ops[0].shift = shift
        assert away(op, pairs, device) > 1e-2
        op.rendering.update_shifts()
        assert away(op, pairs, device) < CLOSE


def test_a_window_at_the_wrong_place_is_found(device):
    pairs = pairs_of(device, GEOMETRIES["mirrored"](), np.float32)
    op = in_windows(SpectraOperator, pairs, device, np.float32)
    part = op.rendering.parts[0]
    device.upload((part.seen_by.low + [0, 1]).astype(np.int32), part._low)
    assert away(op, pairs, device) > 1e-2


@every_geometry
def test_gradients_are_those_of_frames(build, name):
    """Of the free sources, also of repeated launches; fixed ones stay as they were."""
    if not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    pairs, found = pairs_of(build, GEOMETRIES[name](), np.float64), []
    for depth in (0, 3):
        b = buffers_of(pairs, build, np.float64)
        gradient, spectra = LossGradient(b, depth=depth), build.get(b.spectra)
        queue = LaunchList(build, gradient.queue) if depth else gradient.queue
        for factor in (2, 1):
            build.upload(factor * spectra, b.spectra)
            queue()
        arrays = b.d_morph, b.d_spectra, gradient.rows_loss, gradient.rows_pull
        found.append([build.get(array) for array in arrays])
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())


def test_large_fields_of_small_sources_are_chosen(device):
    """Not small ones, nor scenes with operators of their own."""
    narrow, wide = psfs()[0], PSF.gaussian([1.0, 1.1], n_pixels=21)
    side, chosen = 400, []
    places = np.random.default_rng(0).integers(0, side - 24, (40, 2))
    for n, n_ops in ((40, 1), (40, 2), (2, 1)):
        shape = (side, side) if n == 40 else (40, 40)
        boxes = [(*(at if n == 40 else (5, 5)), 24, 24) for at in places[:n].tolist()]
        mapping = affine(turn(20, 2.0), shape, tuple(s // 2 for s in shape))
        ops = [operator(device, mapping, narrow, wide, np.float32) for _ in range(n_ops)]
        pairs = [_scene(device, op, shape, boxes) for op in ops]
        b = buffers_of(pairs, device, np.float32)
        chosen.append(stage_selection.select_rendering(b, 0, operator_of(b.scenes)).depth == 3)
    assert chosen == [True, False, False]


def _scene(device, op, shape, boxes):
    return posed(
        device,
        np.float32,
        boxes=boxes,
        shape=shape,
        unpadded_shape=shape,
        ops=[op],
        data=[np.zeros(op.shape_out)],
        weights=[np.ones(op.shape_out) * op.covered],
        spectra=np.ones((len(boxes), 2)),
        sky=np.zeros(2),
    )
