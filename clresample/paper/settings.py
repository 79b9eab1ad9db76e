"""Settings of a fit by the paper's method."""

from __future__ import annotations

from dataclasses import dataclass

from ..deblending.settings import FitSettings, check_fraction
from ..sky.validation.checks import check_instance
from .run import AmsgradRun, start_run
from .solver.amsgrad import StepSizes
from .solver.constraints import MaxNorm, Monotone, Positivity, ProxChain, SumNorm
from .solver.prior import SingleScalePrior


@dataclass(frozen=True, kw_only=True)
class PaperSettings(FitSettings):
    """Settings of a fit by the adaptive proximal gradients of Melchior et al. (2019).

    Fluxes have the errors of fixed morphologies.

    prior: None: the morphologies themselves are fitted, by the constraints alone;
        SingleScalePrior: structure of one scale and strength about a smooth profile
    rel_tol: a fit has converged when its best loss fell by less than this part of itself over 15
        iterations
    constraints: ProxChain of proximal operators on the morphologies; None: non-negative, and
        monotone by the sweep
    step_sizes: StepSizes
    max_iter, fit_shifts, fit_sky, psf_error, psf_tolerance: see Settings

    Source: Melchior et al. 2019 (arXiv:1910.10094).
    """

    prior: SingleScalePrior | None = None
    rel_tol: float = 1e-5
    constraints: ProxChain | None = None
    step_sizes: StepSizes = StepSizes()

    def __post_init__(self):
        super().__post_init__()
        check_fraction("rel_tol", self.rel_tol)
        for name, kind in (("prior", SingleScalePrior), ("constraints", ProxChain)):
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

    @property
    def constraint_chain(self) -> ProxChain:
        """The constraints, or the default ones where none are given."""
        return self.constraints or ProxChain(Positivity(), Monotone())

    def start_run(self, fits, device, dtype, takes_over=None) -> AmsgradRun:
        """See `FitSettings.start_run`; no other fit takes over."""
        return start_run(fits, self, device, dtype)
