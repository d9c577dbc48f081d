"""The optimiser of `mujoco.sysid` on closed-loop simulations, within a budget."""

from dataclasses import dataclass

from sysid_bench.identification.optimisers.mujoco_sysid import MujocoSysid
from sysid_bench.identification.optimisers.search import Optimiser
from sysid_bench.identification.simulation_based.simulated_fit import SimulatedFit


@dataclass(frozen=True)
class FitMujocoSysid(SimulatedFit):
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

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser, with its default tolerances."""
        return MujocoSysid()
