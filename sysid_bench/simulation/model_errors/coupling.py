"""Coupling errors: dependent joints that follow with another slope than the model has."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.coupling.constraints import PolynomialCoupling
from sysid_bench.models.coupling.equalities import equalities_of
from sysid_bench.models.offset_robot import with_scaled_coupling
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, joint_size


@dataclass(frozen=True)
class CouplingError:
    """Relative error `error` of the slope of each coupling between joints: mimics, and equalities
    of joints or fixed tendons. Closed chains have none; their links have kinematic errors.

    Belts and linkages of grippers err by 0.1 to 2 % (to be verified).
    """

    error: Size = field(default=0.005, metadata={"unit": "%"})
    sizes: ClassVar[tuple[str, ...]] = ("error",)

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the couplings that a list of errors is for."""
        return tuple(_couplings(robot))

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with these slopes; nothing is drawn."""
        couplings = _couplings(robot)
        error = joint_size(self.error, list(couplings), "error")
        if not error.any():
            return robot
        factors = dict(zip(couplings.values(), 1.0 + error, strict=True))
        return with_scaled_coupling(robot, factors)


def _couplings(robot: RobotModel) -> dict[str, int]:
    """Number of each joint or tendon equality of the robot's model, by its name."""
    if robot.coupling is None:
        return {}
    found = equalities_of(robot.mj)
    return {
        constraint.name: e
        for e, constraint in zip(found.ids, found.constraints, strict=True)
        if isinstance(constraint, PolynomialCoupling)
    }
