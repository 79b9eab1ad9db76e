"""Copies and pickles of what users hold; blends that cannot be fitted among those that can."""

import copy
import multiprocessing
import pickle

import numpy as np
import pytest
from helpers.geometries import GEOMETRIES, ONE_OF_EACH, operator, psfs
from helpers.scenes import GALAXIES, observe

from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.blend import Blend, Failure
from clresample.deblending.result import Result
from clresample.deblending.settings import Settings
from clresample.paper.operator.resampler import PaperResampler
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.constraints import Monotone, Positivity, ProxChain
from clresample.resampling.tiled.resampler import TiledResampler
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SOURCES = tuple(ExtendedSource(position_px=position) for position, _, _ in GALAXIES)
ways = pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copied", "pickled"]
)


@ways
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("geometry", ONE_OF_EACH)
def test_operators(device, geometry, way, dtype):
    op = operator(device, GEOMETRIES[geometry](), *psfs(), dtype)
    op.shift = 0.3, -0.1
    x = np.random.default_rng(0).normal(size=op.shape_in).astype(dtype)
    truth, other = op(x), way(op)
    np.testing.assert_array_equal(other(x), truth)
    np.testing.assert_array_equal(way(op.T).adjoint(x), truth)
    assert other.device is op.device
    other.shift = 0  # a copy's shift is its own
    np.testing.assert_array_equal(op(x), truth)


@ways
@pytest.mark.parametrize("angle", [0, 20])
def test_the_papers_operator(device, way, angle):
    fine, coarse = Grid.flat((12, 13), 0.1), Grid.flat((6, 7), 0.2, angle_deg=angle)
    op = PaperResampler(fine, PSF.gaussian(0.8), coarse, PSF.gaussian(1.2), device=device)
    op.shift = 0.3, -0.1
    x = np.random.default_rng(0).normal(size=op.shape_in).astype(np.float32)
    truth, other = op(x), way(op)
    np.testing.assert_array_equal(other(x), truth)
    other.shift = 0  # a copy's shift is its own
    np.testing.assert_array_equal(op(x), truth)


@ways
def test_tiled_operators(device, way):
    op = TiledResampler(
        Grid.flat((40, 40), 0.1),
        PSF.gaussian(1.0, n_pixels=15),
        Grid.flat((20, 20), 0.2, angle_deg=10),
        PSF.gaussian(1.0, n_pixels=15),
        device=device,
        progress=False,
    )
    x = np.random.default_rng(0).normal(size=op.shape_in)
    np.testing.assert_array_equal(way(op)(x), op(x))


@ways
def test_settings_that_were_used_and_results(device, way):
    chain = ProxChain(Positivity(), Monotone())
    settings = PaperSettings(max_iter=6, prior=None, constraints=chain)
    first = deblend(observe(), SOURCES, settings=settings, device=device)
    again = deblend(observe(), SOURCES, settings=way(settings), device=device)
    np.testing.assert_array_equal(again.losses, first.losses)
    result = deblend(observe(), SOURCES, settings=Settings(max_iter=6), device=device)
    other = way(result)
    assert other.status == result.status
    np.testing.assert_array_equal(other.model(1), result.model(1))
    np.testing.assert_array_equal(other.errors.flux, result.errors.flux)
    rng = np.random.default_rng
    a, b = other.sample(1, rng(1))[0][0], result.sample(1, rng(1))[0][0]
    np.testing.assert_array_equal(a.morphology, b.morphology)


def test_an_operator_goes_to_another_process(device):
    op = operator(device, GEOMETRIES["60 degrees"](), *psfs())
    x = np.random.default_rng(0).normal(size=op.shape_in).astype(np.float32)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply_async(op.forward, (x,)).get(120), op(x))


def test_a_bad_blend_harms_no_other(device):
    good = Blend(observe(), SOURCES)
    wrong = {
        "no blend": 5,
        "sources[1] is 'here' (str), must be ExtendedSource": Blend(
            observe(), (SOURCES[0], "here")
        ),
        "observations[0] is None (NoneType), must be Observation": Blend((None,), SOURCES),
        "observations is empty": Blend((), SOURCES),
        "frame is 3 (int), must be Frame": Blend(observe(), SOURCES, frame=3),
        "shifts must be an array of real numbers": Blend(observe(), SOURCES, shifts="no"),
        "observations is None (NoneType), must be a sequence": Blend(None, SOURCES),
    }
    settings = Settings(max_iter=3)
    found = deblend_many([good, *wrong.values(), good], settings=settings, device=device)
    assert isinstance(found[0], Result) and isinstance(found[-1], Result)
    np.testing.assert_array_equal(found[0].losses, found[-1].losses)
    for failure, said in zip(found[1:-1], wrong, strict=True):
        assert isinstance(failure, Failure)
        assert failure.status == "failed"
        assert said in failure.reason or said == "no blend"


@pytest.mark.parametrize(
    "given, said",
    [
        ({"max_iter": 1.5}, "max_iter is 1.5, must be a whole number"),
        ({"max_iter": True}, "max_iter is True"),
        ({"loss_tol": np.nan}, "loss_tol is nan"),
        ({"flux_error_floor": None}, "flux_error_floor"),
        ({"fit_sky": 1}, "fit_sky is 1"),
        ({"prior": 3}, "prior is 3"),
        ({"prior": None}, "prior is None"),
    ],
)
def test_settings_of_other_types_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        Settings(**given)


@pytest.mark.parametrize(
    "given, said",
    [
        ({"observations": None}, "observations is None"),
        ({"sources": 3}, "sources is 3"),
        ({"settings": {}}, r"settings is \{\}"),
        ({"dtype": None}, "dtype is None"),
        ({"dtype": "float16"}, "dtype is 'float16'"),
        ({"dtype": "nonsense"}, "dtype is 'nonsense'"),
    ],
)
def test_deblend_refuses_other_types(device, given, said):
    with pytest.raises(ValueError, match=said):
        deblend(**({"observations": (), "sources": SOURCES, "device": device} | given))
