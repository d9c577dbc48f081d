"""CLOE: closed-loop output error, positions of the simulated closed loop."""

from dataclasses import dataclass

from sysid_bench.identification.optimisers import parse_budget, with_budget
from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    simulatable_start,
)
from sysid_bench.identification.simulation_based.output_error import output_error
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class CLOE:
    """min sum |S^-1/2 (q - q_s(beta))|^2, q_s the simulated position of the closed loop.

    The model runs under the declared controller along the commanded motion; S is the noise variance
    per joint, from the residuals. Gauss-Newton (gauss_newton.py) with the Jacobian of sensitivity
    equations (tracking_sensitivity.py) and Broyden updates, which for the last steps finite
    differences correct, r simulations at an iterate within one standard deviation. Stops at a step
    below 0.1 standard deviations, of 20 iterations the problems of the conformance kit take 3;
    or at the end of a `budget`, "10 s" of CPU time or "500 simulations" (None: no limit), with the
    last accepted iterate. Positions under a stiff controller hardly depend on the inertias, so that
    it needs exact gains. Walter and Pronzato (1997); Janot, Gautier, Jubien, Vandanjon (2014).
    """

    iterations: int = 20
    budget: str | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for a budget that there is not."""
        parse_budget(self.budget)

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UnsupportedError where the recording declares no controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        return GaussNewton(self.iterations).run(
            output_error(experiment, simulatable, _positions), simulatable, start
        )


def _positions(experiment: Experiment, recording: Recording) -> Array:
    return recording.q
