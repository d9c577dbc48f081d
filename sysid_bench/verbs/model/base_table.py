"""The command `basis --paper`: base parameters in the print of a paper, with values of a file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError
from sysid_bench.experiments.base_table import base_table
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.input_files import parse_json, read_text
from sysid_bench.models.load import load_robot
from sysid_bench.verbs.result import value_text

ROUNDING: Final = 1e-6
"""Change below which values count as those of a physical robot: solver tolerance."""


def paper_table(
    source: str | Path,
    terms: Sequence[str] | None = None,
    zero: Sequence[str] | None = None,
    values: str | Path | Mapping[str, Any] | None = None,
    robots_dir: Path | None = None,
) -> dict[str, Any]:
    """The table of a robot (see experiments/base_table.py).

    `values`: a JSON file or its content, from `identify --json-out` or {row: value}. Raises
    UsageError, which names the file.
    """

    robot = load_robot(source, robots_dir=robots_dir)
    if not isinstance(values, (str, Path)):
        return base_table(robot, terms, zero, values)
    given = _read(Path(values))
    try:
        return base_table(robot, terms, zero, given)
    except UsageError as error:
        raise UsageError(f"{values}: {error}") from error


def supports_task(name: str) -> bool:
    """Return True for a task whose unknowns are those of the table."""
    return bool(find_task(name).identifies_whole_robot)


def lines(answer: Mapping[str, Any]) -> list[str]:
    """The rows one per line, with their values where there are any."""
    rows = answer["rows"]
    if all(row["value"] is None for row in rows):
        return [row["expression"] for row in rows]
    return [_line(row) for row in rows] + _change_lines(answer["smallest_change"] or 0.0)


def _change_lines(change: float) -> list[str]:
    """Remark on values that no physical robot has."""
    if change <= ROUNDING:
        return []
    return [f"No physical robot has these values: some have to change by {change:.3g} or more."]


def _line(row: Mapping[str, Any]) -> str:
    """Value and expression of a row, marked where no physical robot has the value."""
    mark = f"   IMPOSSIBLE: {row['impossible']}" if row["impossible"] else ""
    return f"{value_text(row['value']):>10}  {row['expression']}{mark}"


def _read(file: Path) -> dict[str, Any]:
    try:
        content = parse_json(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(file)!r} cannot be read as JSON: {error}.") from error
    if not isinstance(content, dict):
        raise UsageError(f"{file}: expected a JSON object, {{row: value}}.")
    return content
