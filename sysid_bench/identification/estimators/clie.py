"""CLIE: closed-loop input error."""

from dataclasses import dataclass

from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    requires_controller,
    rows_of,
)
from sysid_bench.identification.simulation_based.output_error import OutputError
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class CLIE:
    """min sum |tau - tau_s(beta)|^2, each joint over its own noise, tau_s the torque of the model
    under the declared controller along the commanded motion (Janot, Gautier, Jubien, Vandanjon
    2014).

    Gauss-Newton with r simulations per step: what DIDIM takes from one regressor is differenced
    here, so that how the motion itself hangs on beta counts as well.
    """

    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate; raises EstimationError where the iteration does not settle."""
        room, start = requires_controller(experiment)
        return GaussNewton(self.iterations).run(
            OutputError(experiment, room, _torques), room, start
        )


def _torques(experiment: Experiment, recording: Recording) -> Array:
    return rows_of(experiment, recording.tau)
