"""Evaluation of a task behind a force/torque sensor: torques, contacts, unexcited directions."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from sysid_bench.evaluation.score import base_parameters
from sysid_bench.evaluation.wrench_estimation import (
    SensorNewtonEuler,
    WrenchErrors,
    sensor_newton_euler,
    wrench_errors,
)
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import PointToPoint
from sysid_bench.experiments.simulated.built_plant import BuiltPlant
from sysid_bench.experiments.spec import ExperimentSpec, noise_seed, seed_of
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.identifiability.subspaces import Excitation, excitation_of, structural_subspaces
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree, end_body
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.simulation.plant import plant_of
from sysid_bench.simulation.wrench_sensors import (
    Contact,
    contact_torque,
    random_wrench,
    sensor_wrench,
    wrench_noise,
)
from sysid_bench.types import Array, Estimate, Problem, Row, Trajectory, Truth

TOUCH: Final = 5.0
"""N of the contact force that is estimated; its moment is a tenth of it in N m."""

RATE: Final = 50.0
"""Hz of the motion with the contact."""


@dataclass(frozen=True, eq=False)
class ContactTest:
    """A motion that was not trained on, with a contact on the last body during its second half:
    the measured wrench (N, 6), and the joint torques (N, k) and contact wrench (N, 6) to estimate.
    """

    method: SensorNewtonEuler
    wrench: Array
    tau: Array
    touch: Array

    def errors(
        self, problem: Problem, truth: Truth, estimate: Estimate
    ) -> dict[str, WrenchErrors] | None:
        """RMS errors with true, CAD and identified parameters side by side; None without them."""
        prior, beta = problem.prior, base_parameters(estimate)
        if prior is None or beta is None:
            return None
        theta = problem.base.embed(beta) if estimate.theta is None else estimate.theta
        sets = {"true": truth.theta, "CAD": prior.theta, "identified": theta}
        columns = self.method.columns
        phis = {name: subtree_parameters(x, problem, columns) for name, x in sets.items()}
        return wrench_errors(self.method, phis, self.wrench, self.tau, self.touch)


def subtree_parameters(theta: Array, problem: Problem, columns: Sequence[str]) -> Array:
    """Parameters phi (..., p') of a sub-tree by name, from those of a problem (..., p); zero where
    the problem has none, as for joint terms, which a wrench does not contain."""
    index = {name: i for i, name in enumerate(problem.parameters)}
    indices = np.array([index.get(name, -1) for name in columns], dtype=int)
    return np.where(indices >= 0, theta[..., indices], 0.0)


def sensor_excitation(robot: RobotModel, cut: SensorSubtree, motion: Trajectory) -> Excitation:
    """The part of a sub-tree's identifiable subspace that a motion excites."""
    return excitation_of(
        subtree_regressor(robot, cut, motion),
        structural_subspaces(robot, cut, (robot.body_names[cut.body],)),
    )


def contact_test(spec: ExperimentSpec, built: BuiltPlant, task: Task) -> ContactTest | None:
    """The contact test of an experiment: the plant's robot moves and is touched, the model's
    estimates. None where a further sensor ends the sub-tree."""
    if task.end_sensors:
        return None
    cut, robot, moved = task.cuts[0], built.model, built.plant.robot
    rng = np.random.default_rng(seed_of(spec.seed, "touch", spec.seeded_robot))
    motion = PointToPoint().design(design_problem(robot, RATE), rng)
    wrench = random_wrench(motion, TOUCH, rng)
    # The first half is without contact: there the parameters alone are compared.
    wrench[: len(motion) // 2] = 0.0
    carried_out = built.coordinates.to_plant(motion)
    touch, plant = Contact(end_body(robot, cut), wrench), plant_of(moved)
    method = sensor_newton_euler(robot, cut, motion, robot.body_names[touch.body])
    tau = newton_euler(moved.tree, moved.tree.link_parameters(moved.phi), carried_out)
    tau -= contact_torque(plant, touch, carried_out)  # J' f of the contact, which the motors oppose
    f_b = sensor_wrench(plant, (cut,), carried_out, touch)
    white = np.random.default_rng(seed_of(noise_seed(spec), "touch"))
    f_b += wrench_noise(spec.noise).white() * white.normal(size=f_b.shape)
    return ContactTest(method, f_b, method.drives.reduced(tau[:, list(method.tree.dofs)]), wrench)


def contact_fields(errors: dict[str, WrenchErrors] | None) -> Row:
    """Row fields of a contact test: ratios of RMS errors; none without errors."""
    if errors is None:
        return {}
    true, cad, found = (asdict(errors[name]) for name in ("true", "CAD", "identified"))

    def worst(upper: Row, lower: Row, *keys: str) -> float | None:
        """Largest ratio, each of errors in one unit; None where rounding would be divided by
        rounding, or nothing by nothing."""
        known = [key for key in keys if np.isfinite(upper[key]) and lower[key] > 1e-9]
        return max((upper[key] / lower[key] for key in known), default=None)

    return {
        "sensed_torque_ratio": worst(found, true, "torque", "slide"),
        "sensed_wrench_ratio": worst(found, true, "force", "moment"),
        "sensed_cad_ratio": worst(cad, found, "torque", "slide"),
        "alone_cad_ratio": worst(found, cad, "torque_alone", "slide_alone"),
    }
