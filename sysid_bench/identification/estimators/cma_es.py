"""CMA-ES on closed-loop simulations, within a budget."""

from dataclasses import dataclass

from sysid_bench.errors import UsageError
from sysid_bench.identification.optimisers.cma_es import CmaEs
from sysid_bench.identification.optimisers.search import Optimiser
from sysid_bench.identification.simulation_based.simulated_fit import SimulatedFit


@dataclass(frozen=True)
class FitCmaEs(SimulatedFit):
    """min sum ((x - x_s(theta)) / RMS(x))^2 by the covariance matrix adaptation evolution strategy
    (Hansen 2016, package `cma`, extra `peers`), x_s the `signal` "torque" or "position" of the
    simulated closed loop.

    Coordinates, start and simulator as all peers (simulated_fit.py), without derivatives: 4 + 3 ln
    r simulations per generation. `sigma` is the first deviation of every coordinate; 0.1 is about
    10 % of a mass. Stops by the package's default tolerances, or at the end of the `budget`, "10 s"
    of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is the
    answer, `converged` is false, and that of a CPU time depends on the clock. It has no covariance.
    Assumes the controller as declared.
    """

    sigma: float = 0.1
    seed: int = 1

    def __post_init__(self) -> None:
        """Raise UsageError for a budget or a signal that there is not, a sigma that is not
        positive, or a seed below 1."""
        super().__post_init__()
        if not (self.sigma > 0 and self.seed >= 1):
            raise UsageError("sigma is a positive number, and seed a whole number of 1 or more.")

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return CmaEs(self.sigma, self.seed)
