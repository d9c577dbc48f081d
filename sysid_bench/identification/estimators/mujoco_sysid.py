"""The optimiser of `mujoco.sysid` on closed-loop simulations, within a budget."""

from dataclasses import dataclass

from sysid_bench.identification.simulation_based.simulated_fit import SimulatedFit
from sysid_bench.optimisers.mujoco_sysid import MujocoSysid
from sysid_bench.types import Estimate, Experiment


@dataclass(frozen=True)
class FitMujocoSysid:
    """min sum ((x - x_s(theta)) / RMS(x))^2 by `mujoco.sysid.optimize` (extra `peers`), x_s the
    `signal` "torque" or "position" of the simulated closed loop.

    Gauss-Newton with Levenberg-Marquardt damping between bounds, the toolbox's default, with
    forward differences, r simulations per Jacobian. Coordinates, start and simulator as all peers
    (simulated_fit.py), in place of the toolbox's own rollouts of recorded torques, which are
    unstable over a whole motion. Stops by its default tolerances, or at the end of the `budget`,
    "10 s" of CPU time or "500 simulations" (None: no limit): then the best candidate simulated is
    the answer, `converged` is false, and that of a CPU time depends on the clock. It has no
    covariance. Assumes the controller as declared.
    """

    budget: str | None = "10 s"
    signal: str = "torque"

    def __post_init__(self) -> None:
        """Raise UsageError for a budget or a signal that there is not."""
        self._fit()

    def fit(self, experiment: Experiment) -> Estimate:
        """Return theta; raises UnsupportedError without the toolbox or where the recording declares
        no controller, SimulationError where the start cannot be simulated."""
        return self._fit().fit(experiment)

    def _fit(self) -> SimulatedFit:
        return SimulatedFit(MujocoSysid(), self.budget, self.signal)
