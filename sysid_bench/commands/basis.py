"""Verb `basis`: base parameters of a task, their combinations, and what can be identified."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.request import (
    OK,
    Request,
    free_base_option,
    model,
    option,
    python_function,
    robots_option,
    sensor_option,
    task_option,
    terms_option,
)
from sysid_bench.commands.result import OMIT_NONE, Result, value_text
from sysid_bench.errors import SHOWN, UsageError, first_names

if TYPE_CHECKING:
    from sysid_bench.types import Array, BaseMap, Body

LOAD: Final = "point-1kg"
"""Payload mounted for payload tasks. Identifiability depends on its position in the tree alone."""

_WORDS: Final = {
    "identifiable": "identifiable",
    "combination": "in combinations alone",
    "none": "without any effect",
}
ROUNDING: Final = 1e-6
"""Change below which values count as those of a physical robot: solver tolerance."""


class Basis(Request["BasisResult"]):
    """Print the base parameters: number, combinations, identifiability of each parameter."""

    source: str | Path = model("ROBOT|FILE")
    task: str = task_option()
    terms: Sequence[str] | None = terms_option()
    free_base: bool | None = free_base_option()
    robots_dir: Path | None = robots_option()
    sensor: str | None = sensor_option()

    def run(self) -> "BasisResult":
        """Return the base parameters of a task on a robot (a name, a URDF or an MJCF file).

        `terms`: joint terms that are also unknown (None: the robot's own with the task `robot`).
        `sensor`: for the tasks `wrench` and `wrench-payload`, a sensor of the manifest or a fixed
        joint, site or body. Raises UsageError for unknown names, ModelError for a file that cannot
        be used, and UnsupportedError where the robot has no such task.
        """
        from sysid_bench.commands.sensor_certificate import certificate_fields
        from sysid_bench.commands.task_terms import check_terms, terms_of
        from sysid_bench.experiments.tasks.task import find_task
        from sysid_bench.identifiability.base_expressions import parameter_verdict
        from sysid_bench.identifiability.base_map import (
            base_map,
            left_out_torque,
            structural_factor,
        )
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.payload import PAYLOADS

        check_terms(self.task, self.terms)
        definition = find_task(self.task)
        load = PAYLOADS[LOAD if definition.identifies_payload else "none"]
        robot = load_robot(self.source, load, self.free_base, self.robots_dir)
        chosen = terms_of(definition, robot, self.terms)
        posed = definition.unknowns(robot, chosen, self.sensor, None)
        R = structural_factor(robot, posed.parameters, posed.rows, posed.cuts)
        base = base_map(R, posed.parameters)
        certificate = definition.identifies_sub_tree
        return BasisResult(
            robot=robot.name,
            task=self.task,
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
            sensor=certificate_fields(robot, posed.cuts[0]) if certificate else None,
        )

    def plugins(self) -> list[tuple[str, str | None]]:
        return [("task", self.task)]


basis = python_function(Basis, "basis")


class BasisCommand(Basis):  # how the shell prints it
    paper: bool = option("Combinations alone, one per line, singles first.", default=False)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json

        whole = self.free_base is None and self.sensor is None
        if not self.paper or not (whole and _has_table(self.task)):
            if not self.paper or as_json:
                return super().shell(as_json)
            click.echo("\n".join(self.run().expressions()))
            return OK
        table = paper_table(self.source, self.terms, robots_dir=self.robots_dir)
        if as_json:
            print_json(table)
        else:
            click.echo("\n".join(_table_lines(table)))
        return OK


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
        certificate: Iterable[str] = ()
        if self.sensor is not None:
            from sysid_bench.commands.sensor_certificate import certificate_lines

            certificate = certificate_lines(self.sensor)
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


def _combinations(base: "BaseMap") -> list[dict[str, Any]]:
    """Each base parameter as a text and by its terms."""
    from sysid_bench.identifiability.base_expressions import base_expressions, expression

    parameters = base_expressions(base)
    return [{"expression": expression(parts), "terms": parts} for parts in parameters]


def _inertial_rank(base: "BaseMap", bodies: "Iterable[Body]") -> int:
    """Number of base parameters that are inertial: joint terms come last among the unknowns, so
    that no pivot among the inertial parameters depends on them."""
    inertial = {column for body in bodies for column in body.columns}
    return sum(name in inertial for name in base.names)


def _near_degenerate_fields(R: "Array", base: "BaseMap") -> list[dict[str, Any]]:
    """Directions below the rank tolerance but above rounding error."""
    from sysid_bench.identifiability.base_expressions import expression, left_out_expressions

    return [
        {"singular_value": value, "expression": expression(parts, 2), "terms": parts}
        for value, parts in left_out_expressions(R, base)
    ]


# --- The table of `basis --paper` ---------------------------------------------------------------


def paper_table(
    source: str | Path,
    terms: Sequence[str] | None = None,
    zero: Sequence[str] | None = None,
    values: str | Path | Mapping[str, Any] | None = None,
    robots_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the base parameters in the print of a paper (see experiments/base_table.py).

    `values`: a JSON file or its content, from `identify --json` or {row: value}. Raises
    UsageError, which names the file.
    """
    from sysid_bench.experiments.base_table import base_table
    from sysid_bench.models.load import load_robot

    robot = load_robot(source, robots_dir=robots_dir)
    if not isinstance(values, (str, Path)):
        return base_table(robot, terms, zero, values)
    given = _read(Path(values))
    try:
        return base_table(robot, terms, zero, given)
    except UsageError as error:
        raise UsageError(f"{values}: {error}") from error


def _has_table(name: str) -> bool:
    """Return True for a task whose unknowns are those of the table."""
    from sysid_bench.experiments.tasks.task import find_task

    return bool(find_task(name).identifies_whole_robot)


def _table_lines(answer: Mapping[str, Any]) -> list[str]:
    """The rows one per line, with their values where there are any."""
    rows = answer["rows"]
    if all(row["value"] is None for row in rows):
        return [row["expression"] for row in rows]
    return [_table_line(row) for row in rows] + _change_lines(answer["smallest_change"] or 0.0)


def _change_lines(change: float) -> list[str]:
    """Remark on values that no physical robot has."""
    if change <= ROUNDING:
        return []
    return [f"No physical robot has these values: some have to change by {change:.3g} or more."]


def _table_line(row: Mapping[str, Any]) -> str:
    """Value and expression of a row, marked where no physical robot has the value."""
    mark = f"   IMPOSSIBLE: {row['impossible']}" if row["impossible"] else ""
    return f"{value_text(row['value']):>10}  {row['expression']}{mark}"


def _read(file: Path) -> dict[str, Any]:
    from sysid_bench.input_files import parse_json, read_text

    try:
        content = parse_json(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(file)!r} cannot be read as JSON: {error}.") from error
    if not isinstance(content, dict):
        raise UsageError(f"{file}: expected a JSON object, {{row: value}}.")
    return content
