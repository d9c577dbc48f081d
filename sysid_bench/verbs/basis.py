"""Base parameters of any robot: how many, which sums, and what each single parameter is worth."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

LOAD = "point-1kg"
"""What is mounted for the task `payload`: which numbers can be told does not depend on the load."""


def basis(
    source: str | Path,
    task: str = "robot",
    terms: Sequence[str] | None = None,
    free_base: bool | None = None,
    robots_dir: Path | None = None,
    sensor: str | None = None,
) -> dict[str, Any]:
    """The base parameters of a task, as `basis --json` prints them.

    `terms`: joint terms that are unknown as well (None: the robot's own with the task `robot`).
    `sensor`: for the tasks `wrench` and `wrench-payload`, one of the manifest or a place to cut.
    Raises UsageError for unknown words, ModelError for a file that cannot be used, and
    UnsupportedError where the robot has no such task.
    """
    from sysid_bench.identifiability.base_expressions import (
        base_expressions,
        expression,
        near_degenerate,
    )
    from sysid_bench.identifiability.base_map import base_map
    from sysid_bench.identifiability.structural import structural_factor
    from sysid_bench.identifiability.verdicts import verdicts
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.payload import PAYLOADS
    from sysid_bench.tasks.task import named_task
    from sysid_bench.verbs.option_parsing import refuse_ignored_terms

    refuse_ignored_terms(task, terms)
    definition = named_task(task)
    load = PAYLOADS[LOAD if definition.identifies_payload else "none"]
    robot = load_robot(source, load, free_base, robots_dir)
    chosen = definition.default_terms(robot) if terms is None else tuple(terms)
    asked = definition.unknowns(robot, chosen, sensor, None)
    R = structural_factor(robot, asked.parameters, asked.rows, asked.cuts)
    base = base_map(R, asked.parameters)
    inertial = {column for body in asked.bodies for column in body.columns}
    return {
        "robot": robot.name,
        "task": task,
        "terms": list(chosen),
        "rows": list(robot.torque_rows if asked.rows is None else asked.rows),
        "parameters": len(asked.parameters),
        "base_parameters": base.rank,
        # Joint terms come last, so that no pivot among the inertial parameters owes them anything.
        "inertial": sum(name in inertial for name in base.names),
        "gap": base.gap,
        "near_degenerate": base.near_degenerate,
        "near_degenerate_directions": [
            {"singular_value": value, "expression": expression(parts, 2), "terms": parts}
            for value, parts in near_degenerate(R, base)
        ],
        "combinations": [
            {"expression": expression(parts), "terms": parts} for parts in base_expressions(base)
        ],
        "verdicts": dict(zip(base.parameters, verdicts(base), strict=True)),
    }


def paper(answer: dict[str, Any]) -> list[str]:
    """The sums of `basis` one per line, single parameters first."""
    sums = sorted(answer["combinations"], key=lambda entry: len(entry["terms"]) > 1)
    return [entry["expression"] for entry in sums]


def summary(answer: dict[str, Any]) -> list[str]:
    """What `basis` tells, in a few lines."""
    gap = answer["gap"]
    lines = [
        f"{answer['robot']}, task {answer['task']}: {answer['base_parameters']} base parameters of "
        f"{answer['parameters']} unknowns, {answer['inertial']} of them inertial (gap {gap:.1e})"
    ]
    lines += [
        f"  near-degenerate ({entry['singular_value']:.1e} of the largest): {entry['expression']}"
        for entry in answer["near_degenerate_directions"]
    ]
    for verdict, words in _WORDS.items():
        names = [name for name, own in answer["verdicts"].items() if own == verdict]
        if names:
            lines.append(f"  {len(names)} {words}: {', '.join(names)}")
    return lines


_WORDS = {
    "identifiable": "identifiable",
    "combination": "in combinations alone",
    "none": "without any effect",
}
