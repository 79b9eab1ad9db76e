"""Settings of a fit: prior, limits, what else is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.validation.checks import check_instance, check_integer, check_number
from .iterate import LbfgsRun
from .solver.multiscale.engine import vector_bytes
from .solver.multiscale.prior import MultiscalePrior
from .start.profile_fit import CHI2_TOL

AUTO = "auto"  # fit_shifts, fit_sky: by measurement
SMALL = "small"  # fit_sky: a sky that was nearly subtracted


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Settings that every method of fitting has, with the run that does it.

    max_iter, fit_shifts, fit_sky, psf_error, psf_tolerance: see Settings
    """

    max_iter: int = 500
    fit_shifts: bool | str = "auto"
    fit_sky: bool | str = "auto"
    psf_error: float = 0.03
    psf_tolerance: float = 1e-3

    def __post_init__(self):
        check_integer("max_iter", self.max_iter)
        for name in ("psf_error", "psf_tolerance"):
            check_fraction(name, getattr(self, name))
        for name, words in (("fit_shifts", (AUTO,)), ("fit_sky", (AUTO, SMALL))):
            value = getattr(self, name)
            if not isinstance(value, (bool, np.bool_)) and value not in words:
                known = ", ".join(("True", "False", *map(repr, words)))
                raise ValueError(f"{name} is {value!r}, must be one of {known}")

    @property
    def start_tol(self) -> float:
        """Gain in chi2 below which steps of the smooth profiles at the start end."""
        return CHI2_TOL

    @property
    def adds_components(self) -> bool:
        """True if data choose the number of a galaxy's components where it is not given."""
        return False

    def start_run(self, fits, device, dtype, takes_over=None):
        """The run of Fits of one signature that have begun, as `iterate` drives it.

        takes_over: see `iterate`
        """
        raise NotImplementedError

    def solver_bytes(self, scene) -> int:
        """Device memory [bytes] that the run of a Scene takes beside the scene's, roughly."""
        return 0


@dataclass(frozen=True, kw_only=True)
class Settings(FitSettings):
    """Settings of a fit.

    max_iter: largest number of iterations; a second fit, with more components, may take twice as
        many, and a continued first fit as many again
    prior: prior on the structure of extended sources about their smooth profiles: structure at
        several scales, with strengths determined by each source's data. Morphologies are only
        non-negative: monotonicity does not improve models of simulated galaxies, and real galaxies
        are not monotone. For other methods see PaperSettings
    loss_tol: a fit has converged when the loss (half chi2) fell by less than `loss_tol` over 5
        iterations, would fall by less than a tenth of that in all further ones if it went on like
        this, and a joint Newton step would gain less than a fifth of it. From 50 iterations on,
        and 10 after the last rejected step, it may instead fall by all of it later, and by twice
        as much over 10 iterations, since only fine structure is left. The limits of a source alone
        grow with the number of parameters that its data determine, from 25 on, up to fourfold.
        The limits scale with chi2 per pixel where it exceeds 1. With 0.5 fits take a tenth fewer
        iterations, and where fits of Euclid's or Rubin's images alone go on, over 1 in 100 fluxes
        move by more than 0.2 errors; with 0.25 about 1 in 200 (`bench.settings --continued`).
        Above 0.25 the steps of the start's smooth profiles end earlier in proportion
    fit_shifts: fit a constant shift of each observation but the first. "auto" = only if light of
        isolated sources differs in position by over 0.25 model pixels and 3 sigma between two
        observations (inspection/shifted.py), starting from the measured shift
    fit_sky: fit a constant per channel. Its prior is Gaussian, with the level of source-free pixels
        and its error (inspection/levels.py), so that it does not absorb light of wide sources. If
        no pixel is free of sources the constant is unconstrained. "auto" = only in observations
        whose source-free pixels have a level of over 0.1 of a pixel's noise and 4 of its errors in
        a channel; their other channels are within 0.1 of the noise of 0. "small" = always, and
        within 0.05 of the noise where no level is shown: for skies that are nearly subtracted
    flux_error_floor: relative systematic flux error, added in quadrature,
        the same for all channels of a source. It covers model errors of bright galaxies, photon
        noise missing from the weights, and PSF errors. It applies to a galaxy that equals its
        smooth profile, and grows with the cube of the structure in the data, to 0.4 % for a typical
        bright galaxy of COSMOS and 1.4 % at most. Simulated parametric galaxies need no larger
        value; with smaller values the coverage of COSMOS galaxies is too low. PSFs that are wrong
        by a percent require 0.01
    errors: compute errors that include morphologies and neighbours. False
        takes two thirds of the time; then flux errors are those at fixed morphologies, and sizes
        have none
    psf_error [1]: relative error of PSF widths. This fraction of a bright point source's light, and
        more in its wings, is added to the noise of its pixels, so that residuals of a star are not
        fitted by its neighbours. Errors of fluxes hold it beside stars, and of sources that leave
        over 5 sigma; the status of a fit counts it as noise in stars' light. The weights use the
        stars' light at the start of the fit, and are then constant. Stars whose error is below 0.05
        sigma everywhere have no effect. Beside a star of signal to noise 1e4 whose PSF is 1 % too
        wide, the SDR of galaxies increases from 7.7 to 12.0 dB (bench.stars, docs/noise.md). Bright
        sources of the PSF's width, within this fraction, are fitted as stars, whatever they are
        listed as. Larger values allow for worse PSFs, and cost precision
    psf_tolerance [1]: largest error of each source's PSF if PSFs vary over an observation
        (PSFField), relative to the norm of its samples (PSFBasis.max_error). Fits use different
        PSFs for sources if the PSF varies by more. With 0.001 a star of signal to noise 1000 has an
        error of one sigma in all its pixels together, and fluxes change by at most about 0.1 %,
        less than flux_error_floor; PSFs are measured to 0.2 to 1 %. Larger values need fewer terms,
        each of which adds 10 to 20 % to a fit's time; 0 = each source's own PSF exactly
    """

    prior: MultiscalePrior = MultiscalePrior()
    loss_tol: float = 0.25
    flux_error_floor: float = 0.0005
    errors: bool = True

    def __post_init__(self):
        super().__post_init__()
        check_number("loss_tol", self.loss_tol, "0 or more", lambda x: x >= 0)
        check_fraction("flux_error_floor", self.flux_error_floor)
        check_instance("errors", self.errors, (bool, np.bool_))
        check_instance("prior", self.prior, MultiscalePrior)

    @property
    def start_tol(self) -> float:
        """See `FitSettings.start_tol`; larger where `loss_tol` is larger than the default."""
        return max(CHI2_TOL, CHI2_TOL * self.loss_tol / Settings.loss_tol)

    @property
    def adds_components(self) -> bool:
        """See `FitSettings.adds_components`."""
        return True

    def start_run(self, fits, device, dtype, takes_over=None) -> LbfgsRun:
        """See `FitSettings.start_run`."""
        return LbfgsRun(fits, self, device, dtype, takes_over=takes_over)

    def solver_bytes(self, scene) -> int:
        """See `FitSettings.solver_bytes`."""
        return vector_bytes(scene, self.prior)


def check_fraction(name, value):
    """Raises ValueError unless a setting is a number from 0 on and under 1."""
    check_number(name, value, "at least 0 and under 1", lambda x: 0 <= x < 1)
