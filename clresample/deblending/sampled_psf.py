"""PSFs sampled on the model's own pixels, and the waves that these alias.

A space telescope's PSF has waves shorter than two of its pixels. Its pixels show them as longer
waves, whose phases follow from the star's position. The model's PSF is smooth and has nearly none.
With its waves alone a star between two pixels of Euclid would be rendered with an error as bright
as its own diffraction rings.
"""

from __future__ import annotations

import functools

import numpy as np

from ..sky.frame import MIN_TRANSFER
from .inspection.star_psfs import StarPSFs

# [px] Largest distance of a frame's pixels from those of an observation on which it lies: the
# phase of a wave of one pixel is then right within 0.1.
MAX_OFFSET_PX = 0.02
# [px] Largest distance from a star at which its PSF's samples count.
MAX_REACH_PX = 64
# [1] Mean transfer of waves of two pixels below which a PSF is as if sampled on the pixels: that of
# Moffat profiles from 2.5 px of FWHM on. A galaxy of signal to noise 20 beside a star has its flux
# there, not half of it; with 0.01 one beside a bright star of 2.2 px has a fourth too much
# (tests/deblending/test_sampled_psf.py, with such PSFs).
MIN_ALIASED = 0.004
# Number of cached tables of `alias_tables`, of 1.5 MB each, 7 MB for saturated stars.
N_TABLES = 8
N_PSFS, N_WAVES = 32, 17  # of cached results of `is_aliased`, and of waves along each axis


def sampled_psfs(frame, observations, position) -> tuple:
    """PSFs at a position (2,) [px of the frame] of all observations on whose pixels it lies.

    Only those of PSFs that are `is_aliased`. Stars whose PSFs of their own do not keep the core
    are left out: these were measured on the pixels themselves.
    """
    found = []
    pixels = np.asarray(position) + [[0, 0], [1, 0], [0, 1]]
    for o in observations:
        if o.psf.spacing >= 1:
            continue
        places = frame.grid.positions_in(o.grid, *pixels.T)
        steps = places - pixels
        if not np.abs(steps - np.rint(steps[0])).max() < MAX_OFFSET_PX:
            continue
        field, place = o.psf_field, np.clip(places[0], 0, np.array(o.data.shape[1:]) - 1)
        if isinstance(field, StarPSFs):
            star = field.number_at(*place)
            keeps_core = star is None or field.keeps_core[star]
            found += [field.passed_at(*place)] if keeps_core else []
        else:
            found.append(o.psf if field is None else field.psf_at(*place))
    return tuple(psf for psf in found if is_aliased(psf))


@functools.lru_cache(maxsize=N_PSFS)
def is_aliased(psf) -> bool:
    """Returns True if the mean transfer of a PSF's waves of two pixels is above MIN_ALIASED.

    Only PSFs sampled more finely than the pixels have shorter waves, sharp ones alone.
    """
    nu, limit = np.linspace(-0.5, 0.5, N_WAVES), np.array([0.5])
    sides = psf.otf(limit, nu).ravel(), psf.otf(nu, limit).ravel()
    return psf.spacing < 1 and bool(np.abs(sides).mean() > MIN_ALIASED)


def reach_px(psfs) -> int:
    """Distance [px] from a star within which PSFs have samples, at most MAX_REACH_PX."""
    sides = [max(psf.images.shape[1:]) * psf.spacing for psf in psfs]
    return min(int(np.ceil(max(sides, default=0) / 2)), MAX_REACH_PX)


@functools.lru_cache(maxsize=N_TABLES)
def alias_tables(psfs, n_fft):
    """Parts of the waves nu + m in wave nu of a star on pixels, and the model's part beside them.

        T_m(nu) = P^*(nu) P^(nu + m) / (|P^(nu)|^2 + e^2),   e^2 / (|P^(nu)|^2 + e^2)

    P: mean of all bands of the PSFs
    e: MIN_TRANSFER, below which the waves are those of the model's PSF
    returns (3, 3, n_fft, n_fft // 2 + 1), m = -1, 0, 1 along y and x, and
        (n_fft, n_fft // 2 + 1), in the order of a real FFT; in float32, as images are drawn
    """
    nu_y, nu_x = np.fft.fftfreq(n_fft), np.fft.rfftfreq(n_fft)
    m = np.array([-1, 0, 1])[:, None]
    waves = (m + nu_y).ravel(), (m + nu_x).ravel()
    bands = np.concatenate([psf.otf(*waves) for psf in psfs])
    mean = bands.mean(axis=0).reshape(3, len(nu_y), 3, len(nu_x)).transpose(0, 2, 1, 3)
    power = np.abs(mean[1, 1]) ** 2 + MIN_TRANSFER**2
    parts = mean * (mean[1, 1].conj() / power), MIN_TRANSFER**2 / power
    return parts[0].astype(np.complex64), parts[1].astype(np.float32)
