"""How a fit goes: prior, constraints, steps, limits."""

from __future__ import annotations

from dataclasses import dataclass, field

from .solver.amsgrad import StepSizes
from .solver.constraints import Chain, MaxNorm, Monotone, Positivity, SumNorm
from .solver.prior import Prior


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a fit goes.

    max_iter: most iterations; tol: a fit ends when its best loss falls by less than this part of
        itself over 15 iterations
    prior: the Prior of extended sources' morphologies about their smooth profiles; None fits the
        morphologies themselves, by the constraints alone
    constraints: Chain of proximal operators on the morphologies: non-negative, and monotone by the
        sweep
    step_sizes: the solver's StepSizes
    fit_shifts: let each observation but the first move by a constant shift
    fit_sky: fit a constant per channel
    """

    max_iter: int = 300
    tol: float = 1e-5
    prior: Prior | None = Prior()
    constraints: Chain = field(default_factory=lambda: Chain(Positivity(), Monotone()))
    step_sizes: StepSizes = StepSizes()
    fit_shifts: bool = False
    fit_sky: bool = False

    def __post_init__(self):
        if self.max_iter < 0:
            raise ValueError(f"max_iter is {self.max_iter}, must be 0 or more")
        if not 0 <= self.tol < 1:
            raise ValueError(f"tol is {self.tol}, must be at least 0 and under 1")
        scaling = [p for p in self.constraints.steps() if isinstance(p, MaxNorm | SumNorm)]
        if self.prior is not None and scaling:
            raise ValueError(
                f"constraints hold {scaling[0]!r}, but with a prior the profiles set the "
                "scale of the morphologies: leave it out, or give prior=None"
            )
