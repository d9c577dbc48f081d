"""Baseline of a run: a small sorted JSON file, a line per cell, to be kept beside the code."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.harness.comparison.run_difference import ROUNDING_SHARE, STATUS, RunDifference
from sysid_bench.harness.comparison.run_values import CellValues, RunValues, Tolerance, tolerance_of
from sysid_bench.harness.comparison.speed import ALL, Key, Speed
from sysid_bench.input_files import parse_json
from sysid_bench.metrics import METRICS, metric_from_record, metric_record
from sysid_bench.models.behaviour_change import Behaviour, BehaviourChange

SCHEMA: Final = 1
_DIGITS: Final = 7
"""Digits of a true parameter, and of values in baselines of before."""
EXACT_DIGITS: Final = 13
"""Digits of a value: `gate --exact` sees relative differences of 1e-12."""
_REASON: Final = 120
_KEYS: Final = ("schema", "suite", "origin", "axes", "metrics", "tolerances", "robots")
_LIKE: Final = "like"
_ORIGIN: Final = ("python", "platform", "cpu", "blas", "versions", "git")

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Baseline:
    """Values that a later run is compared with, with their digits, and the tolerance of each
    metric."""

    run: RunValues
    tolerances: Mapping[str, Tolerance]
    digits: int = EXACT_DIGITS


def baseline_of(
    run: RunValues, tolerances: Mapping[str, Tolerance] | None = None, digits: int = EXACT_DIGITS
) -> Baseline:
    """The baseline of a run; `tolerances` replace default ones. Raises UsageError for a tolerance
    of a metric that is not compared, and for a run without any row."""
    given = dict(tolerances or {})
    for name in given:
        if name not in run.metrics:
            raise UsageError(
                f"The tolerance {name!r} is not of a compared metric; compared are "
                f"{', '.join(run.metrics)}."
            )
    if all(cell.is_open for cell in run.cells.values()):
        raise UsageError(f"The run {run.name!r} has no row yet; run it, then save its baseline.")
    default = {name: tolerance_of(metric) for name, metric in run.metrics.items()}
    return Baseline(run, default | given, digits)


def to_text(baseline: Baseline) -> str:
    """JSON with a line per cell and per setting of a robot, sorted by robot: a change of one robot
    changes the lines of that robot alone."""
    run = baseline.run
    head = {
        "schema": SCHEMA,
        "suite": run.name,
        "origin": {key: run.origin[key] for key in _ORIGIN if key in run.origin},
        "digits": baseline.digits,
        "axes": list(run.axes),
        "metrics": [
            name if name in METRICS else metric_record(metric)
            for name, metric in run.metrics.items()
        ],
        "tolerances": {name: known.to_json() for name, known in baseline.tolerances.items()},
    }
    lines = [f" {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    robots = sorted({cell.robot for cell in run.cells.values()})
    blocks = ",\n".join(_robot_text(baseline, robot) for robot in robots)
    return "\n".join(["{", *lines, ' "robots": {', blocks, " }", "}"]) + "\n"


def _robot_text(baseline: Baseline, robot: str) -> str:
    """Parameters, cells in the order of their labels, and speeds of a robot, a line for each."""
    run = baseline.run
    parameters = {}
    for setting, true in _of_robot(run.parameters, robot):
        # Base parameters below a share of the largest are rounding, which changes: they are 0.
        smallest = ROUNDING_SHARE * max((0.0, *map(abs, true.values())))
        values = {name: value if abs(value) > smallest else 0.0 for name, value in true.items()}
        parameters[setting] = {name: _short(value) for name, value in values.items()}
    cells = [(cell.labels, key) for key, cell in run.cells.items() if cell.robot == robot]
    parts: dict[str, Mapping[str, Any]] = {
        "parameters": _like_the_first(parameters),
        "cells": {key: _cell_json(baseline, run.cells[key]) for _, key in sorted(cells)},
    }
    if robot in run.models:
        parts["model"] = run.models[robot]
    if speeds := dict(_of_robot(run.speeds, robot)):
        parts["speeds"] = {
            part: [_short(speed.ratio), _short(speed.noise), speed.count]
            for part, speed in speeds.items()
        }
    blocks = []
    for name, entries in parts.items():
        # A line for each cell, so that a diff shows which cells a commit changed.
        texts = (json.dumps(v, separators=(",", ":"), ensure_ascii=False) for v in entries.values())
        named = zip(map(json.dumps, entries), texts, strict=True)
        text = ",\n    ".join(f"{key}: {value}" for key, value in named)
        blocks.append(f'   "{name}": {{' + (f"\n    {text}\n   " if text else "") + "}")
    return f"  {json.dumps(robot)}: {{\n" + ",\n".join(blocks) + "\n  }"


def _of_robot(values: Mapping[tuple[str, str], _Value], robot: str) -> Iterator[tuple[str, _Value]]:
    """Yield (setting or part, value) of one robot, in alphabetical order."""
    return ((key, values[name, key]) for name, key in sorted(values) if name == robot)


def _like_the_first(settings: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Settings with the parameters of an earlier one as what differs from it: {"like": ...}."""
    first: dict[tuple[str, ...], str] = {}
    found = {}
    for name, values in settings.items():
        like = first.setdefault(tuple(values), name)
        differing = {key: v for key, v in values.items() if v != settings[like][key]}
        found[name] = values if like == name else {_LIKE: like} | differing
    return found


def _cell_json(baseline: Baseline, cell: CellValues) -> list[Any]:
    """[labels, status, values...], or the reason in place of the values."""
    first = [" | ".join(cell.labels), cell.status]
    if all(value is None for value in cell.values):
        return [*first, cell.reason[:_REASON]]
    shown = list[Any](first)
    for name, value in zip(baseline.run.metrics, cell.values, strict=True):
        tolerance = baseline.tolerances[name]
        # A difference needs all digits of a large value.
        digits = None if tolerance.kind == "absolute" else baseline.digits
        shown.append(None if value is None else _short(tolerance.stored_value(value), digits))
    return shown


def _short(value: float, digits: int | None = _DIGITS) -> float | int | str:
    """`value` with some digits, or all; infinities as texts, since JSON has none."""
    text = f"{float(value)!r}".removesuffix(".0") if digits is None else f"{value:.{digits}g}"
    if not math.isfinite(value):
        return text
    return int(text) if text.removeprefix("-").isdigit() else float(text)


def from_text(text: str, source: str) -> Baseline:
    """The baseline of a file's text; raises UsageError for anything that `to_text` cannot write."""
    try:
        return _baseline(text)
    except UsageError as error:
        raise UsageError(f"{source}: {error}") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        reason = f"{error}" if isinstance(error, ValueError) else f"damaged: {error!r}"
        raise UsageError(
            f"{source!r} is not a baseline ({reason}); write one with "
            "'sysid-bench baseline save RUN -o FILE'."
        ) from error


def _baseline(text: str) -> Baseline:
    """Read a baseline; raise ValueError with what the text is instead."""
    if not text.strip():
        raise ValueError("it is empty")
    try:
        values = parse_json(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error.msg}, line {error.lineno}") from error
    if not isinstance(values, dict):
        raise ValueError(f"JSON of a {type(values).__name__}, not of an object")
    absent = [key for key in _KEYS if key not in values]
    if absent:
        has = f"has {first_names(values)}" if values else "is empty"
        raise ValueError(f"JSON without {first_names(absent)}; it {has}")
    if values["schema"] != SCHEMA:
        raise ValueError(f"schema {values['schema']!r}; this version reads {SCHEMA}")
    if not any(block["cells"] for block in values["robots"].values()):
        raise ValueError("it holds no cell")
    tolerances = {}
    for metric, written in values["tolerances"].items():
        try:
            tolerances[metric] = Tolerance.from_json(written)
        except UsageError as error:
            raise UsageError(f"tolerance of {metric}: {error}") from error
    return baseline_of(_run(values), tolerances, int(values.get("digits", _DIGITS)))


def _run(values: Mapping[str, Any]) -> RunValues:
    metrics = {}
    for record in values["metrics"]:  # of plug-ins their record, else the name
        name = record if isinstance(record, str) else record["name"]
        if name in METRICS:
            metrics[name] = METRICS[name]
        elif isinstance(record, str):
            raise unknown_name("metric", name, METRICS)
        else:
            metrics[name] = metric_from_record(record)
    robots = values["robots"].items()
    speeds = {
        (robot, part): Speed(float(ratio), float(noise), int(count))
        for robot, block in robots
        for part, (ratio, noise, count) in block.get("speeds", {}).items()
    }
    parameters = {}
    for robot, block in robots:
        settings = block["parameters"]
        for setting, written in settings.items():  # the inverse of `_like_the_first`
            whole = {**settings.get(written.get(_LIKE, ""), {}), **written}
            true = {key: float(value) for key, value in whole.items() if key != _LIKE}
            parameters[robot, setting] = true
    return RunValues(
        name=str(values["suite"]),
        axes=tuple(map(str, values["axes"])),
        metrics=metrics,
        cells=dict(cell for robot, block in robots for cell in _cells(robot, block, len(metrics))),
        parameters=parameters,
        origin=dict(values["origin"]),
        speeds=speeds,
        models={robot: _model(block["model"]) for robot, block in robots if "model" in block},
    )


def _model(written: Any) -> Behaviour:
    """The behaviour of a robot; raises ValueError for anything else."""
    quantities = [*written.items(), *(pair for joint in written.values() for pair in joint.items())]
    lists = [value for _, value in quantities if not isinstance(value, Mapping)]
    if not all(isinstance(values, list) for values in lists):
        raise ValueError("a model is joints with lists of values")
    return {joint: dict(found) for joint, found in written.items()}


def _cells(robot: str, block: Mapping[str, Any], count: int) -> Iterator[tuple[str, CellValues]]:
    for key, (labels, status, *values) in block["cells"].items():
        text = tuple(labels.split(" | ")) if labels else ()
        if len(values) == 1 and isinstance(values[0], str):
            yield key, CellValues(robot, text, status, (None,) * count, values[0])
            continue
        if len(values) != count:
            raise ValueError(f"the cell {key} has {len(values)} values for {count} metrics")
        numbers = tuple(None if value is None else float(value) for value in values)
        yield key, CellValues(robot, text, status, numbers)


@dataclass(frozen=True)
class Update:
    """Values of a baseline after an update, and how many changes of each kind it took over."""

    run: RunValues
    counts: Mapping[str, int]

    @property
    def taken(self) -> int:
        """Number of all changes."""
        return sum(self.counts.values())


def update_of(changes: RunDifference) -> Update:
    """The baseline `changes.before` with all changes: of statuses, values and base parameters,
    values of a metric that drifts, behaviour of robots, cells and settings that appeared or ran for
    the first time, cells that vanished, and the times of robots in which a part became slower or
    faster, or whose cells or parts are other ones. Cells without a row stay. Versions and machine
    are those of the run where anything is taken over."""
    old, now = changes.before, changes.after
    done = {name for name, cell in now.cells.items() if not cell.is_open}
    ran = [name for name, was in old.cells.items() if was.is_open and name in done]
    settings = [key for key in now.parameters if key not in old.parameters]
    speeds, timed = _updated_speeds(changes)
    robots = {cell.robot for cell in now.cells.values()}
    models = {robot: model for robot, model in old.models.items() if robot in robots}
    new = [robot for robot in now.models if robot not in models]
    counts = {
        "values and statuses": len(changes.cells),
        "values of drifting metrics": sum(len(drift.cells) for drift in changes.drifts),
        "base parameters": len(changes.parameters),
        "quantities of robots": len(changes.models),
        "new cells": len(changes.appeared) + len(ran),
        "vanished cells": len(changes.vanished),
        "new settings and robots": len(settings) + len(new),
        "times": timed,
    }
    run = replace(
        old,
        axes=now.axes,
        cells=_updated_cells(changes, {*changes.appeared, *ran}),
        parameters=_parameters(changes),
        origin=now.origin if any(counts.values()) else old.origin,
        speeds=speeds,
        models=_updated_models({**now.models, **models}, changes.models),
    )
    return Update(run, {what: count for what, count in counts.items() if count})


def _updated_models(
    models: Mapping[str, Behaviour], changes: Iterable[BehaviourChange]
) -> dict[str, Behaviour]:
    """The behaviour of robots with what changed; quantities that are the same stay."""
    found = {
        robot: {joint: dict(quantities) for joint, quantities in model.items()}
        for robot, model in models.items()
    }
    for change in changes:
        model = found[change.robot]
        if change.after is None:
            del model[change.joint][change.quantity]
        else:
            model.setdefault(change.joint, {})[change.quantity] = change.after
    # A joint without any quantity is gone.
    return {robot: {j: q for j, q in model.items() if q} for robot, model in found.items()}


def _updated_cells(changes: RunDifference, new: set[str]) -> dict[str, CellValues]:
    """The cells of the run with the values of before, but for those that changed."""
    by_cell: dict[str, set[str]] = {}
    for change in changes.cells:
        by_cell.setdefault(change.cell, set()).add(change.metric)
    for drift in changes.drifts:
        for cell in drift.cells:
            by_cell.setdefault(cell, set()).add(drift.metric)
    cells = {}
    for cell, now in changes.after.cells.items():
        # Values within their tolerance stay, or baselines would drift with each update.
        changed = by_cell.get(cell, set())
        if cell in new or STATUS in changed:
            cells[cell] = now
            continue
        was = changes.before.cells[cell]
        there = dict(zip(changes.after.metrics, now.values, strict=True))
        pairs = zip(changes.before.metrics, was.values, strict=True)
        values = tuple(there[name] if name in changed else value for name, value in pairs)
        # The labels are those that the plan gives now.
        cells[cell] = replace(was, robot=now.robot, labels=now.labels, values=values)
    return cells


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


def _updated_speeds(changes: RunDifference) -> tuple[dict[Key, Speed], int]:
    """The speeds after the update, and how many of them were taken over or vanished."""
    old, now = changes.before.speeds, changes.after.speeds
    timed = _timed_robots(changes) if now else set[str]()
    kept = {key: speed for key, speed in old.items() if key[0] not in timed}
    taken = {key: speed for key, speed in now.items() if key[0] in timed}
    gone = [key for key in old if key[0] in timed and key not in taken]
    return kept | taken, len(taken) + len(gone)


def _timed_robots(changes: RunDifference) -> set[str]:
    """Robots whose times are taken over: speeds are relative to all parts of a robot, so that they
    are of one run each."""
    old, now = changes.before, changes.after
    robots = {robot for robot, _ in (*old.speeds, *now.speeds)}
    moved = {one.robot for one in changes.speeds if one.verdict in ("slower", "faster")}
    if ALL in moved:
        return robots
    # Speeds are relative to all parts: one part more changes those of the others.
    moved |= {robot for robot, _ in old.speeds.keys() ^ now.speeds.keys()}
    return {
        robot
        for robot in robots
        if robot in moved or old.cell_labels(robot) != now.cell_labels(robot)
    }
