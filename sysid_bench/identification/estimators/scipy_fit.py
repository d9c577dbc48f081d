"""SciPy's nonlinear least squares on closed-loop simulations, within a budget."""

from dataclasses import dataclass

from sysid_bench.identification.optimisers.least_squares import LeastSquares
from sysid_bench.identification.optimisers.search import Optimiser
from sysid_bench.identification.simulation_based.simulated_fit import SimulatedFit


@dataclass(frozen=True)
class FitScipy(SimulatedFit):
    """min sum ((x - x_s(theta)) / RMS(x))^2 by `scipy.optimize.least_squares` (Branch, Coleman, Li
    1999), x_s the `signal` "torque" or "position" of the simulated closed loop.

    Coordinates, start and simulator as all peers (simulated_fit.py); forward differences, r
    simulations per Jacobian. Stops by SciPy's default tolerances, or at the end of the `budget`,
    "10 s" of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is
    the answer, `converged` is false, and that of a CPU time depends on the clock. It has no
    covariance. Assumes the controller as declared.
    """

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return LeastSquares()
