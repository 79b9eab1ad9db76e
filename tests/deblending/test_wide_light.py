"""A nucleus within a faint host that is far wider: two components of a galaxy from the start."""

import numpy as np
import pytest

from clresample import Settings
from clresample.deblending.batch import deblend, deblend_many
from clresample.deblending.blend import Blend
from clresample.deblending.start import profile_start
from clresample.measurement.catalogue import catalogue
from clresample.paper.settings import PaperSettings
from clresample.sky.frame import model_frame
from clresample.sky.grid import Grid
from clresample.sky.observation import Observation
from clresample.sky.psf import PSF
from clresample.sky.sources import ExtendedSource

SHAPE, PLACE, SIGMA = (80, 80), (39.3, 40.2), 1.3
NUCLEUS, HOST = 2000.0, 900.0


def light(flux, sigma, place=PLACE):
    """A Gaussian of `sigma` [px] before the PSF, on the image."""
    y, x = np.indices(SHAPE)
    s2 = sigma**2 + SIGMA**2 + 1 / 12
    away = (y - place[0]) ** 2 + (x - place[1]) ** 2
    return flux * np.exp(-away / (2 * s2)) / (2 * np.pi * s2)


def seen(host=HOST, sigma=16.0, *, nucleus=0.2, seed=0):
    data = light(NUCLEUS, nucleus) + light(host, sigma)
    data += np.random.default_rng(seed).normal(size=SHAPE)
    return Observation(data, PSF.gaussian(SIGMA), Grid.flat(SHAPE, 0.1), weights=1.0)


def scene(*given, **kinds):
    o = seen(*given, **kinds)
    return Blend((o,), (ExtendedSource(position_px=PLACE),), model_frame([o]))


def fluxes(result):
    table = catalogue(result)
    names = [name for name in table.colnames if name.startswith("flux")]
    flux, error = (float(np.asarray(table[name])[0]) for name in names[:2])
    return flux, error, int(table["n_components"][0])


def test_the_host_of_a_nucleus_is_its_second_component(device):
    b = scene()
    result = deblend(b.observations, b.sources, frame=b.frame, device=device)
    flux, error, n = fluxes(result)
    assert n == 2 and result.converged and result.sources[0].n_components is None
    assert abs(flux - NUCLEUS - HOST) < 3 * error < 0.2 * flux


def test_without_it_the_hosts_light_is_lost(device, monkeypatch):
    """At the noise's chi2: no message would say so."""
    b = scene()
    monkeypatch.setattr(profile_start, "second_profiles", lambda fit, candidates: {})
    flux, error, n = fluxes(deblend(b.observations, b.sources, frame=b.frame, device=device))
    assert n == 1 and NUCLEUS + HOST - flux > 10 * error


def test_galaxies_without_a_host_keep_one(device):
    """Compact and wide ones, bright ones too."""
    some = [scene(0.0, seed=s) for s in range(3)]
    some += [scene(h, s, seed=k) for k, (h, s) in enumerate([(2e4, 3.0), (5e4, 6.0)])]
    assert [fluxes(r)[2] for r in deblend_many(some, device=device)] == [1] * 5


@pytest.mark.parametrize(
    ("source", "settings"),
    [
        (ExtendedSource(position_px=PLACE, n_components=1), Settings()),
        (ExtendedSource(position_px=PLACE), PaperSettings(prior=None, max_iter=20)),
    ],
)
def test_a_number_that_is_given_stays(device, source, settings):
    b = scene()
    result = deblend(b.observations, (source,), frame=b.frame, settings=settings, device=device)
    assert fluxes(result)[2] == 1


def test_a_scene_does_not_depend_on_others_with_a_host(device):
    plain = scene(0.0, seed=4)
    alone = deblend(plain.observations, plain.sources, frame=plain.frame, device=device)
    _, beside, _ = deblend_many([scene(), plain, scene(seed=7)], device=device)
    assert fluxes(beside) == pytest.approx(fluxes(alone), rel=1e-4)
