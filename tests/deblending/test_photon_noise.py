"""Weights without the photon noise of the sources' light are named, other misfits are not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.blends import blend, observe, round_component

from clresample.deblending.assessment.photon_noise import photon_noise_lines
from clresample.deblending.assessment.status import with_misfit_status
from clresample.sky.grid import Grid

GRID, GAIN = Grid.flat((60, 60), 0.1), 0.4


def seen(*, photons=True, stated=0.0, moved=0.0, size=4.0, seed=0):
    """A galaxy of 300 counts at its peak, whose weights state a noise of 1 count, and its model.

    stated [1]: part of the photon noise that weights have; moved [px]: of the model; size [px]: its
        sigma, 4 of the galaxy
    """
    spectrum, rng = (300.0, 200.0), np.random.default_rng(seed)
    part = round_component(0, (30, 30), spectrum, n=51, sigma=4.0)
    truth = blend([part], grid=GRID, observations=(observe(GRID, ("g", "r")),))
    light = truth.model(0)
    noise = rng.normal(size=light.shape) * np.sqrt(1 + photons * light / GAIN)
    given = observe(GRID, ("g", "r"), data=light + noise, weights=1 / (1 + stated * light / GAIN))
    other = round_component(0, (30 + moved, 30), spectrum, n=51, sigma=size)
    covariance = np.tile(np.eye(1) * 1e-4, (2, 1, 1))
    return blend([other], grid=GRID, observations=(given,), covariance=covariance)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stated", [0.0, 0.2])
def test_missing_photon_noise_is_named_with_the_gain(stated, seed):
    result = with_misfit_status(seen(stated=stated, seed=seed))
    assert result.status == "misfit" and "photons" in result.messages[0]
    (line,) = photon_noise_lines(result)
    gains = [float(part.split()[0]) for part in line.partition("near ")[2].split(", ")]
    assert gains == pytest.approx([GAIN, GAIN], rel=0.15)


@pytest.mark.parametrize("given", [{"size": 4.4}, {"size": 3.7}, {"moved": 0.5}])
@pytest.mark.parametrize("photons", [False, True])
def test_errors_of_a_model_are_no_photon_noise(given, photons):
    """Neighbouring pixels have them alike."""
    result = with_misfit_status(seen(photons=photons, **given))
    assert result.status == "misfit" and photon_noise_lines(result) == []


def test_noise_as_stated_is_none():
    assert photon_noise_lines(seen(photons=False)) == []
    few = seen()
    part = replace(few.components[0], spectrum=0.001 * few.components[0].spectrum)
    assert photon_noise_lines(replace(few, components=(part,))) == []
