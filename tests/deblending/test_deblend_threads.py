"""Fits of equal geometry in several threads, which share operators and Settings: as alone."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.scenes import GALAXIES, observe

from clresample.deblending.batch import deblend
from clresample.deblending.settings import Settings
from clresample.paper.settings import PaperSettings
from clresample.sky.sources import ExtendedSource

N_THREADS, N_SCENES = 3, 2


@pytest.mark.parametrize("prior", ["learned", None])
@pytest.mark.parametrize("fit_shifts", [False, True])
def test_fits_in_threads_are_those_alone(device, prior, fit_shifts):
    given = {} if prior else {"prior": None}
    settings = (PaperSettings if given else Settings)(max_iter=25, fit_shifts=fit_shifts, **given)
    seen = [observe(seed=i) for i in range(N_SCENES)]
    sources = [ExtendedSource(position_px=position) for position, _, _ in GALAXIES]

    def fit(i):
        return deblend(seen[i], sources, settings=settings, device=device)

    alone = [fit(i) for i in range(N_SCENES)]
    with ThreadPoolExecutor(N_THREADS) as pool:
        found = list(pool.map(fit, 2 * list(range(N_SCENES))))
    for i, result in enumerate(found):
        truth = alone[i % N_SCENES]
        for a, b in zip(result.components, truth.components, strict=True):
            np.testing.assert_array_equal(a.morphology, b.morphology)
            np.testing.assert_array_equal(a.spectrum, b.spectrum)
        np.testing.assert_array_equal(result.losses, truth.losses)
        np.testing.assert_array_equal(result.shifts, truth.shifts)
