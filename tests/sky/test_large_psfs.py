"""Large PSF images on turned axes: transformed by an FFT, as exactly as by the sum."""

import time

import numpy as np
import pytest

from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.sky import psf as module
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

MATRIX = np.array([[1.4, 0.5], [-0.6, 1.3]])


def moffat(n, center=None):
    y, x = np.indices((n, n - 8)) - np.reshape([(n - 1) / 2, (n - 9) / 2], (2, 1, 1))
    return PSF((1 + (y**2 + 0.8 * x**2) / 16) ** -2.5, spacing=0.7, center=center)


@pytest.mark.filterwarnings("ignore::clresample.sky.psf_checks.PSFWarning")
@pytest.mark.parametrize("center", [None, (31.3, 28.9)])
def test_both_ways_are_one(monkeypatch, center):
    psf = moffat(61, center)
    nu = np.arange(0, 30) / 61
    both = np.concatenate([-nu[:0:-1], nu])
    found = []
    for large in (10**9, 1):
        monkeypatch.setattr(module, "LARGE", large)
        found.append(psf.otf(nu, both, MATRIX))
    np.testing.assert_allclose(found[1], found[0], atol=2e-14)
    assert np.abs(found[0]).max() > 0.5


def test_no_sum_over_all_pixels_of_a_large_image(monkeypatch):
    """The set-up of an operator between turned grids: all transforms of large images by FFTs."""
    sizes, real = [], module.nufft_type2
    monkeypatch.setattr(
        module, "nufft_type2", lambda *a: sizes.append((a[0].size, a[1].size)) or real(*a)
    )

    def direct(_):
        raise AssertionError("a sum over all samples for each frequency")

    monkeypatch.setattr(module, "_parts", direct)
    n, turned = 1000, Grid.flat((20, 20), 0.2, angle_deg=30)
    mapping = turned.map_to(Grid.flat((40, 40), 0.1))
    make_resampling_plan(mapping, moffat(n), moffat(n), precision=Precision.of(np.float32))
    assert sizes and all(samples <= n * n for samples, _ in sizes)
    assert sum(frequencies for _, frequencies in sizes) < 4e6  # some 5 us each


def test_a_thousand_pixels_a_side_are_no_burden():
    psf = moffat(1000)
    nu = np.arange(0, 150) / 415
    began = time.process_time()
    otf = psf.otf(nu, np.concatenate([-nu[:0:-1], nu]), MATRIX)
    assert time.process_time() - began < 20  # the sum takes a minute
    assert otf[0, 0, 149] == pytest.approx(1, abs=1e-12)
