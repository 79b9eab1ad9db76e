"""Settings of a fit: prior, constraints, steps, limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sky.validation.checks import check_instance, check_integer, check_number
from .solver.amsgrad import StepSizes
from .solver.constraints import MaxNorm, Monotone, Positivity, ProxChain, SumNorm
from .solver.multiscale.prior import MultiscalePrior
from .solver.prior import SingleScalePrior

AUTO = "auto"  # fit_shifts: by measurement


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a fit.

    max_iter: largest number of iterations; a second fit, with more components, may take twice as
        many, and a continued first fit as many again
    prior: prior on the structure of extended sources, which also selects the solver.
        MultiscalePrior: structure at several scales, with strengths determined by each source's
        data, by L-BFGS. SingleScalePrior: structure of one scale and strength. None: morphologies
        with the constraints only. The latter two use the adaptive proximal gradients of Melchior
        et al. (2019)
    loss_tol: with a MultiscalePrior a fit has converged when the loss (half chi2) fell by less than
        `loss_tol` over 5 iterations and a joint Newton step would gain less than a fifth of that.
        Both limits scale with chi2 per pixel where it exceeds 1. With 0.5 fits take a tenth fewer
        iterations, and where fits of Euclid's or Rubin's images alone go on, over 1 in 100 fluxes
        move by more than 0.2 errors; with 0.25 about 1 in 200 (`bench.settings --continued`)
    rel_tol [1]: with other priors a fit has converged when its best loss fell by less than this
        fraction of itself over 15 iterations
    constraints: with other priors, ProxChain of proximal operators on the morphologies; None =
        non-negative, and monotone by the sweep. With a MultiscalePrior morphologies are only
        non-negative: monotonicity does not improve models of simulated galaxies, and real galaxies
        are not monotone
    step_sizes: with other priors, their StepSizes
    fit_shifts: fit a constant shift of each observation but the first. "auto" = only if light of
        isolated sources differs in position by over 0.25 model pixels and 3 sigma between two
        observations (inspection/shifted.py), starting from the measured shift
    fit_sky: fit a constant per channel. Its prior is Gaussian, with the level of source-free pixels
        and its error (inspection/levels.py), so that it does not absorb light of wide sources. If
        no pixel is free of sources the constant is unconstrained
    flux_error_floor: relative systematic flux error with a MultiscalePrior, added in quadrature,
        the same for all channels of a source. It covers model errors of bright galaxies, photon
        noise missing from the weights, and PSF errors. It applies to a galaxy that equals its
        smooth profile, and grows with the cube of the structure in the data, to 0.4 % for a typical
        bright galaxy of COSMOS and 1.4 % at most. Simulated parametric galaxies need no larger
        value; with smaller values the coverage of COSMOS galaxies is too low. PSFs that are wrong
        by a percent require 0.01
    errors: with a MultiscalePrior, compute errors that include morphologies and neighbours. False
        takes two thirds of the time; then flux errors are those at fixed morphologies, and sizes
        have none
    psf_error [1]: relative error of PSF widths. This fraction of a bright point source's light,
        and more in its wings, is added to the noise of its pixels, so that residuals of a star are
        not fitted by its neighbours. The weights use the stars' light at the start of the fit, and
        are then constant. Stars whose error is below 0.05 sigma everywhere have no effect. Beside a
        star of signal to noise 1e4 whose PSF is 1 % too narrow, the SDR of galaxies increases from
        7.5 to 12.9 dB (12.9 also with a correct PSF), and their flux errors by a quarter. Larger
        values allow for worse PSFs, and cost precision
    psf_tolerance [1]: largest error of each source's PSF if PSFs vary over an observation
        (PSFField), relative to the norm of its samples (PSFBasis.max_error). Fits use different
        PSFs for sources if the PSF varies by more. With 0.001 a star of signal to noise 1000 has an
        error of one sigma in all its pixels together, and fluxes change by at most about 0.1 %,
        less than flux_error_floor; PSFs are measured to 0.2 to 1 %. Larger values need fewer terms,
        each of which adds 10 to 20 % to a fit's time; 0 = each source's own PSF exactly
    """

    max_iter: int = 500
    prior: MultiscalePrior | SingleScalePrior | None = MultiscalePrior()
    loss_tol: float = 0.25
    rel_tol: float = 1e-5
    constraints: ProxChain | None = None
    step_sizes: StepSizes = StepSizes()
    fit_shifts: bool | str = "auto"
    fit_sky: bool = False
    flux_error_floor: float = 0.0005
    errors: bool = True
    psf_error: float = 0.03
    psf_tolerance: float = 1e-3

    def __post_init__(self):
        check_integer("max_iter", self.max_iter)
        check_number("loss_tol", self.loss_tol, "0 or more", lambda x: x >= 0)
        for name in ("rel_tol", "flux_error_floor", "psf_error", "psf_tolerance"):
            check_number(name, getattr(self, name), "at least 0 and under 1", lambda x: 0 <= x < 1)
        for name in ("fit_sky", "errors"):
            check_instance(name, getattr(self, name), (bool, np.bool_))
        if not isinstance(self.fit_shifts, (bool, np.bool_)) and self.fit_shifts != AUTO:
            raise ValueError(f'fit_shifts is {self.fit_shifts!r}, must be True, False or "{AUTO}"')
        for name, kind in (
            ("prior", (MultiscalePrior, SingleScalePrior)),
            ("constraints", ProxChain),
        ):
            if getattr(self, name) is not None:
                check_instance(name, getattr(self, name), kind)
        check_instance("step_sizes", self.step_sizes, StepSizes)
        steps = self.constraint_chain.steps()
        scaling = [p for p in steps if isinstance(p, MaxNorm | SumNorm)]
        if self.prior is not None and scaling:
            raise ValueError(
                f"constraints hold {scaling[0]!r}, but with a prior the profiles set the "
                "scale of the morphologies: leave it out, or give prior=None"
            )
        others = [p for p in steps if not isinstance(p, Positivity)]
        if self.has_multiscale_prior and others:
            raise ValueError(
                f"constraints hold {others[0]!r}, but with a MultiscalePrior morphologies are "
                "non-negative and nothing else: leave it out, or give prior=SingleScalePrior()"
            )

    @property
    def has_multiscale_prior(self) -> bool:
        """True if the prior is a MultiscalePrior."""
        return isinstance(self.prior, MultiscalePrior)

    @property
    def constraint_chain(self) -> ProxChain:
        """The constraints, or those that go with the prior where none are given."""
        if self.constraints is not None:
            return self.constraints
        return (
            ProxChain(Positivity())
            if self.has_multiscale_prior
            else ProxChain(Positivity(), Monotone())
        )
