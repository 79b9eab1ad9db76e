"""Operators with kernels as built for CPUs and for GPUs, in guarded buffers.

Buffers hold NaN until they are written, and reveal writes beyond their end.
"""

import numpy as np
import pytest
from helpers.buffers import Guards, fill_with_nan
from helpers.geometries import (
    GEOMETRIES,
    affine,
    distance,
    distorted,
    expected,
    operator,
    psfs,
    turn,
)

from clresample.paper.operator.resampler import PaperResampler
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.resampler import Resampler
from clresample.sky.psf import PSF
from clresample.testing import check_adjoint


@pytest.fixture
def builds(device, monkeypatch):
    """Runs a function of the device with each build that it takes, watching all buffers."""
    kinds = ("CPU", "GPU") if device.kind == "CPU" else (device.kind,)

    def run(check):
        for kind in kinds:
            with monkeypatch.context() as patch:
                patch.setattr(device, "kind", kind)  # what Tuning.of asks for
                fill_with_nan(patch)
                guards = Guards(patch)
                check(device)
                assert guards.overwritten() == []

    return run


def same_as_the_oracle(op, pair, seed=0):
    """Batches of two images, and the dot test; twice, as the second call meets old numbers."""
    rng = np.random.default_rng(seed)
    for _ in range(2):
        images = rng.normal(size=(2, *op.shape_in)).astype(np.float32)
        assert distance(op(images), expected(op, images, *pair)) < 2e-6
    check_adjoint(op, rng, batch=(2,))
    if op.n_terms == 1:
        images = rng.normal(size=(3, *op.shape_in[1:])).astype(np.float32)
        every = np.repeat(images[:, None], op.shape_in[0], axis=1)
        assert distance(op.render(images), op(every)) < 1e-6


def names(*chosen):
    """The check of geometries by name."""

    def check(device):
        for name in chosen:
            op = operator(device, GEOMETRIES[name](), *psfs())
            same_as_the_oracle(op, psfs())

    return check


def test_aligned_operators(builds):
    builds(names("finer", "crossed back, mirrored"))


def test_operators_of_lines(builds):
    """Of more columns, lines and pixels than a group has work-items, and of fewer."""
    builds(names("30 degrees", "60 degrees", "30 degrees, finer"))


def test_lines_longer_than_a_group(builds):
    def check(device):
        for angle in (20, 70):
            mapping = affine(turn(angle, 0.6), (41, 44), (39, 43))
            same_as_the_oracle(operator(device, mapping, *psfs()), psfs())

    builds(check)


def test_distorted_operators(builds):
    builds(names("distorted", "distorted, 200 degrees, mirrored"))


def test_items_with_tables_of_their_own(builds):
    """Of lines with other numbers of taps, columns and frequencies; in any order."""

    def check(device):
        rng = np.random.default_rng(1)
        for geometry in ("aligned", "affine", "distorted"):
            angles = (0, 0, 0) if geometry == "aligned" else (10, 25, -20)
            build = distorted if geometry == "distorted" else affine
            plans = [
                make_resampling_plan(build(turn(a, s)), *psfs(), precision=Precision.of(np.float32))
                for a, s in zip(angles, (2.0, 0.7, 3.0), strict=True)
            ]
            op = Resampler.from_plans(plans, device=device)
            x = rng.normal(size=(3, *op.shape_in)).astype(np.float32)
            y = rng.normal(size=(3, *op.shape_out)).astype(np.float32)
            for i, plan in enumerate(plans):
                alone = Resampler.from_plans([plan], device=device)
                assert distance(op(x)[i], alone(x[i])) < 1e-6
                assert distance(op.adjoint(y)[i], alone.adjoint(y[i])) < 1e-6

    builds(check)


@pytest.mark.parametrize("name", ["crossed", "60 degrees", "distorted"])
def test_operators_of_terms(builds, name):
    widths = [1.4, 1.6, 1.5, 1.9, 1.7, 2.1]
    pair = PSF.gaussian(0.8, n_pixels=15), PSF.gaussian(widths)

    def check(device):
        precision = Precision.of(np.float32)
        plan = make_resampling_plan(GEOMETRIES[name](), *pair, precision=precision, n_terms=3)
        op, rng = Resampler.from_plans([plan], device=device), np.random.default_rng(2)
        images = rng.normal(size=(2, *op.shape_in)).astype(np.float32)
        seen = expected(op, images, *pair).reshape(2, 2, 3, *op.shape_out[1:]).sum(axis=2)
        assert distance(op(images), seen) < 2e-6
        check_adjoint(op, rng, batch=(2,))

    builds(check)


@pytest.mark.parametrize("name", ["crossed", "30 degrees"])
def test_the_papers_scheme(builds, name):
    # oversampled: no sinc is cut where it counts
    pair = PSF.gaussian(0.8), PSF.gaussian([1.6, 1.9], spacing=0.5, n_pixels=61)

    def check(device):
        op = PaperResampler.from_mapping(GEOMETRIES[name](), *pair, device=device)
        rng = np.random.default_rng(3)
        images = rng.normal(size=(3, *op.shape_in)).astype(np.float32)
        close = 2e-6 if device.has_fp64 else 1e-5
        assert distance(op(images), expected(op, images, *pair)) < close
        check_adjoint(op, rng, batch=(3,))

    builds(check)


def test_a_buffer_left_unwritten_and_an_overrun_are_seen(builds, device):
    """The fixture detects both."""

    def unwritten(device):
        assert np.isfinite(device.get(device.empty(7, np.float32))).all()

    def overrun(device):
        array = device.empty(7, np.float32)
        device.launcher("update.cl", "rescale_spectra", dtype=np.float32, local_size=(1,))(
            (1,), factor=array, n_channels=1, spectra=array, n=9
        )

    for fault in (unwritten, overrun):
        with pytest.raises(AssertionError):
            builds(fault)
