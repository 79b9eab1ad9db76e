"""A batch's strengths and the responses of its operators, against NumPy source by source.

Misfit, responses to one pixel, the updates of each scene, and the sizes of launches.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.solver import ragged

from clresample.deblending.solver import reference as ref
from clresample.deblending.solver.buffers import ITEMS_EACH, SceneBuffers
from clresample.deblending.solver.gradient import LossGradient
from clresample.deblending.solver.multiscale import evidence
from clresample.deblending.solver.multiscale.evidence import (
    LocalPowerSpectra,
    SourceEvidence,
    blurred_light,
)
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.response import OperatorResponse
from clresample.deblending.solver.multiscale.strengths import PriorStrengths
from clresample.deblending.solver.multiscale.structure import LatentLayout
from clresample.deblending.solver.scene_model import compose, gather_spectra


def adjoint(scene, images):
    """R^T (C, Ny, Nx) of images, one array an observation."""
    pairs = zip(scene.ops, images, strict=True)
    return np.concatenate([op.adjoint(image.astype(op.dtype)) for op, image in pairs])


def misfit(scene, state):
    """chi2 per pixel (S,) where each source's light is, by its definition."""
    model, squares = compose(scene.shape, scene.origin, state.morph, state.spectra), []
    for part, op, data, weights in zip(
        scene.channels(), scene.ops, scene.data, scene.weights, strict=True
    ):
        seen = op.forward(model[part].astype(op.dtype))
        squares.append(ref.residual(seen, data, weights, state.sky[part])[0] ** 2)
    sums = [
        (state.spectra**2 * gather_spectra(adjoint(scene, of), scene.origin, state.morph)).sum(1)
        for of in (squares, scene.weights)
    ]
    return sums[0] / sums[1]


def made(build, unit=1.0):
    if not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    scenes, states = map(list, zip(*ragged(build, np.float64), strict=True))
    scenes = [replace(s, weights=[unit * w for w in s.weights]) for s in scenes]
    b = SceneBuffers(scenes, states, build, np.float64, MultiscalePrior())
    gradient = LossGradient(b)
    return scenes, states, gradient, OperatorResponse(b, gradient)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_misfit_is_chi2_where_a_sources_light_is(build, unit):
    """Whatever the unit of the weights, and so of chi2 over data that stay."""
    scenes, states, gradient, response = made(build, unit)
    gradient.queue()
    found = response.misfit(np.concatenate([s.spectra for s in states]))
    wanted = np.concatenate([misfit(*pair) for pair in zip(scenes, states, strict=True)])
    np.testing.assert_allclose(found, wanted, rtol=1e-8)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_answers_to_a_pixel_are_those_of_the_operators(build, unit):
    """Of one near the middle of what is seen, each channel with its median weight."""
    scenes, _, _, response = made(build, unit)
    for scene, answers, pixels in zip(scenes, *response.impulse_responses(), strict=True):
        wanted = []
        for op, weights in zip(scene.ops, scene.weights, strict=True):
            y, x = pixels[len(wanted)]
            seen = op.adjoint(weights.astype(op.dtype)).sum(0).clip(0)
            for at, along in ((y, seen.sum(1)), (x, seen.sum(0))):
                assert abs(at - along @ np.arange(len(along)) / along.sum()) < 0.51
            impulse = np.zeros(op.shape_in, op.dtype)
            impulse[:, y, x] = 1
            level = [np.median(w[w > 0]) for w in weights]
            wanted += list(op.adjoint(op.forward(impulse)) * np.array(level)[:, None, None])
        np.testing.assert_allclose(answers, wanted, atol=1e-9 * np.max(wanted))


class Learning:
    """Strengths of a batch's sources, and each free one's SourceEvidence."""

    def __init__(self, build):
        self.scenes, self.states, self.gradient, response = made(build)
        self.b, self.prior = self.gradient.buffers, MultiscalePrior()
        self.latents = latents(self.b, self.prior)
        self.strengths = PriorStrengths(self.b, self.gradient, self.latents, self.prior)
        self.spectra = np.concatenate([s.spectra for s in self.states])
        self.scene = np.repeat(np.arange(3), [len(s.profile) for s in self.scenes])
        self.profiles = [p for s in self.scenes for p in s.profile]
        self.fixed = np.concatenate([s.fixed for s in self.scenes])
        spectra, pairs = (
            LocalPowerSpectra(self.prior),
            list(zip(*response.impulse_responses(), strict=True)),
        )
        self.evidence = [
            SourceEvidence(spectra, self.prior, p, spectra.from_impulse_responses(*pairs[b]))
            for b, p in zip(self.scene, self.profiles, strict=True)
        ]

    def curvature(self, spectra):
        """(S, J); 0 of fixed sources."""
        found = [e.curvature(a) for e, a in zip(self.evidence, spectra, strict=True)]
        return np.array(found) * ~self.fixed[:, None]


def latents(b, prior):
    return LatentLayout(b.host_boxes, b.device.get(b.free)[: b.n_free], prior.steps)


def test_weights_are_those_of_each_source(build):
    """Precision, curvature at the spectra, change; the curvature anew in scenes that are due."""
    m = Learning(build)
    light = m.latents.unpack(build.get(m.strengths.light))
    for i in np.flatnonzero(~m.fixed):
        for j, (sigma, step) in enumerate(zip(m.prior.scales_px, m.prior.steps, strict=True)):
            np.testing.assert_allclose(light[i][j], blurred_light(m.profiles[i], sigma, step))
    found = m.strengths.weights(m.spectra)
    np.testing.assert_allclose(found[..., 0], np.tile(np.power(m.prior.strengths, -2.0), (9, 1)))
    np.testing.assert_allclose(found[..., 1], m.curvature(m.spectra), rtol=1e-6)
    assert not found[..., 2].any() and all(
        not m.strengths.schedule.blocks[i].blocks for i in np.flatnonzero(m.fixed)
    )
    due, change = np.array([False, False, True]), np.random.default_rng(0).random((9, 3))
    found = m.strengths.weights(3 * m.spectra, due, change)
    wanted = np.where(due[m.scene][:, None], 9, 1) * m.curvature(m.spectra)
    np.testing.assert_allclose(found[..., 1], wanted, rtol=1e-6)
    np.testing.assert_array_equal(found[..., 2], change)


def test_scenes_that_are_due_learn_from_their_own_energies_and_misfit(build):
    """Their loss changes by what the new strengths say of the old coefficients."""
    m = Learning(build)
    m.strengths.weights(m.spectra)
    m.gradient.queue()
    energies = np.random.default_rng(1).uniform(0, 3, (9, 3))
    old, due = m.strengths.values.copy(), np.array([True, False, True])
    moved, weights, change = m.strengths.learn(due, energies, m.spectra)
    chi2 = np.concatenate([misfit(*pair) for pair in zip(m.scenes, m.states, strict=True)])
    wanted = old.copy()
    for i in np.flatnonzero(due[m.scene] & ~m.fixed):
        wanted[i] = m.evidence[i].learned(old[i], energies[i], m.spectra[i], chi2[i])
    assert (wanted != old).any(1).tolist() == (due[m.scene] & ~m.fixed).tolist()
    np.testing.assert_allclose(m.strengths.values, wanted, rtol=1e-6)
    np.testing.assert_allclose(build.get(m.strengths.precision), wanted**-2, rtol=1e-6)
    np.testing.assert_allclose(weights[..., 0], wanted**-2, rtol=1e-6)
    np.testing.assert_allclose(weights[..., 2], wanted**-2 - old**-2, rtol=1e-5)
    largest = np.abs(np.log(wanted / old)).max(1)
    np.testing.assert_allclose(moved, [largest[m.scene == b].max() for b in range(3)], rtol=1e-6)
    loss = 0.5 * (energies * (wanted**-2 - old**-2)).sum(1)
    np.testing.assert_allclose(change, [loss[m.scene == b].sum() for b in range(3)], rtol=1e-5)


def test_scenes_that_begin_take_their_strengths_from_their_own_slopes(build, monkeypatch):
    monkeypatch.setattr(evidence, "MIN_DETERMINED", 0.0)  # these boxes have few pixels
    m = Learning(build)
    powers = np.random.default_rng(2).uniform(0, 1e9, (9, 3))
    spectra, begin = 1e3 * m.spectra, np.array([True, False, True])
    old = m.strengths.values.copy()
    m.strengths.begin(begin, powers, spectra)
    wanted = old.copy()
    for i in np.flatnonzero(begin[m.scene] & ~m.fixed):
        wanted[i] = m.evidence[i].first_strengths(powers[i], spectra[i])
    assert (wanted != old).any(1).tolist() == (begin[m.scene] & ~m.fixed).tolist()
    np.testing.assert_allclose(m.strengths.values, wanted, rtol=1e-6)
    np.testing.assert_allclose(build.get(m.strengths.precision), wanted**-2, rtol=1e-6)


def test_clear_structure_is_looked_for_in_scenes_that_ask_and_learned_from_then_on(build):
    m = Learning(build)
    m.strengths.weights(m.spectra)
    m.gradient.queue()
    free = np.flatnonzero(~m.fixed)
    one, other = free[m.scene[free] == 0][0], free[m.scene[free] == 2][0]
    energies = np.zeros((9, 3))
    energies[[one, other], 0] = 1e4 * m.strengths.values[0, 0] ** 2
    found = m.strengths.find_significant(np.array([True, True, False]), energies, m.spectra)
    assert found.tolist() == [True, False, False]
    assert np.flatnonzero(m.strengths.significant).tolist() == [one]
    assert not m.strengths.find_significant(
        np.array([True, True, False]), energies, m.spectra
    ).any()
    assert m.strengths.significant[one]  # it stays so, and is nothing new
    old = m.strengths.values.copy()
    m.strengths.learn(np.ones(3, bool), energies, m.spectra)
    chi2 = np.concatenate([misfit(*pair) for pair in zip(m.scenes, m.states, strict=True)])
    for i in (one, other):
        given = old[i], energies[i], m.spectra[i], chi2[i]
        wanted = m.evidence[i].learned(*given, clear=bool(i == one))
        np.testing.assert_allclose(m.strengths.values[i], wanted, rtol=1e-6)


def test_findings_are_those_of_scenes_that_were_asked_for(build):
    m = Learning(build)
    energies = np.random.default_rng(1).uniform(0, 3, (9, 3))
    first, second, third = m.strengths.findings(np.array([True, False, True]), energies, m.spectra)
    assert second is None
    for b, found in ((0, first), (2, third)):
        np.testing.assert_array_equal(found.energies, energies[m.scene == b])
        np.testing.assert_array_equal(found.strengths, m.strengths.values[m.scene == b])
        for i, row in zip(np.flatnonzero(m.scene == b), found.n_effective, strict=True):
            wanted = m.evidence[i].determined(m.strengths.values[i], m.spectra[i])
            np.testing.assert_allclose(row, 0 * wanted if m.fixed[i] else wanted, rtol=1e-6)


def test_scenes_that_go_on_alone_keep_their_strengths(build):
    m, keep = Learning(build), np.array([2, 0])
    m.strengths.weights(m.spectra)
    m.strengths.values *= np.arange(1, 10)[:, None]
    m.strengths.significant[:] = np.arange(9) % 2
    scenes, states = [m.scenes[i] for i in keep], [m.states[i] for i in keep]
    b = SceneBuffers(scenes, states, build, np.float64, m.prior)
    gradient = LossGradient(b)
    part = PriorStrengths(b, gradient, latents(b, m.prior), m.prior, past=(m.strengths, keep))
    kept = np.concatenate([np.flatnonzero(m.scene == i) for i in keep])
    np.testing.assert_array_equal(part.values, m.strengths.values[kept])
    np.testing.assert_array_equal(part.significant, m.strengths.significant[kept])
    np.testing.assert_allclose(build.get(part.precision), part.values**-2)
    whole, own = m.strengths.schedule.blocks, part.schedule.blocks
    assert [id(some) for some in own] == [id(whole[i]) for i in kept]
    nobody = np.zeros(2, bool)
    found, whole = (
        part.weights(m.spectra[kept], nobody),
        m.strengths.weights(m.spectra, np.zeros(3, bool)),
    )
    np.testing.assert_array_equal(found[..., 1], whole[kept, :, 1])
    ours = latents(b, m.prior).unpack(build.get(part.light))
    theirs = m.latents.unpack(build.get(m.strengths.light))
    for i, of in enumerate(kept):
        for one, other in zip(ours[i], theirs[of], strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("n", [1, 63, 64, 65, 300])
def test_launches_are_no_larger_than_they_must_be(build, n):
    """A whole number of groups, or of work-items that take several each; the last one is needed."""
    b = made(build)[2].buffers
    (size,) = b.items(n)
    if b.tuning.row_loops:
        assert (size - 1) * ITEMS_EACH < n <= size * ITEMS_EACH
    else:
        (group,) = b.tuning.local_size(1)
        assert size % group == 0 and size - group < n <= size
    for found, group, wanted in zip(
        b.sized(n, 5, 7), b.tuning.local_size(3), (b.along_row(n), 5, 7), strict=True
    ):
        assert found % group == 0 and found - group < wanted <= found
    assert b.along_row(n) == (1 if b.tuning.row_loops else n)
