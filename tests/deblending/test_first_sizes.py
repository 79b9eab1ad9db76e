"""Sizes of large galaxies before the least squares of all shapes: from a grid, brightest first."""

import numpy as np
import pytest
from helpers.scenes import blend

from clresample import Settings
from clresample.deblending.fit import Fit, begin
from clresample.deblending.start import profile_fit
from clresample.deblending.start.first_sizes import GROWTH, first_sizes

GIANT = ((48.2, 47.6), (3e5, 2e5, 2.5e5), 14.0)
SMALL = [
    ((48 + 22 * np.sin(a), 48 + 22 * np.cos(a)), (200, 260, 150), 1.5)
    for a in (0.3, 1.6, 2.8, 4.1, 5.4)
]


@pytest.mark.parametrize("at", [0, 3, 5])
def test_a_giant_among_satellites_is_the_one_that_is_large(device, at):
    """In whatever place it is listed: least squares from the expected sizes give its light to
    several of them."""
    objects = [*SMALL[:at], GIANT, *SMALL[at:]]
    one = Fit(blend(objects, shape=(96, 96), seed=5), Settings(), device, np.float32, pad=1)
    begin([one])
    sizes = np.array([theta[0] for theta in one.start.thetas])
    assert sizes[at] == pytest.approx(np.log(GIANT[2]), abs=0.05)
    assert (np.delete(sizes, at) < np.log(1.5 * GROWTH)).all()


def test_sizes_of_small_galaxies_are_left_alone(device, monkeypatch):
    """Noise and neighbours are no reason for another size."""
    kept = []

    def noted(looking, thetas, error):
        before = [theta.copy() for theta in thetas]
        kept.append((before, first_sizes(looking, thetas, error)))
        return kept[-1][1]

    monkeypatch.setattr(profile_fit, "first_sizes", noted)
    one = Fit(blend(SMALL, shape=(96, 96), seed=6), Settings(), device, np.float32, pad=1)
    begin([one])
    ((before, after),) = kept
    np.testing.assert_array_equal(before, after)
