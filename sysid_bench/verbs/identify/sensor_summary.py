"""Results behind a force/torque sensor: what its data excite, and errors of its predictions."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from sysid_bench.commands.sensor_certificate import certificate_fields, certificate_lines
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.simulated.wrench_score import sensor_excitation
from sysid_bench.types import Estimate


def excitation_fields(ready: ExperimentData[SimulatedSource]) -> dict[str, Any]:
    """Sensor, bodies of its sub-tree, structural and excited rank, the drives whose torque can and
    cannot be predicted from its data, the same of components of the wrench, and the certificate."""
    cut = ready.source.task.cuts[0]
    excitation = sensor_excitation(ready.robot, cut, ready.source.motion)
    return {
        "name": cut.name,
        "at": cut.at,
        "bodies": [ready.robot.body_names[b] for b in cut.bodies],
        "ends_at": list(cut.end_sensors),
        "structural_rank": excitation.structural,
        "excited_rank": excitation.rank,
        "predictable": list(excitation.predictable),
        "unpredictable": list(excitation.unpredictable),
        "missing": dict(excitation.missing),
        "unpredictable_wrench": list(excitation.unpredictable_wrench),
        "missing_wrench": dict(excitation.missing_wrench),
        "certificate": certificate_fields(ready.robot, cut),
        "warning": excitation.warning,
    }


def estimation_fields(
    ready: ExperimentData[SimulatedSource], estimate: Estimate
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
    lines += certificate_lines(sensor["certificate"])
    lines += _excited_lines(sensor)
    for name, errors in (sensor["estimation"] or {}).items():
        touch = f"touch {errors['force']:.3g} N and {errors['moment']:.3g} N m"
        lines.append(f"    {name}: {_torque_text(errors)}{touch}")
    return lines


def _excited_lines(sensor: Mapping[str, Any]) -> Iterator[str]:
    """Drives and components of the wrench that these data predict, and those that they do not."""
    groups = {
        "predictable from these data: torques of": sensor["predictable"],
        "not predictable from these data: torques of": sensor["unpredictable"],
        "not predictable from these data: components": sensor["unpredictable_wrench"],
    }
    for text, names in groups.items():
        yield f"    {text} {', '.join(names) or 'none'}"


def _torque_text(errors: Mapping[str, Any]) -> str:
    """RMS errors of hinges (N m) and of slides (N), each where there are some."""
    parts = ""
    for label, key, unit in (("torque", "torque", "N m"), ("slides", "slide", "N")):
        if errors[key] is not None:
            alone = f"{errors[f'{key}_alone']:.3g}"
            parts += f"{label} {errors[key]:.3g} {unit} (without the sensor {alone}), "
    return parts
