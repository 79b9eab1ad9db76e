"""A fitted sky is expected at the level of pixels without sources, as surely as that is known."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import scenes

from clresample.deblending.inspection import inspect as room
from clresample.deblending.inspection.levels import sky_level
from clresample.deblending.settings import Settings
from clresample.measurement.photometry import fluxes
from clresample.paper.settings import PaperSettings
from clresample.paper.solver.prior import SingleScalePrior
from clresample.sky.observation import Observation

NOISE = 0.05
LEVELS = 0.4 * NOISE, -0.3 * NOISE, 0.5 * NOISE  # in v, g, r
LEARNS, PLAIN = Settings(), PaperSettings(prior=SingleScalePrior(), max_iter=150)


def raised(blend, by):
    """The blend with levels (3,) [counts] added to its data."""
    parts = np.split(np.array(by), [1])
    observations = [
        Observation(
            o.data + part[:, None, None],
            o.psf,
            o.grid,
            weights=o.weights,
            channels=o.channels,
            name=o.name,
        )
        for o, part in zip(blend.observations, parts, strict=True)
    ]
    return replace(blend, observations=tuple(observations))


def expecting(monkeypatch, levels, error):
    """Lets inspections find these levels (3,) with this error [counts]."""
    parts = {"v": np.array(levels[:1]), "g": np.array(levels[1:])}

    def found(image):
        level = parts[image.observation.channels[0]]
        return replace(sky_level(image), level=level, error=np.full(len(level), error))

    monkeypatch.setattr(room, "sky_level", found)


def errors(result):
    """Errors (S, C) [counts] of the fluxes."""
    if result.errors is None:
        return np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2)).T
    return np.sqrt(np.diagonal(result.errors.flux, axis1=1, axis2=2)).T


@pytest.mark.parametrize("settings", [LEARNS, PLAIN], ids=["learns", "plain"])
def test_a_sky_that_is_surely_known_is_as_good_as_subtracted(device, monkeypatch, settings):
    """Whatever the level is: light follows it, and errors are those without an unknown sky."""
    blend = scenes.blend()
    expecting(monkeypatch, LEVELS, 1e-4 * NOISE)
    found = scenes.fit(blend, device, settings=replace(settings, fit_sky=True))
    known = replace(settings, fit_sky=False)
    wanted = scenes.fit(raised(blend, np.negative(LEVELS)), device, settings=known)
    np.testing.assert_allclose(found.sky, LEVELS, atol=1e-4 * NOISE)
    error = errors(wanted)
    np.testing.assert_allclose(fluxes(found)[0] / error, fluxes(wanted)[0] / error, atol=0.05)
    np.testing.assert_allclose(errors(found), error, rtol=0.01)


def test_a_sky_of_which_nothing_is_known_is_free(device, monkeypatch):
    """The level found then changes nothing."""
    found, blend = [], scenes.blend(sky=LEVELS)
    for levels in (np.zeros(3), 3 * np.array(LEVELS)):
        expecting(monkeypatch, levels, np.inf)
        found.append(scenes.fit(blend, device, settings=Settings(fit_sky=True)))
        (message,) = [m for m in found[-1].messages if m.startswith("e: the sky is fitted")]
        assert "v not at all" in message
    error = errors(found[0])
    np.testing.assert_allclose(fluxes(found[1])[0] / error, fluxes(found[0])[0] / error, atol=0.1)
    np.testing.assert_allclose(found[1].sky, found[0].sky, atol=0.02 * NOISE)


def test_a_sky_between_is_weighed_with_the_data(device, monkeypatch):
    """A level that is off by two of its errors, as large as those of the data, ends between."""
    blend, free = scenes.blend(), Settings(fit_sky=True)
    expecting(monkeypatch, np.zeros(3), np.inf)
    alone = scenes.fit(blend, device, settings=free)
    n = np.repeat([o.data[0].size for o in blend.observations], [1, 2])
    expecting(monkeypatch, alone.sky + 2 * NOISE / np.sqrt(n), NOISE / np.sqrt(n[0]))
    both = scenes.fit(blend, device, settings=free)
    part = (both.sky - alone.sky) / (2 * NOISE / np.sqrt(n))
    assert (0.2 < part).all() and (part < 0.95).all()
    assert (errors(both) < 1.001 * errors(alone)).all()


def test_a_clean_image_keeps_its_fluxes(device):
    """Whose sky is 0: with the sky fitted fluxes move by far less than their errors, which grow."""
    blend = scenes.blend(shape=(60, 72))
    plain, free = (scenes.fit(blend, device, settings=Settings(fit_sky=s)) for s in (False, True))
    error = errors(free)
    assert np.abs((fluxes(free)[0] - fluxes(plain)[0]) / error).max() < 0.5
    assert (error > 0.99 * errors(plain)).all()
    true = np.array([flux for _, flux, _ in scenes.GALAXIES])
    assert np.abs((fluxes(free)[0] - true) / error).max() < 3.5
