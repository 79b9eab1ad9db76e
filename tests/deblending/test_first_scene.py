"""A fit's first scene, of a start made by hand: boxes, steps, what is fixed, what is seen."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.start import first_scene as room
from clresample.deblending.start.first_scene import first_scene
from clresample.paper.solver import scene as steps
from clresample.sky.sources import ExtendedSource, PointSource


def posed(monkeypatch, *, shares=False):
    """A fit of three components of two sources, the second one outside the frame; boxes are as
    large as their light is bright, so that each shows by what it was asked."""
    rng, asked = np.random.default_rng(0), []

    def box_of(start, i, shape, brightness):
        asked.append((start, i, shape, brightness))
        return np.array([i, 2 * i]), (3 + i, 4), np.array([1, i]), np.full((3 + i, 4), 1.0 + i)

    monkeypatch.setattr(room, "component_box", box_of)
    spectra = np.array([[30.0, 40.0, 1.0], [5.0, 6.0, 0.0], [7.0, 80.0, 9.0]])
    power = np.array([[4.0, 0.25, 1.0], [1e-27, 1e-29, 0.0], [100.0, 1e-10, 16.0]])
    start = SimpleNamespace(
        source=np.array([1, 0, 0]), spectra=spectra, spectrum_curvature=power, sky=rng.random(3)
    )
    ops = [SimpleNamespace(shape_out=(n, 5, 6)) for n in (1, 2)]
    parts = [rng.random((2, n, 3)) if shares else None for n in (1, 2)]
    views = [
        SimpleNamespace(
            op=op,
            data=rng.random(op.shape_out),
            weights=rng.random(op.shape_out),
            coefficients=p,
        )
        for op, p in zip(ops, parts, strict=True)
    ]
    fit = SimpleNamespace(
        start=start,
        noise=np.array([2.0, 1.0, 0.1]),
        ties=None,
        sky_precision=np.array([4.0, 0.0, 9.0]),
        frame=SimpleNamespace(shape=(20, 21)),
        padded=SimpleNamespace(shape=(24, 32)),
        views=views,
        sources=[
            PointSource(position_px=(1, 2)),
            PointSource(position_px=(-9, 2)),
            ExtendedSource(position_px=(3, 4)),
        ],
        fitted=[0, 2],
        settings=SimpleNamespace(fit_sky=True),
    )
    return fit, asked


@pytest.mark.parametrize("shares", [False, True])
def test_a_first_scene_holds_what_the_start_has_found(monkeypatch, shares):
    fit, asked = posed(monkeypatch, shares=shares)
    scene, state = first_scene(fit)
    assert asked == [(fit.start, i, (20, 21), b) for i, b in enumerate((40.0, 6.0, 90.0))]
    assert (scene.shape, scene.unpadded_shape, scene.fit_sky) == ((24, 32), (20, 21), True)
    assert scene.origin.tolist() == [[0, 0], [1, 2], [2, 4]]
    assert scene.center.tolist() == [[1, 0], [1, 1], [1, 2]]
    assert scene.fixed.tolist() == [False, True, True]  # the first is of the third source
    assert scene.channels() == [slice(0, 1), slice(1, 3)]
    for k, view in enumerate(fit.views):
        assert scene.ops[k] is view.op and scene.data[k] is view.data
        np.testing.assert_allclose(scene.weights[k], view.weights)
        if shares:
            np.testing.assert_array_equal(scene.coefficients[k], view.coefficients[[1, 0, 0]])
        else:
            assert scene.shares_of(k) is None
    for i in range(3):
        np.testing.assert_array_equal(scene.profile[i], np.full((3 + i, 4), 1.0 + i))
        np.testing.assert_array_equal(state.morph[i], scene.profile[i])
        assert state.morph[i] is not scene.profile[i]  # it changes
    assert state.spectra is fit.start.spectra and state.sky is fit.start.sky
    assert scene.known_sky is fit.sky_precision
    assert scene.spectrum_curvature is fit.start.spectrum_curvature


def test_spectra_step_by_their_error_and_a_fiftieth_of_themselves(monkeypatch):
    """Spectra stay in channels in which a component has no light."""
    monkeypatch.setattr(steps, "damping", lambda *given: given)
    first = first_scene(posed(monkeypatch)[0])
    scene, state = steps.begin_steps(*first, "prior")
    assert scene.damping == (*first, "prior") and steps.begin_steps(scene, state, None)[0] is scene
    for z, morph in zip(state.latent, state.morph, strict=True):
        assert z.shape == morph.shape and not z.any()
    wanted = [[1.1, 2.8, 1.02], [10**13.5 + 0.1, 0, 0], [0.24, 1e5 + 1.6, 0.43]]
    np.testing.assert_allclose(scene.step_scale, wanted, rtol=1e-9)


def test_spectra_of_terms_are_each_channels_times_its_shares(monkeypatch):
    fit, _ = posed(monkeypatch, shares=True)
    scene, state = first_scene(fit)
    for k, part in enumerate(scene.channels()):
        own = state.spectra[:, part]
        wanted = np.einsum("sc,sct->sct", own, fit.views[k].coefficients[[1, 0, 0]])
        np.testing.assert_array_equal(scene.parts(k, own), wanted.reshape(3, -1))
    plain, state = first_scene(posed(monkeypatch)[0])
    own = state.spectra[:, 1:]
    assert plain.parts(1, own) is own
