"""Base parameters as a paper prints them: order of links, parameters taken for zero, coefficients
with symbols of lengths, single parameters first, values and the signs that no body can have.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.identifiability.base_expressions import base_expressions, expression
from sysid_bench.identifiability.base_map import base_map
from sysid_bench.identifiability.feasible_bounds import check_bound, distance_to_feasible
from sysid_bench.identifiability.structural import structural_factor
from sysid_bench.identifiability.symbolic_coefficient import random_values, symbolic_coefficient
from sysid_bench.identifiability.verdicts import coefficients
from sysid_bench.models.dh.dh_robot import mjcf_of
from sysid_bench.models.dh.dh_table import read_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.tasks.task import task_of, unknown_bodies
from sysid_bench.types import Array, BaseMap


def base_table(
    robot: RobotModel,
    terms: Sequence[str] | None = None,
    zero: Sequence[str] | None = None,
    values: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """{robot, parameters, base_parameters, inertial, rows: [{expression, terms, symbols, value,
    impossible}], missing, smallest_change}; single parameters first.

    `zero`: parameters taken for zero (None: as the robot's manifest says). `values`: {"base":
    [{terms, value}]} of an identification, or {row: value} with rows as they are printed here or
    by their first parameter; `missing` are the rows without a value. Raises UsageError.
    """
    manifest = robot.manifest
    chosen = manifest.terms if terms is None else tuple(terms)
    unknowns = task_of(robot, "robot", chosen).parameters
    left_out = _zero(manifest, zero, unknowns)
    parameters = _ordered(robot, manifest, unknowns, left_out)
    base = base_map(structural_factor(robot, parameters), parameters)
    bodies = unknown_bodies(robot)
    rows = _rows(robot, base)
    given = np.full(base.rank, np.nan) if values is None else _values(values, rows, base)
    for row, value in zip(rows, given.tolist(), strict=True):
        known = bool(np.isfinite(value))
        row["value"] = value if known else None
        row["impossible"] = check_bound(row["terms"], value, bodies) if known else None
    change, known = None, np.isfinite(given)
    if known.any():
        change = distance_to_feasible(base.K[known], given[known], parameters, bodies)
    missing = [] if values is None else [r["expression"] for r in rows if r["value"] is None]
    inertial = {column for body in bodies for column in body.columns}
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


def _rows(robot: RobotModel, base: BaseMap) -> list[dict[str, Any]]:
    """The sums, each with its coefficients, their symbols and both in print."""
    rows = []
    for terms, symbols in zip(base_expressions(base), _symbols(robot, base), strict=True):
        known = {name: symbols[name] for name in terms if name in symbols}
        rows.append(
            {
                "terms": terms,
                "symbols": known,
                "numbers": expression(terms),
                "expression": _expression(terms, known),
            }
        )
    return rows


def _zero(
    manifest: Manifest, zero: Sequence[str] | None, parameters: Sequence[str]
) -> tuple[str, ...]:
    usual = () if manifest.paper is None else manifest.paper.zero
    chosen = usual if zero is None else tuple(zero)
    for name in chosen:
        if name not in parameters:
            raise unknown_name("parameter to be zero", name, parameters)
    return chosen


def _ordered(
    robot: RobotModel, manifest: Manifest, unknowns: Sequence[str], left_out: Sequence[str]
) -> tuple[str, ...]:
    """Parameters (p,), body after body as the paper has them, joint terms last."""
    bodies = {body.name: body.columns for body in unknown_bodies(robot)}
    first = () if manifest.paper is None else manifest.paper.order
    for name in first:
        if name not in bodies:
            raise UsageError(f"{manifest.name}: paper.order: {unknown_name('body', name, bodies)}")
    names = dict.fromkeys([*first, *bodies])
    columns = [column for name in names for column in bodies[name]]
    rest = [name for name in unknowns if name not in columns]
    return tuple(name for name in [*columns, *rest] if name not in left_out)


def _symbols(robot: RobotModel, base: BaseMap) -> list[dict[str, str]]:
    """For each row the coefficients that lengths of the robot's table explain.

    The same robot is built with several sets of lengths; a coefficient has a symbol where one
    expression of the lengths gives its value in all of them.
    """
    found: list[dict[str, str]] = [{} for _ in range(base.rank)]
    dh, file = robot.manifest.dh, robot.manifest.manifest_file
    if dh is None or file is None:
        return found
    table = file.parent / dh.table
    names = read_table(table).symbols
    if not names:
        return found
    sets = random_values(names)
    massless = [body.removeprefix("link") for body in robot.manifest.massless]
    maps = []
    for lengths in sets:
        text = mjcf_of(
            read_table(table, lengths), robot.name, dh.convention, dh.frames, dh.base,
            gravity=robot.tree.gravity.tolist(), massless=massless,
        )  # fmt: skip
        other = load_robot(replace(robot.manifest, text=text))
        maps.append(_same_pivots(structural_factor(other, base.parameters), base.pivots))
    cache: dict[tuple[float, ...], str | None] = {}
    for i, j in np.argwhere(coefficients(base) != 0.0):
        values = tuple(float(np.round(K[i, j], 9)) for K in maps)
        if values not in cache:
            cache[values] = symbolic_coefficient(values, sets)
        if (words := cache[values]) is not None:
            found[i][base.parameters[j]] = words
    return found


def _same_pivots(R: Array, pivots: Array) -> Array:
    """K (r, p) of another regressor on the same pivots."""
    return np.asarray(np.linalg.lstsq(R[:, pivots], R, rcond=None)[0])


def _expression(terms: Mapping[str, float], symbols: Mapping[str, str]) -> str:
    """A sum with symbols of lengths before the parameters, where they are known."""
    words: list[str] = []
    for name, value in terms.items():
        factor = symbols.get(name, f"{value:.4g}")
        negative = factor.startswith("-") and " + " not in factor and " - " not in factor
        size = factor.removeprefix("-") if negative else factor
        if " + " in size or " - " in size:
            size = f"({size})"
        words += ["-" if negative else "+", *([] if size == "1" else [size]), name]
    return " ".join(words).removeprefix("+ ")


def _values(given: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], base: BaseMap) -> Array:
    """Values (r,) of the rows, NaN where there are none."""
    if isinstance(given.get("base"), list):
        return _in_these_rows(given["base"], base)
    if not all(isinstance(value, (int, float)) for value in given.values()):
        raise UsageError(
            "expected what `identify --json-out` writes, or {row: value} with numbers."
        )
    indices: dict[str, int] = {}
    for i, row in enumerate(rows):
        indices |= {row["expression"]: i, row["numbers"]: i, base.names[i]: i}
    out = np.full(base.rank, np.nan)
    for name, value in given.items():
        if name not in indices:
            raise unknown_name("row", name, indices)
        out[indices[name]] = value
    return out


def _in_these_rows(given: Sequence[Mapping[str, Any]], base: BaseMap) -> Array:
    """Values in these rows of base parameters that were identified in others of the same space:
    K_given.T M = K.T, so that beta = M.T beta_given."""
    indices = {name: j for j, name in enumerate(base.parameters)}
    K = np.zeros((len(given), len(indices)))
    for i, row in enumerate(given):
        for name, value in row["terms"].items():
            if name in indices:  # the others are those that are taken for zero
                K[i, indices[name]] = value
    M, *_ = np.linalg.lstsq(K.T, base.K.T, rcond=None)
    if not np.allclose(K.T @ M, base.K.T, atol=1e-6 * np.abs(base.K).max()):
        raise UsageError("the base parameters identified are other ones than those of this table.")
    return np.asarray(M.T @ np.array([row["value"] for row in given], dtype=float))
