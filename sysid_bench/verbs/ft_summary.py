"""What a task behind a force/torque sensor is good for, in the words of a user."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid_bench.experiments.prepared import Prepared
    from sysid_bench.experiments.simulated.source import SimulatedSource
    from sysid_bench.types import Estimate


def excitation_fields(ready: "Prepared[SimulatedSource]") -> dict[str, Any]:
    """The sensor, its sub-tree, what its data tell of the structure, and the degrees of freedom
    whose torque they cannot foretell."""
    from sysid_bench.experiments.simulated.ft_evaluation import sensor_excitation

    cut = ready.source.task.cuts[0]
    told = sensor_excitation(ready.robot, cut, ready.source.motion)
    return {
        "name": cut.name,
        "at": cut.at,
        "bodies": [ready.robot.body_names[b] for b in cut.bodies],
        "ends_at": list(cut.end_sensors),
        "structural_rank": told.structural,
        "excited_rank": told.rank,
        "unpredictable": list(told.unpredictable),
        "warning": told.warning,
    }


def comparison_fields(
    ready: "Prepared[SimulatedSource]", estimate: "Estimate"
) -> dict[str, dict[str, float]] | None:
    """RMS errors of joint torques and of a touch on the last body, with true, CAD and identified
    parameters side by side, on a motion that was not trained on; None where a further sensor ends
    the sub-tree."""
    trial, truth = ready.source.contact_test, ready.source.truth
    errors = None if trial is None else trial.errors(ready.problem, truth, estimate)
    return None if errors is None else {name: asdict(c) for name, c in errors.items()}


def sensor_lines(sensor: dict[str, Any]) -> list[str]:
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
