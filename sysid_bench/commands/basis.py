"""Verb `basis`: base parameters of a task, their combinations, and what can be identified."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

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
from sysid_bench.commands.result import OMIT_NONE, Result
from sysid_bench.errors import SHOWN, UsageError, first_names

LOAD: Final = "point-1kg"
"""Payload mounted for payload tasks. Identifiability depends on its position in the tree alone."""

_WORDS: Final = {
    "identifiable": "identifiable",
    "combination": "in combinations alone",
    "none": "without any effect",
}


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
        from sysid_bench.identifiability import base_expressions as texts
        from sysid_bench.identifiability import base_map as maps
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.payload import PAYLOADS

        check_terms(self.task, self.terms)
        definition = find_task(self.task)
        load = PAYLOADS[LOAD if definition.identifies_payload else "none"]
        robot = load_robot(self.source, load, self.free_base, self.robots_dir)
        chosen = terms_of(definition, robot, self.terms)
        unknowns = definition.unknowns(robot, chosen, self.sensor, None)
        R = maps.structural_factor(robot, unknowns.parameters, unknowns.rows, unknowns.cuts)
        base = maps.base_map(R, unknowns.parameters)
        certificate = definition.identifies_sub_tree
        inertial = {column for body in unknowns.bodies for column in body.columns}
        return BasisResult(
            robot=robot.name,
            task=self.task,
            terms=list(chosen),
            rows=list(robot.torque_rows if unknowns.rows is None else unknowns.rows),
            parameters=len(unknowns.parameters),
            base_parameters=base.rank,
            # Joint terms come last among the unknowns: no inertial pivot depends on them.
            inertial=sum(name in inertial for name in base.names),
            gap=base.gap,
            near_degenerate=base.near_degenerate,
            dropped_torque=maps.left_out_torque(base, unknowns.truth.theta),
            # Below the rank tolerance but above rounding error.
            near_degenerate_directions=[
                {"singular_value": value, "expression": texts.expression(terms, 2), "terms": terms}
                for value, terms in texts.left_out_expressions(R, base)
            ],
            combinations=[
                {"expression": texts.expression(terms), "terms": terms}
                for terms in texts.base_expressions(base)
            ],
            verdicts=dict(zip(base.parameters, texts.parameter_verdict(base), strict=True)),
            sensor=certificate_fields(robot, unknowns.cuts[0]) if certificate else None,
        )

    def plugins(self) -> list[tuple[str, str | None]]:
        return [("task", self.task)]


basis = python_function(Basis, "basis")


class BasisCommand(Basis):  # how the shell prints it
    paper: bool = option("Combinations alone, one per line, singles first.", default=False)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json
        from sysid_bench.experiments.tasks.task import find_task

        whole = self.free_base is None and self.sensor is None
        if not self.paper or not (whole and find_task(self.task).identifies_whole_robot):
            if not self.paper or as_json:
                return super().shell(as_json)
            click.echo("\n".join(self.run().expressions()))
            return OK
        table = paper_table(self.source, self.terms, robots_dir=self.robots_dir)
        if as_json:
            print_json(table)
        else:
            click.echo("\n".join(row["expression"] for row in table["rows"]))
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
        for verdict, words in _WORDS.items():
            names = [name for name, value in self.verdicts.items() if value == verdict]
            if names:
                more = " (--json)" if len(names) > SHOWN else ""
                lines.append(f"  {len(names)} {words}: {first_names(names, SHOWN)}{more}")
        if self.sensor is not None:
            from sysid_bench.commands.sensor_certificate import certificate_lines

            lines += certificate_lines(self.sensor)
        return "\n".join(lines)


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


def _read(file: Path) -> dict[str, Any]:
    from sysid_bench.input_files import parse_json, read_text

    try:
        content = parse_json(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(file)!r} cannot be read as JSON: {error}.") from error
    if not isinstance(content, dict):
        raise UsageError(f"{file}: expected a JSON object, {{row: value}}.")
    return content
