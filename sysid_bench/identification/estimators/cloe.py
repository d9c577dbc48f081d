"""CLOE: closed-loop output error."""

from dataclasses import dataclass

from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    requires_controller,
)
from sysid_bench.identification.simulation_based.output_error import OutputError
from sysid_bench.types import Array, Estimate, Experiment, Recording


@dataclass(frozen=True)
class CLOE:
    """min sum |q - q_s(beta)|^2, each joint over its own noise, q_s the position of the model under
    the declared controller along the commanded motion (Walter, Pronzato 1997; Janot, Gautier,
    Jubien, Vandanjon 2014).

    Gauss-Newton with r simulations per step. Positions of a good loop hardly depend on what the
    robot weighs, and controller gains must be right: DIDIM needs less of both.
    """

    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate; raises EstimationError where the iteration does not settle."""
        room, start = requires_controller(experiment)
        return GaussNewton(self.iterations).run(
            OutputError(experiment, room, _positions), room, start
        )


def _positions(experiment: Experiment, recording: Recording) -> Array:
    return recording.q
