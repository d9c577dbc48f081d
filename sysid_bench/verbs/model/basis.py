"""Base parameters of a task: number, combinations, and identifiability of each parameter."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import SHOWN, first_names
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    expression,
    left_out_expressions,
    parameter_verdict,
)
from sysid_bench.identifiability.base_map import base_map, left_out_torque, structural_factor
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.types import Array, BaseMap, Body
from sysid_bench.verbs.model.sensor_certificate import certificate_fields, certificate_lines
from sysid_bench.verbs.result import OMIT_NONE, Result
from sysid_bench.verbs.task_terms import check_terms, terms_of

LOAD: Final = "point-1kg"
"""Payload mounted for payload tasks. Identifiability depends on its position in the tree alone."""

_WORDS: Final = {
    "identifiable": "identifiable",
    "combination": "in combinations alone",
    "none": "without any effect",
}


@dataclass(frozen=True, eq=False, repr=False)
class BasisResult(Result):
    """Base parameters beta = K theta of the unknowns theta (p,) of a task.

    `base_parameters`: rank r of the regressor over random states, SI columns; `gap`: ratio of the
    smallest singular value above the threshold to the largest below it. `verdicts`: {parameter:
    "identifiable", "combination" or "none"}; `sensor`: with the task `wrench`, the certificate of
    the torques that the sensor predicts.
    """

    robot: str
    task: str
    terms: list[str]
    rows: list[str]
    parameters: int
    base_parameters: int
    inertial: int
    gap: float
    near_degenerate: int
    dropped_torque: float  # share of the torque that the dropped directions carry
    near_degenerate_directions: list[dict[str, Any]]
    combinations: list[dict[str, Any]]
    verdicts: Mapping[str, str]
    sensor: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)

    def expressions(self) -> list[str]:
        """Combinations as text, single parameters first."""
        entries = sorted(self.combinations, key=lambda entry: len(entry["terms"]) > 1)
        return [str(entry["expression"]) for entry in entries]

    def summary(self) -> str:
        """Rank, gap, near-degenerate directions, and parameters by verdict."""
        lines = [
            f"{self.robot}, task {self.task}: {self.base_parameters} base parameters of "
            f"{self.parameters} unknowns, {self.inertial} of them inertial (gap {self.gap:.1e})"
        ]
        lines += [
            f"  near-degenerate ({entry['singular_value']:.1e} of the largest): "
            f"{entry['expression']}"
            for entry in self.near_degenerate_directions
        ]
        if self.near_degenerate:
            share = self.dropped_torque
            lines.append(f"  these carry {share:.1e} of the torque, which no estimate predicts")
        certificate = () if self.sensor is None else certificate_lines(self.sensor)
        return "\n".join([*lines, *self._verdict_lines(), *certificate])

    def _verdict_lines(self) -> Iterator[str]:
        """First parameters of each verdict that occurs."""
        for verdict, words in _WORDS.items():
            names = [name for name, value in self.verdicts.items() if value == verdict]
            if names:
                yield f"  {len(names)} {words}: {_first(names)}"


def _first(names: list[str]) -> str:
    """The first SHOWN of names, and where to find the others."""
    return first_names(names, SHOWN) + (" (--json)" if len(names) > SHOWN else "")


def basis(
    source: str | Path,
    task: str = "robot",
    terms: Sequence[str] | None = None,
    free_base: bool | None = None,
    robots_dir: Path | None = None,
    sensor: str | None = None,
) -> BasisResult:
    """Return the base parameters of a task on a robot (a name, a URDF or an MJCF file).

    `terms`: joint terms that are also unknown (None: the robot's own with the task `robot`).
    `sensor`: for the tasks `wrench` and `wrench-payload`, a sensor of the manifest or a fixed
    joint, site or body. Raises UsageError for unknown names, ModelError for a file that cannot be
    used, and UnsupportedError where the robot has no such task.
    """
    check_terms(task, terms)
    definition = find_task(task)
    load = PAYLOADS[LOAD if definition.identifies_payload else "none"]
    robot = load_robot(source, load, free_base, robots_dir)
    chosen = terms_of(definition, robot, terms)
    posed = definition.unknowns(robot, chosen, sensor, None)
    R = structural_factor(robot, posed.parameters, posed.rows, posed.cuts)
    base = base_map(R, posed.parameters)
    return BasisResult(
        robot=robot.name,
        task=task,
        terms=list(chosen),
        rows=list(robot.torque_rows if posed.rows is None else posed.rows),
        parameters=len(posed.parameters),
        base_parameters=base.rank,
        inertial=_inertial_rank(base, posed.bodies),
        gap=base.gap,
        near_degenerate=base.near_degenerate,
        dropped_torque=left_out_torque(base, posed.truth.theta),
        near_degenerate_directions=_near_degenerate_fields(R, base),
        combinations=_combinations(base),
        verdicts=dict(zip(base.parameters, parameter_verdict(base), strict=True)),
        sensor=certificate_fields(robot, posed.cuts[0]) if definition.identifies_sub_tree else None,
    )


def _combinations(base: BaseMap) -> list[dict[str, Any]]:
    """Each base parameter as a text and by its terms."""
    parameters = base_expressions(base)
    return [{"expression": expression(parts), "terms": parts} for parts in parameters]


def _inertial_rank(base: BaseMap, bodies: Iterable[Body]) -> int:
    """Number of base parameters that are inertial: joint terms come last among the unknowns, so
    that no pivot among the inertial parameters depends on them."""
    inertial = {column for body in bodies for column in body.columns}
    return sum(name in inertial for name in base.names)


def _near_degenerate_fields(R: Array, base: BaseMap) -> list[dict[str, Any]]:
    """Directions below the rank tolerance but above rounding error."""
    return [
        {"singular_value": value, "expression": expression(parts, 2), "terms": parts}
        for value, parts in left_out_expressions(R, base)
    ]
