"""Recursive least squares with exponential forgetting."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.normal_qr import inverse_of, require_excited, solve_upper
from sysid_bench.identification.linear.recursive_qr import update
from sysid_bench.identification.linear.weights import row_sigmas
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class RLS:
    """Sample after sample, what came before counting `forgetting` times as much each time; the
    answer is that of the last sample.

    The square-root form (a QR update of [R | z] per block): no start value, and no drift of
    rounding errors. Rows are divided by the noise of their joint (as `wls`); with forgetting 1 the
    answer is that of `wls`. Covariance for white noise of constant parameters. Ljung and
    Soederstroem (1983); Haykin, Adaptive Filter Theory, on square-root filters. Assumes W exact.
    """

    forgetting: float = 0.999

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the samples that are remembered do not excite
        every direction."""
        if not 0 < self.forgetting <= 1:
            raise UsageError(f"Forgetting is {self.forgetting}; it lies above 0 and up to 1.")
        sigma = row_sigmas(problem)
        R = update(problem, sigma, self.forgetting)
        require_excited(R * np.append(np.ones(problem.base.rank), 0.0))
        inverse = inverse_of(R)
        # Weights g^(N - k) make the covariance H^-1 H2 H^-1, H2 with the weights squared.
        squared = update(problem, sigma, self.forgetting**2)[:-1, :-1]
        spread = inverse @ inverse.T @ squared.T
        memory = float(np.sum(self.forgetting ** np.arange(problem.samples)))
        return Estimate(solve_upper(R), covariance=spread @ spread.T, stats={"memory": memory})
