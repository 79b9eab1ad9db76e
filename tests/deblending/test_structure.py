"""Structure at several scales on the device: as in NumPy, with a transpose that is one."""

import numpy as np
import pytest
from helpers.buffers import Guards
from helpers.learned import Source
from helpers.solver import close, every_type, ragged

from clresample.deblending.solver.boxes import ALIGN, Boxes
from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.structure import (
    LatentLayout,
    StructureOperator,
    coarse_count,
)

PRIORS = {
    "three": MultiscalePrior(),
    "two": MultiscalePrior(scales_px=(1.0, 6.5), strengths=(0.1, 0.1)),
    "wide": MultiscalePrior(scales_px=(2.0, 40.0), strengths=(0.1, 0.1)),  # steps over a vector
}


def made(build, dtype, prior, seed=0):
    """Structure of ragged scenes, with coefficients and gradients of random numbers."""
    if dtype == np.float64 and not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    rng = np.random.default_rng(seed)
    scenes, states = map(list, zip(*ragged(build, dtype), strict=True))
    b = SceneBuffers(scenes, states, build, dtype, prior)
    structure = StructureOperator(b, prior)
    z = [[rng.normal(0, 0.3, shape) for shape in shapes] for shapes in structure.latents.shape]
    profiles = [p for s in scenes for p in s.profile]
    free = ~np.concatenate([s.fixed for s in scenes])
    return b, structure, z, profiles, free


@every_type
@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_kernels_are_their_references(build, dtype, prior):
    b, structure, z, profiles, free = made(build, dtype, prior)
    rng = np.random.default_rng(1)
    vector = b.put(structure.latents.pack(z))
    before = b.host_boxes.unpack(build.get(b.morph))
    structure.form(vector)
    morphs = b.host_boxes.unpack(build.get(b.morph))
    d_morph = [rng.normal(size=p.shape) for p in profiles]
    build.upload(b.host_boxes.pack(d_morph, dtype=dtype), b.d_morph)
    precision = rng.uniform(0, 2, (len(profiles), len(prior.steps)))
    gradient = b.put(np.full(structure.latents.size, np.nan))
    structure.gradient(vector, b.put(precision), gradient)
    found = structure.latents.unpack(build.get(gradient))
    structure.energy(vector)
    energies = build.get(structure.energies)
    for i, profile in enumerate(profiles):
        if not free[i]:
            np.testing.assert_array_equal(morphs[i], before[i])
            continue
        source = Source(profile, prior)
        close(morphs[i], source.morph(z[i]), dtype)
        wanted = source.gradient(d_morph[i], morphs[i], z[i], precision[i])
        for j, part in enumerate(wanted):
            close(found[i][j], part, dtype)
            close(energies[i, j], (z[i][j] ** 2).sum(), dtype)
    assert any((m == 0).any() for m in morphs)  # or the mask was not looked at


def test_nothing_is_written_beyond_the_buffers(build, monkeypatch):
    """Lines keep their margins of zeros: a second time the answers are the same."""
    guards, rng = Guards(monkeypatch), np.random.default_rng(4)
    for prior in PRIORS.values():
        b, structure, z, profiles, _ = made(build, np.float32, prior)
        vector, precision = b.put(structure.latents.pack(z)), b.put(np.ones((len(profiles), 3)))
        d_morph = [rng.normal(size=p.shape) for p in profiles]
        found = []
        for _ in range(2):
            build.upload(b.host_boxes.pack(d_morph, dtype=np.float32), b.d_morph)
            gradient = b.put(np.zeros(structure.latents.size))
            structure.form(vector)
            structure.gradient(vector, precision, gradient)
            structure.energy(vector)
            found.append([build.get(a) for a in (b.morph, gradient, structure.energies)])
        for one, again in zip(*found, strict=True):
            np.testing.assert_array_equal(one, again)
    assert guards.overwritten() == []


@pytest.mark.counts_memory
def test_memory_is_that_of_a_line_for_each_row(build):
    """Besides one array of all boxes: rows of coefficients, padded to vectors and by the kernels'
    radii and steps. Also where a kernel is a pixel longer than vectors."""
    scenes, states = map(list, zip(*ragged(build, np.float32), strict=True))
    kept = []  # what is freed meanwhile would be counted as less
    for prior in (MultiscalePrior(), MultiscalePrior(scales_px=(1.3,), strengths=(0.1,))):
        b = SceneBuffers(scenes, states, build, np.float32, prior)
        before = build.in_use
        structure = StructureOperator(b, prior)
        kept.append((b, structure))
        used = (build.in_use - before) / 4
        rows = structure.latents.shape[:, :, 0].sum(1)
        margin = -(-(max(prior.radii) + max(prior.steps)) // ALIGN) * ALIGN
        line = b.host_boxes.shape[:, 1] + 2 * margin + 2 * ALIGN
        assert 0 < used < b.host_boxes.size + (rows * line).sum() + 8 * len(rows) + 500
    assert len(prior.kernels()[0]) == 9


def test_the_gradient_is_the_transpose(build):
    """<S', dS> = <z', dL/dz>, where S is positive, and so linear, throughout."""
    prior = MultiscalePrior()
    b, structure, z, profiles, free = made(build, np.float64, prior, seed=2)
    z = [[1e-3 * zj for zj in scales] for scales in z]
    vector, rng = b.put(structure.latents.pack(z)), np.random.default_rng(3)
    structure.form(vector)
    change = np.concatenate(
        [(m - p).ravel() for m, p in zip(b.host_boxes.unpack(build.get(b.morph)), profiles)]
    )
    d_morph = [on * rng.normal(size=p.shape) for on, p in zip(free, profiles, strict=True)]
    build.upload(b.host_boxes.pack(d_morph, dtype=np.float64), b.d_morph)
    gradient = b.put(np.zeros(structure.latents.size))
    nothing = b.put(np.zeros((len(profiles), 3)))
    structure.gradient(vector, nothing, gradient)
    left = change @ np.concatenate([d.ravel() for d in d_morph])
    right = build.get(vector) @ build.get(gradient)
    assert left == pytest.approx(right, rel=1e-9)


def test_a_coarse_grid_reaches_past_the_last_pixel():
    for n in range(1, 40):
        for step in (1, 2, 4, 8):
            k = coarse_count(n, step)
            assert step * (k - 1) >= n - 1 > step * (k - 2)


def test_coarse_grids_lose_nothing():
    """The scatter of structure is that of the kernel on every pixel, up to 3 % anywhere."""
    prior = MultiscalePrior()
    axes = Source(np.ones((81, 81)), prior).axes
    for ky, _ in axes:
        assert (ky**2).sum(1)[20:-20] == pytest.approx(1, abs=0.03)


def test_vectors_hold_free_sources_alone():
    boxes = Boxes(np.array([0, 0]), np.zeros((2, 2), int), np.array([[3, 5], [9, 9]]))
    latents = LatentLayout(boxes, np.array([1]), (1, 4))
    assert latents.start.tolist() == [0, 0]
    assert latents.size == 96  # 81 + 3 x 3, rounded up
    z = [[np.zeros((0, 0))] * 2, [np.ones((9, 9)), np.full((3, 3), 2.0)]]
    assert latents.unpack(latents.pack(z))[1][1].tolist() == [[2.0] * 3] * 3


def test_a_prior_of_nonsense_is_refused():
    for given in (
        {"scales_px": (1.0,)},
        {"strengths": (0.1, -1.0, 0.1)},
        {"scales_px": (), "strengths": ()},
        {"hyperprior_weight": 0.0},
    ):
        with pytest.raises(ValueError):
            MultiscalePrior(**given)
