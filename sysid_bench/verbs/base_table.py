"""Base parameters as a paper prints them: its order of links, what it takes for zero, coefficients
with the names of lengths, single parameters first, a column of values and which of them cannot be.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from sysid_bench.models.manifest import Manifest
    from sysid_bench.models.robot import RobotModel
    from sysid_bench.types import Array, BaseMap


def paper_table(
    source: str | Path,
    terms: Sequence[str] | None = None,
    zero: Sequence[str] | None = None,
    values: str | Path | Mapping[str, Any] | None = None,
    robots_dir: Path | None = None,
) -> dict[str, Any]:
    """{robot, parameters, base_parameters, inertial, rows: [{expression, terms, symbols, value,
    impossible}], missing, smallest_change}; single parameters first.

    `zero`: parameters taken for zero (None: as the robot's manifest says). `values`: a JSON file
    or what it would hold, either what `identify --json-out` wrote, or {row: value} with rows as
    they are printed here or by the first parameter in them; `missing` are the rows without a value.
    Raises UsageError.
    """
    from sysid_bench.identifiability.base_expressions import base_expressions, expression
    from sysid_bench.identifiability.base_map import base_map
    from sysid_bench.identifiability.sign_bounds import infeasible_signs, smallest_feasible_change
    from sysid_bench.identifiability.structural import structural_factor
    from sysid_bench.models.load import load_robot
    from sysid_bench.tasks.task import task_of, unknown_bodies

    robot = load_robot(source, robots_dir=robots_dir)
    manifest = robot.manifest
    chosen = manifest.terms if terms is None else tuple(terms)
    asked = task_of(robot, "robot", chosen)
    left_out = _zero(manifest, zero, asked.parameters)
    parameters = _ordered(robot, manifest, asked.parameters, left_out)
    base = base_map(structural_factor(robot, parameters), parameters)
    symbols = _symbols(robot, base)
    inertial = {column for body in unknown_bodies(robot) for column in body.columns}
    rows: list[dict[str, Any]] = [
        {
            "terms": own,
            "symbols": {name: symbols[i][name] for name in own if name in symbols[i]},
            "numbers": expression(own),
        }
        for i, own in enumerate(base_expressions(base))
    ]
    for row in rows:
        row["expression"] = _expression(row["terms"], row["symbols"])
    told = None if values is None else _values(values, rows, base)
    bodies = unknown_bodies(robot)
    for i, row in enumerate(rows):
        value = None if told is None or np.isnan(told[i]) else float(told[i])
        row["value"] = value
        row["impossible"] = None if value is None else infeasible_signs(row["terms"], value, bodies)
    change = None
    if told is not None and (known := np.isfinite(told)).any():
        change = smallest_feasible_change(base.K[known], told[known], parameters, bodies)
    missing = [] if told is None else [r["expression"] for r in rows if r["value"] is None]
    return {
        "robot": robot.name,
        "parameters": len(parameters),
        "zero": list(left_out),
        "base_parameters": base.rank,
        "inertial": sum(name in inertial for name in base.names),
        "gap": base.gap,
        "rows": sorted(rows, key=lambda row: len(row["terms"]) > 1),
        "missing": missing,
        "smallest_change": change,
    }


def lines(answer: Mapping[str, Any]) -> list[str]:
    """The rows one per line, with their values where there are any."""
    rows = answer["rows"]
    if all(row["value"] is None for row in rows):
        return [row["expression"] for row in rows]
    told = [
        f"{'-' if row['value'] is None else format(row['value'], '.4g'):>10}  {row['expression']}"
        + (f"   IMPOSSIBLE: {row['impossible']}" if row["impossible"] else "")
        for row in rows
    ]
    change = answer["smallest_change"]
    if change is not None and change > 1e-6:
        told.append(
            f"No physical robot has these values: some have to change by {change:.3g} or more."
        )
    return told


def _zero(
    manifest: "Manifest", zero: Sequence[str] | None, parameters: Sequence[str]
) -> tuple[str, ...]:
    own = () if manifest.paper is None else manifest.paper.zero
    chosen = own if zero is None else tuple(zero)
    for name in chosen:
        if name not in parameters:
            raise unknown_name("parameter to be zero", name, parameters)
    return chosen


def _ordered(
    robot: "RobotModel", manifest: "Manifest", asked: Sequence[str], left_out: Sequence[str]
) -> tuple[str, ...]:
    """Parameters (p,), body after body as the paper has them, joint terms last."""
    from sysid_bench.tasks.task import unknown_bodies

    bodies = {body.name: body.columns for body in unknown_bodies(robot)}
    first = () if manifest.paper is None else manifest.paper.order
    for name in first:
        if name not in bodies:
            raise UsageError(f"{manifest.name}: paper.order: {unknown_name('body', name, bodies)}")
    names = dict.fromkeys([*first, *bodies])
    columns = [column for name in names for column in bodies[name]]
    rest = [name for name in asked if name not in columns]
    return tuple(name for name in [*columns, *rest] if name not in left_out)


def _symbols(robot: "RobotModel", base: "BaseMap") -> list[dict[str, str]]:
    """For each row the coefficients that lengths of the robot's table explain."""
    from sysid_bench.identifiability.structural import structural_factor
    from sysid_bench.identifiability.symbols import lengths_of, symbolic_coefficient
    from sysid_bench.identifiability.verdicts import coefficients
    from sysid_bench.models.dh.dh_robot import mjcf_of
    from sysid_bench.models.dh.dh_table import read_table
    from sysid_bench.models.load import load_robot

    empty: list[dict[str, str]] = [{} for _ in range(base.rank)]
    dh, file = robot.manifest.dh, robot.manifest.manifest_file
    if dh is None or file is None:
        return empty
    table = file.parent / dh.table
    names = read_table(table).symbols
    if not names:
        return empty
    sets = lengths_of(names)
    massless = [body.removeprefix("link") for body in robot.manifest.massless]
    maps = []
    for lengths in sets:
        text = mjcf_of(
            read_table(table, lengths), robot.name, dh.convention, dh.frames, dh.base,
            robot.tree.gravity.tolist(), massless,
        )  # fmt: skip
        other = load_robot(replace(robot.manifest, text=text))
        maps.append(_same_pivots(structural_factor(other, base.parameters), base.pivots))
    found = empty
    cache: dict[tuple[float, ...], str | None] = {}
    for i, j in np.argwhere(coefficients(base) != 0.0):
        values = tuple(float(np.round(K[i, j], 9)) for K in maps)
        if values not in cache:
            cache[values] = symbolic_coefficient(values, sets)
        if (words := cache[values]) is not None:
            found[i][base.parameters[j]] = words
    return found


def _same_pivots(R: "Array", pivots: "Array") -> "Array":
    """K (r, p) of another regressor on the same pivots."""
    return np.linalg.lstsq(R[:, pivots], R, rcond=None)[0]


def _expression(terms: Mapping[str, float], symbols: Mapping[str, str]) -> str:
    """A sum with names of lengths before the parameters, where they are known."""
    words = []
    for name, value in terms.items():
        own = symbols.get(name, f"{value:.4g}")
        negative = own.startswith("-") and " + " not in own and " - " not in own
        size = own.removeprefix("-") if negative else own
        if " + " in size or " - " in size:
            size = f"({size})"
        words += ["-" if negative else "+", *([] if size == "1" else [size]), name]
    return " ".join(words).removeprefix("+ ")


def _values(
    source: str | Path | Mapping[str, Any], rows: Sequence[Mapping[str, Any]], base: "BaseMap"
) -> "Array":
    """Values (r,) of the rows, NaN where there are none."""
    file = "the answer" if isinstance(source, Mapping) else Path(source)
    told: Any = source
    if isinstance(file, Path):
        try:
            told = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise UsageError(f"{str(file)!r} is no readable JSON: {error}.") from error
    if isinstance(told, dict) and isinstance(told.get("base"), list):
        return _of_answer(told["base"], base, file)
    if not isinstance(told, dict) or not all(isinstance(v, (int, float)) for v in told.values()):
        raise UsageError(
            f"{file}: expected what `identify --json-out` writes, or {{row: value}} with numbers."
        )
    places: dict[str, int] = {}
    for i, row in enumerate(rows):
        places |= {row["expression"]: i, row["numbers"]: i, base.names[i]: i}
    out = np.full(base.rank, np.nan)
    for name, value in told.items():
        if name not in places:
            raise UsageError(f"{file}: {unknown_name('row', name, places)}")
        out[places[name]] = value
    return out


def _of_answer(told: Sequence[Mapping[str, Any]], base: "BaseMap", file: Path | str) -> "Array":
    """Values in these rows of base parameters that were identified in others of the same space."""
    places = {name: j for j, name in enumerate(base.parameters)}
    K = np.zeros((len(told), len(places)))
    for i, row in enumerate(told):
        for name, value in row["terms"].items():
            if name in places:  # the others are those that are taken for zero
                K[i, places[name]] = value
    M, *_ = np.linalg.lstsq(K.T, base.K.T, rcond=None)
    if not np.allclose(K.T @ M, base.K.T, atol=1e-6 * np.abs(base.K).max()):
        raise UsageError(f"{file} identified other base parameters than those of this table.")
    return M.T @ np.array([row["value"] for row in told], dtype=float)
