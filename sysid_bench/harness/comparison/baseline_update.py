"""Update of a baseline: the changes that a comparison finds are taken over, and nothing else.

Values within their tolerance stay: taken over each time, they would drift without a limit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from sysid_bench.harness.comparison.run_difference import STATUS, Change, RunDifference
from sysid_bench.harness.comparison.run_values import CellValues, RunValues
from sysid_bench.harness.comparison.speed import ALL, Key, Speed


@dataclass(frozen=True)
class Update:
    """Values of a baseline after an update, and the number of changes that it took over."""

    run: RunValues
    taken: int


def update_of(changes: RunDifference) -> Update:
    """The baseline `changes.before` with all changes: of statuses, values and base parameters,
    cells and settings that appeared or ran for the first time, cells that vanished, and the times
    of robots in which a part became slower or faster, or whose cells or parts are other ones. Cells
    without a row stay. Versions and machine are those of the run where anything is taken over."""
    old, now = changes.before, changes.after
    ran = [name for name, was in old.cells.items() if was.is_open and _has_row(now, name)]
    settings = [key for key in now.parameters if key not in old.parameters]
    timed = _timed_robots(changes) if now.speeds else set[str]()
    speeds = {key: speed for key, speed in now.speeds.items() if key[0] in timed}
    gone = [key for key in old.speeds if key[0] in timed and key not in speeds]
    listed = (changes.cells, changes.parameters, changes.appeared, changes.vanished, ran, settings)
    taken = sum(map(len, (*listed, speeds, gone)))
    run = replace(
        old,
        axes=now.axes,
        cells=_cells(changes, {*changes.appeared, *ran}),
        parameters=_parameters(changes),
        origin=now.origin if taken else old.origin,
        speeds={key: speed for key, speed in old.speeds.items() if key[0] not in timed} | speeds,
    )
    return Update(run, taken)


def _has_row(run: RunValues, cell: str) -> bool:
    return cell in run.cells and not run.cells[cell].is_open


def _cells(changes: RunDifference, new: set[str]) -> dict[str, CellValues]:
    """The cells of the run with the values of before, but for those that changed."""
    by_cell: dict[str, list[Change]] = {}
    for change in changes.cells:
        by_cell.setdefault(change.cell, []).append(change)
    was = changes.before.cells
    return {
        name: now if name in new else _cell(changes, was[name], now, by_cell.get(name, []))
        for name, now in changes.after.cells.items()
    }


def _cell(
    changes: RunDifference, was: CellValues, now: CellValues, of_cell: list[Change]
) -> CellValues:
    """A cell of before with its changes; `now` has its labels, which the plan gives."""
    names = {change.metric for change in of_cell}
    if STATUS in names:
        return now
    there = dict(zip(changes.after.metrics, now.values, strict=True))
    pairs = zip(changes.before.metrics, was.values, strict=True)
    values = tuple(there[name] if name in names else value for name, value in pairs)
    return replace(was, robot=now.robot, labels=now.labels, values=values)


def _parameters(changes: RunDifference) -> dict[Key, Mapping[str, float]]:
    """True base parameters: those that changed, and settings that are new; robots without a cell
    have none any more."""
    old, now = changes.before.parameters, changes.after.parameters
    robots = {cell.robot for cell in changes.after.cells.values()}
    found = {key: dict(old.get(key, now.get(key, {}))) for key in {**old, **now}}
    for change in changes.parameters:
        values = found[change.robot, change.setting]
        if change.after is None:
            del values[change.parameter]
        else:
            values[change.parameter] = change.after
    return {key: values for key, values in found.items() if key[0] in robots}


def _timed_robots(changes: RunDifference) -> set[str]:
    """Robots whose times are taken over: speeds are relative to all parts of a robot, so that they
    are of one run each."""
    old, now = changes.before, changes.after
    robots = {robot for robot, _ in (*old.speeds, *now.speeds)}
    moved = {one.robot for one in changes.speeds if one.verdict in ("slower", "faster")}
    if ALL in moved:
        return robots
    return {
        robot
        for robot in robots
        if robot in moved
        or _parts(old.speeds, robot) != _parts(now.speeds, robot)
        or old.cell_labels(robot) != now.cell_labels(robot)
    }


def _parts(speeds: Mapping[Key, Speed], robot: str) -> set[str]:
    return {part for name, part in speeds if name == robot}
