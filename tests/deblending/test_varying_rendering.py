"""PSFs that vary from source to source: scenes as operators, each source through its own PSF."""

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH
from helpers.scene_operators import MorphologyOperator, SpectraOperator
from helpers.solver import PRIOR, every_type, posed

from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.rendering import stage_selection
from clresample.deblending.solver.scene_model import compose
from clresample.resampling import reference
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint

FRAME = 31, 26
BOXES = (
    ((2, 3, 11, 14), (0, 0, 9, 8), (20, 17, 11, 9)),
    ((4, 0, 7, 26), (0, 0, 31, 26)),
)
WIDTHS = np.array([[1.4, 1.6, 1.5], [1.9, 1.7, 2.1]])
MODEL_PSF = PSF.gaussian(0.8, n_pixels=15)
every_depth = pytest.mark.parametrize("depth", [0, 1, 2])


def batch_of(device, geometry, dtype):
    """Two scenes of one observation of two bands, three terms; buffers and their operator."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    plan = make_resampling_plan(
        GEOMETRIES[geometry](),
        MODEL_PSF,
        PSF.gaussian(WIDTHS.ravel()),
        precision=Precision.of(dtype),
        n_terms=3,
    )
    op, pairs = Resampler.from_plans([plan], dtype=dtype, device=device), []
    for i, boxes in enumerate(BOXES):
        rng, n = np.random.default_rng(i), len(boxes)
        shares = rng.normal(size=(n, 2, 3))
        given = {
            "shape": FRAME,
            "unpadded_shape": FRAME,
            "ops": [op],
            "data": [rng.normal(0, 3, op.shape_out)],
            "weights": [rng.uniform(0.5, 1.5, op.shape_out)],
            "spectra": rng.uniform(0.5, 2, (n, 2)),
            "sky": np.zeros(2),
            "coefficients": [shares],
        }
        pairs.append(posed(device, dtype, boxes=boxes, seed=i, **given))
    scenes, states = map(list, zip(*pairs, strict=True))
    return SceneBuffers(scenes, states, device, dtype, PRIOR), op, pairs


@every_type
@every_depth
@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_each_source_is_seen_through_its_own_psf(device, geometry, depth, dtype):
    b, op, pairs = batch_of(device, geometry, dtype)
    shown = MorphologyOperator(b, op, stage_selection.select_rendering(b, 0, op, depth))
    found = shown.forward(b.device.get(b.morph))
    psf = PSF.gaussian(WIDTHS.ravel())
    for (scene, state), image in zip(pairs, found, strict=True):
        wanted = 0
        for i, shares in enumerate(scene.coefficients[0]):  # source by source, in float64
            spectra = np.repeat(state.spectra[i], 3)[None]
            model = compose(FRAME, scene.origin[i : i + 1], state.morph[i : i + 1], spectra)
            n_fft = op.certificate.n_fft
            seen = reference.resample(model, op.mapping, MODEL_PSF, psf, n_fft)
            wanted = wanted + (seen.reshape(2, 3, *seen.shape[1:]) * shares[:, :, None, None]).sum(
                1
            )
        error = np.abs(image - wanted).max() / np.abs(wanted).max()
        assert error < {np.float32: 3e-6, np.float64: 1e-12}[dtype]


@every_type
@every_depth
@pytest.mark.parametrize("kind", [MorphologyOperator, SpectraOperator])
def test_gradients_are_the_adjoint(device, kind, depth, dtype):
    b, op, _ = batch_of(device, "30 degrees", dtype)
    check_adjoint(
        kind(b, op, stage_selection.select_rendering(b, 0, op, depth)),
        np.random.default_rng(1),
        tolerance={np.float32: 3e-6, np.float64: 1e-12}[dtype],
    )


def test_the_dot_test_fails_where_the_way_back_takes_other_shares(device):
    b, op, _ = batch_of(device, "30 degrees", np.float32)
    shown = MorphologyOperator(b, op, stage_selection.select_rendering(b, 0, op, 2))
    parts, right = shown.rendering._composition._parts, shown._adjoint

    def wrong(y, out):
        parts._share.bind(shares=b.put(np.ones((5, 2, 3))))
        right(y, out)

    shown._adjoint = wrong
    with pytest.raises(AssertionError, match="<Ax,y>"):
        check_adjoint(shown, np.random.default_rng(1))
