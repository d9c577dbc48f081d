"""Results behind a force/torque sensor: what its data excite, and errors of its predictions."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from sysid_bench.experiments.prepared import Prepared
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.simulated.wrench_score import sensor_excitation
from sysid_bench.types import Estimate


def excitation_fields(ready: Prepared[SimulatedSource]) -> dict[str, Any]:
    """Sensor, bodies of its sub-tree, structural and excited rank, and the degrees of freedom whose
    torque cannot be predicted from its data."""
    cut = ready.source.task.cuts[0]
    excitation = sensor_excitation(ready.robot, cut, ready.source.motion)
    return {
        "name": cut.name,
        "at": cut.at,
        "bodies": [ready.robot.body_names[b] for b in cut.bodies],
        "ends_at": list(cut.end_sensors),
        "structural_rank": excitation.structural,
        "excited_rank": excitation.rank,
        "unpredictable": list(excitation.unpredictable),
        "warning": excitation.warning,
    }


def estimation_fields(
    ready: Prepared[SimulatedSource], estimate: Estimate
) -> dict[str, dict[str, float]] | None:
    """RMS errors of joint torques (N m) and of a contact wrench (N, N m) on the last body, with
    true, CAD and identified parameters, on a held-out motion; None where a further sensor ends the
    sub-tree."""
    test, truth = ready.source.contact_test, ready.source.truth
    errors = None if test is None else test.errors(ready.problem, truth, estimate)
    return None if errors is None else {name: asdict(c) for name, c in errors.items()}


def sensor_lines(sensor: Mapping[str, Any]) -> list[str]:
    """Text for the terminal of both."""
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
