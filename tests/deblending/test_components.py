"""One component or two, by the data: the test of residuals, and what fits make of it."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import MODEL_PSF, SHAPE, frame, grids, sources
from scipy.stats import multivariate_normal

from clresample.deblending import batch
from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.ended import Ended
from clresample.deblending.profiles import profile, psf_second_moment
from clresample.deblending.refit import colour_gradient, two_component_fit, two_component_start
from clresample.deblending.refit.colour_gradient import (
    CORE_COLOUR_SCATTER,
    _eliminated,
    log_evidence_ratio,
)
from clresample.deblending.solver.multiscale.engine import MultiscaleEngine
from clresample.deblending.solver.multiscale.lbfgs_control import LbfgsControl
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.start import profile_start
from clresample.device.device import Device
from clresample.device.resident import ResidentImages
from clresample.measurement.catalogue import catalogue
from clresample.paper.settings import PaperSettings
from clresample.resampling.resampler import Resampler
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

PSFS = PSF.gaussian(0.9, n_pixels=19, n_bands=2), PSF.gaussian(1.1, n_pixels=15, n_bands=3)
NOISE = 0.05
# Bulge and disc: sigma [px], light over five channels, where both are red or blue, and where not.
GREY = np.array([4.0, 5, 6, 7, 8])
BULGE, DISC = (1.0, np.array([1.0, 3, 5, 8, 10])), (3.2, np.array([8.0, 7, 6, 5, 3]))
PLACE, OTHER = (14.2, 12.1), (16.0, 26.3)


def galaxy(place, parts, flux=20.0):
    """(5, Ny, Nx) of parts (sigma, spectrum)."""
    out = 0.0
    for sigma, spectrum in parts:
        shape = np.array([np.log(sigma), 0.1, -0.1, np.log(4.0)])
        out = (
            out
            + spectrum[:, None, None]
            * profile(shape, place, SHAPE, psf_second_moment(MODEL_PSF))[0]
        )
    return flux * out


def blend(gradient=True, seed=0):
    """A galaxy, with a bulge of another colour or without, beside one of a single colour."""
    rng = np.random.default_rng(seed)
    parts = (BULGE, DISC) if gradient else ((BULGE[0], 0.7 * GREY), (DISC[0], GREY))
    model = galaxy(PLACE, parts) + galaxy(OTHER, ((1.7, 1.5 * GREY),))
    found = []
    for k, (grid, psf) in enumerate(zip(grids(), PSFS, strict=True)):
        part = (slice(0, 2), slice(2, 5))[k]
        op = Resampler(frame().grid, MODEL_PSF, grid, psf, dtype=np.float64)
        data = op.forward(model[part])
        data += NOISE * rng.normal(size=data.shape)
        names = (("v", "w"), ("g", "r", "i"))[k]
        found.append(Observation(data, psf, grid, weights=NOISE**-2, channels=names, name="er"[k]))
    given = (((PLACE), 0, 1), ((OTHER), 0, 1))
    return Blend(tuple(found), sources(given), frame()), model


def counts(result):
    return list(catalogue(result)["n_components"])


@pytest.fixture(scope="module", autouse=True)
def by_second_fits():
    """Second components by second fits: a start finds that of this galaxy too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(profile_start, "second_profiles", lambda fit, candidates: {})
        yield


@pytest.fixture(scope="module")
def two(device):
    b, model = blend()
    return deblend(b.observations, b.sources, frame=b.frame, device=device), b, model


def test_a_bulge_of_another_colour_is_a_second_component(two):
    result, b, model = two
    assert counts(result) == [2, 1] and result.converged
    assert result.sources == b.sources and result.sources[0].n_components is None
    chi2 = [float((result.residual(i) ** 2).mean()) / NOISE**2 for i in (0, 1)]
    assert max(chi2) < 1.1
    table = catalogue(result)
    flux = np.array([table[f"flux_{c}"][0].value for c in result.channels])
    want = galaxy(PLACE, (BULGE, DISC)).sum((1, 2))
    error = np.array([table[f"flux_err_{c}"][0].value for c in result.channels])
    assert (np.abs(flux - want) < 4 * error + 0.01 * want).all()


def test_one_component_misfits_it(two, device):
    """Else the second one would not be needed."""
    result, b, _ = two
    one = tuple(replace(s, n_components=1) for s in b.sources)
    forced = deblend(b.observations, one, frame=b.frame, device=device)
    assert counts(forced) == [1, 1] and forced.losses[-1] > result.losses[-1] + 100


def test_a_galaxy_of_one_colour_keeps_one(device):
    blends = [blend(gradient=False, seed=s)[0] for s in range(4)]
    assert [counts(r) for r in deblend_many(blends, device=device)] == [[1, 1]] * 4


def test_many_are_as_if_each_were_alone(two, device):
    alone, b, _ = two
    grey, _ = blend(gradient=False)
    together = deblend_many([grey, b, grey, b], device=device)
    assert [counts(r) for r in together] == [[1, 1], [2, 1], [1, 1], [2, 1]]
    for result in together[1::2]:
        assert result.losses[-1] == pytest.approx(alone.losses[-1], abs=1)


def test_other_priors_have_one(device):
    b, _ = blend()
    given = {"frame": b.frame, "device": device, "settings": PaperSettings(prior=None, max_iter=20)}
    assert counts(deblend(b.observations, b.sources, **given)) == [1, 1]


def test_two_found_are_as_two_asked_for(two, device):
    """The second fit ends where one ends that is told of both from the start: the neighbour, which
    has held what one component could not take, is smooth again."""
    result, b, _ = two
    known = (replace(b.sources[0], n_components=2), b.sources[1])
    told = deblend(b.observations, known, frame=b.frame, device=device)
    assert result.losses[-1] == pytest.approx(told.losses[-1], abs=5)


def test_a_second_fit_begins_with_what_the_first_leaves(two, device, monkeypatch):
    """All structure is there from the first trial on, where a core begins beside the first one."""
    _, b, _ = two
    kept, pairs = {0: 0, 2: 1}, []

    def asked(fits):
        pairs.append(list(fits))
        return colour_gradient.run_gradient_tests(fits)

    def chosen(starts, fit_sky, n_kept):
        pairs.append(starts[0])
        return [starts[0][1]]

    monkeypatch.setattr(two_component_start, "run_gradient_tests", asked)
    monkeypatch.setattr(two_component_start, "best_starts", chosen)
    monkeypatch.setattr(two_component_fit, "iterate", lambda *given: None)
    deblend(b.observations, b.sources, frame=b.frame, device=device)
    (first,), new = pairs[0], pairs[1][1]
    engine = MultiscaleEngine([new.scene], [new.state], device, np.float32, MultiscalePrior(), 1.0)
    found, known = engine.states()[0], first.state.learned
    for k, morph in enumerate(found.morph):
        wanted = first.state.morph[kept[k]] if k in kept else new.scene.profile[k]
        np.testing.assert_allclose(morph, wanted, atol=1e-5)
    for k, i in kept.items():
        for part, wanted in zip(found.learned.structure[k], known.structure[i], strict=True):
            np.testing.assert_allclose(part, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.learned.strengths, known.strengths[[0, 0, 1]])


@pytest.mark.parametrize("taken_over", [False, True])
def test_what_is_worse_is_not_kept(device, monkeypatch, taken_over):
    """The first fit comes back, as it was; one that was taken over before its end goes on to it."""
    b, _ = blend()
    if not taken_over:
        monkeypatch.setattr(batch, "needs_second_component", lambda fit: False)
    given = {"frame": b.frame, "device": device}
    monkeypatch.setattr(colour_gradient, "MIN_LOG_EVIDENCE", np.inf)
    plain = deblend(b.observations, b.sources, **given)
    monkeypatch.setattr(colour_gradient, "MIN_LOG_EVIDENCE", -np.inf)
    monkeypatch.setattr(two_component_fit, "MAX_WORSE", -np.inf)
    tried = deblend(b.observations, b.sources, **given)
    assert tried.seconds["components"] > plain.seconds["components"]
    assert counts(tried) == [1, 1] and tried.status == plain.status
    if not taken_over:
        np.testing.assert_array_equal(tried.losses, plain.losses)
        return
    n_same = min(map(len, (plain.losses, tried.losses))) // 2
    np.testing.assert_array_equal(tried.losses[:n_same], plain.losses[:n_same])
    assert tried.losses[-1] < plain.losses[-1] + 1  # it may go further, from another memory


def test_ctrl_c_in_the_second_fit_leaves_the_first(device, monkeypatch):
    b, _ = blend()
    judge, n_fits = LbfgsControl.accept_trials, []

    def interrupted(self, loss, slope):
        if not self.n_rounds.any():
            n_fits.append(1)
        if len(n_fits) == 2:
            raise KeyboardInterrupt
        return judge(self, loss, slope)

    monkeypatch.setattr(LbfgsControl, "accept_trials", interrupted)
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    assert result.status == Ended.INTERRUPTED and counts(result) == [1, 1]


def test_images_are_uploaded_once_for_all_fits_of_a_scene(device, monkeypatch):
    """Data, weights and their roots, by the starts, both fits and the end; nothing stays."""
    b, _ = blend()
    deblend(b.observations, b.sources, frame=b.frame, device=device)
    gc.collect()
    before, uploads, images = device.in_use, [], []
    upload, keep = Device.upload, ResidentImages._keep

    def watched(self, values, array, **options):
        uploads.append(values.tobytes())
        return upload(self, values, array, **options)

    def kept(self, image, dtype, *place):
        if image.ndim == 3:  # spectra and levels are uploaded so too
            images.append(image.astype(dtype).tobytes())
        keep(self, image, dtype, *place)

    monkeypatch.setattr(Device, "upload", watched)
    monkeypatch.setattr(ResidentImages, "_keep", kept)
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    assert counts(result) == [2, 1] and len(images) == 3 * len(b.observations)
    for image in images:  # weights of 1 are their own roots
        assert sum(image in values for values in uploads) == images.count(image)
    gc.collect()
    assert device.in_use == before


def test_a_second_fit_that_fails_leaves_the_first(device, monkeypatch):
    b, _ = blend()

    def fails(*args, **given):
        raise MemoryError("too large")

    monkeypatch.setattr(two_component_start, "fit_start_profiles", fails)
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    assert result.status == "misfit" and counts(result) == [1, 1]  # one component is not enough
    assert any("too large" in line for line in result.messages)


def test_evidence_is_that_of_normal_distributions():
    """With lambda's own scatter so wide that it is the same for both."""
    rng, n_channels, wide = np.random.default_rng(3), 5, 300.0
    a, precision = rng.uniform(0.5, 2, n_channels), rng.uniform(5, 50, n_channels)
    values = rng.normal(size=n_channels)
    both = [
        np.diag(1 / precision + (g * a) ** 2) + wide**2 * np.outer(a, a)
        for g in (CORE_COLOUR_SCATTER, 0)
    ]
    one, none = (multivariate_normal(np.zeros(n_channels), c).logpdf(values) for c in both)
    assert log_evidence_ratio(values, precision, a) == pytest.approx(one - none, abs=1e-3)
    assert (
        log_evidence_ratio(values[:1], precision[:1], a[:1]) == -np.inf
    )  # one channel has no colour


def test_what_is_eliminated_is_least_squares():
    rng = np.random.default_rng(4)
    rows, residual = rng.normal(size=(5, 80)), rng.normal(size=80)
    covariance, power = np.linalg.inv(rows @ rows.T), (rows**2).sum(1)[:, None]
    given = covariance[None], (rows @ residual)[:, None], power
    value, precision = _eliminated(*given, 2)
    want = np.linalg.lstsq(rows.T, residual, rcond=None)[0][-2:]
    np.testing.assert_allclose(value[:, 0], want, rtol=1e-6)
    np.testing.assert_allclose(1 / precision[:, 0], np.diag(covariance)[-2:], rtol=1e-6)
    assert _eliminated(1e7 * covariance[None], *given[1:], 1)[1] == 0  # no longer apart
    assert _eliminated(np.full((1, 5, 5), np.inf), *given[1:], 1)[1] == 0  # not seen


@pytest.mark.parametrize("n", [0, -1])
def test_numbers_that_cannot_be(n):
    with pytest.raises(ValueError, match=f"n_components is {n}"):
        ExtendedSource(position_px=(1, 1), n_components=n)
