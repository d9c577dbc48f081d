"""Recursive least squares with exponential forgetting."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.least_squares import (
    check_rank,
    inverse_of,
    row_noise,
    solve_factor,
)
from sysid_bench.identification.linear.recursive_qr import update
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class RLS:
    """Recursive least squares; sample k of N counts with the weight forgetting^(N - k).

    Square-root form (QR update of [R | z] per block): no start value, no accumulated rounding. Rows
    are divided by the noise of their joint (as `wls`, which forgetting = 1 reproduces). The default
    0.999 remembers about 1000 samples. Covariance for white noise and constant parameters. Assumes
    W exact. Ljung and Soederstroem (1983); Haykin, Adaptive Filter Theory.
    """

    forgetting: float = 0.999

    def solve(self, problem: Problem) -> Estimate:
        """Return beta after the last sample and its covariance; raises EstimationError where the
        remembered samples do not excite every direction, UsageError for an invalid forgetting
        factor."""
        if not 0 < self.forgetting <= 1:
            raise UsageError(f"forgetting is {self.forgetting}; it must be above 0 and at most 1.")
        sigma = row_noise(problem)
        R = update(problem, sigma, self.forgetting)
        check_rank(R * np.append(np.ones(problem.base.rank), 0.0))
        inverse = inverse_of(R)
        # Weights g^(N - k) make the covariance H^-1 H2 H^-1, H2 with the weights squared.
        squared = update(problem, sigma, self.forgetting**2)[:-1, :-1]
        spread = inverse @ inverse.T @ squared.T
        memory = float(np.sum(self.forgetting ** np.arange(problem.samples)))
        return Estimate(solve_factor(R), covariance=spread @ spread.T, stats={"memory": memory})
