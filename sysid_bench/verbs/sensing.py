"""What a task behind a force/torque sensor is good for: torques, contacts, and what is missing."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sysid_bench.harness.experiment.prepare import Prepared
    from sysid_bench.harness.experiment.spec import ExperimentSpec
    from sysid_bench.models.robot import RobotModel
    from sysid_bench.models.sensor import Cut
    from sysid_bench.types import Array, Estimate

TOUCH = 5.0
"""N of the touch that is to be found, and a tenth of it in N m."""


def excited(ready: "Prepared") -> dict[str, Any]:
    """The sensor, its sub-tree, what its data tell of the structure, and the degrees of freedom
    whose torque they cannot foretell."""
    from sysid_bench.identifiability.subspaces import excitation_of, structural_subspaces
    from sysid_bench.regressors.wrench import sub_tree

    cut, robot = ready.task.cuts[0], ready.robot
    told = excitation_of(
        sub_tree(robot, cut, ready.experiment.recording.motion),
        structural_subspaces(robot, cut, (robot.body_names[cut.body],)),
    )
    return {
        "name": cut.name,
        "at": cut.at,
        "bodies": [robot.body_names[b] for b in cut.bodies],
        "ends_at": list(cut.stops),
        "structural_rank": told.structural,
        "excited_rank": told.rank,
        "unpredictable": list(told.unpredictable),
        "warning": told.warning,
    }


def compared(
    spec: "ExperimentSpec", ready: "Prepared", estimate: "Estimate"
) -> dict[str, dict[str, float]] | None:
    """RMS errors of joint torques and of a touch on the last body, with true, CAD and identified
    parameters side by side, on a motion that was not trained on; None where a further sensor ends
    the sub-tree."""
    from dataclasses import asdict

    from sysid_bench.evaluation.estimation import compare, reordered
    from sysid_bench.excitation.brief import brief_of
    from sysid_bench.excitation.point_to_point import PointToPoint
    from sysid_bench.harness.experiment.spec import seed_of
    from sysid_bench.regressors.kernel import newton_euler
    from sysid_bench.simulation.plant import plant_of
    from sysid_bench.simulation.wrench import Touch, sensor_wrench, touch_torque, wrench_noise

    robot, cut, problem = ready.robot, ready.task.cuts[0], ready.problem
    if ready.task.stops or problem.prior is None or estimate.beta is None:
        return None
    rng = np.random.default_rng(seed_of(spec.seed, "touch", spec.robot))
    motion = PointToPoint().design(brief_of(robot, 50.0), rng)
    wrench = np.repeat([0.1, 1.0], 3) * TOUCH * np.sin(2 * motion.t[:, None] + rng.normal(size=6))
    wrench[: len(motion) // 2] = 0.0
    touch, plant = Touch(last_body(robot, cut), wrench), plant_of(robot)
    method = reordered(robot, cut, motion, robot.body_names[touch.body])
    tau = newton_euler(robot.tree, robot.tree.lumped(robot.phi), motion)
    tau -= touch_torque(plant, touch, motion)
    f_b = sensor_wrench(plant, (cut,), motion, touch)
    f_b += wrench_noise(spec.noise).white() * rng.normal(size=f_b.shape)
    theta = problem.base.embed(estimate.beta) if estimate.theta is None else estimate.theta
    sets = {"true": ready.truth.theta, "CAD": problem.prior.theta, "identified": theta}
    places = {name: i for i, name in enumerate(problem.parameters)}
    phis: dict[str, Array] = {
        name: np.array([told[places[c]] if c in places else 0.0 for c in method.tree.columns])
        for name, told in sets.items()
    }
    tau = tau[:, list(method.tree.dofs)]
    return {name: asdict(c) for name, c in compare(method, phis, f_b, tau, wrench).items()}


def last_body(robot: "RobotModel", cut: "Cut") -> int:
    """The tool where it is behind the sensor, else the body with the most joints before it."""
    if robot.tool_body in cut.bodies:
        return robot.tool_body

    def joints_before(body: int) -> int:
        link = int(robot.tree.carrier[body])
        return 0 if link < 0 else len(robot.tree.links[link].dofs)

    return max(cut.bodies, key=joints_before)


def told(sensor: dict[str, Any]) -> list[str]:
    """The same in a few lines."""
    lines = [
        f"  sensor {sensor['name']} at {sensor['at']}: {len(sensor['bodies'])} bodies behind it, "
        f"{sensor['excited_rank']} of {sensor['structural_rank']} base parameters excited"
    ]
    for name, errors in (sensor["estimation"] or {}).items():
        touch = f"touch {errors['force']:.3g} N and {errors['moment']:.3g} N m"
        # A sub-tree without joints has no torques.
        torque = (
            ""
            if errors["torque"] is None
            else f"torque {errors['torque']:.3g} N m (without the sensor "
            f"{errors['torque_alone']:.3g}), "
        )
        lines.append(f"    {name}: {torque}{touch}")
    return lines
