"""Base parameters as a paper prints them: order of links, parameters taken for zero, coefficients
with symbols of lengths, single parameters first, values and the signs that no body can have.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.tasks.task import task_of, unknown_bodies
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    coefficients,
    expression,
    random_values,
    symbolic_coefficients,
)
from sysid_bench.identifiability.base_map import base_map, structural_factor
from sysid_bench.identifiability.feasible_error import check_bound, feasible_error
from sysid_bench.models.dh_robot import mjcf_of
from sysid_bench.models.dh_table import read_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, BaseMap

LARGEST_VALUE: Final = 1e12
"""Size, in SI units, up to which a number is taken for a base parameter."""


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
    parameters, left_out = _parameters(robot, terms, zero)
    base = base_map(structural_factor(robot, parameters), parameters)
    bodies = unknown_bodies(robot)
    rows = _rows(robot, base)
    given = _values(values, rows, base)
    for row, value in zip(rows, given.tolist(), strict=True):
        is_known = np.isfinite(value)
        row["value"] = value if is_known else None
        # Signs of the value that no body can have.
        row["impossible"] = check_bound(row["terms"], value, bodies) if is_known else None
    missing = [row["expression"] for row in rows if row["value"] is None]
    inertial = {column for body in bodies for column in body.columns}
    known, change = np.isfinite(given), None
    if known.any():  # the change that makes the known values feasible
        change = feasible_error(base.K[known], given[known], base.parameters, bodies)
    return {
        "robot": robot.name,
        "parameters": len(parameters),
        "zero": list(left_out),
        "base_parameters": base.rank,
        "inertial": len(inertial.intersection(base.names)),
        "gap": base.gap,
        "rows": sorted(rows, key=lambda row: len(row["terms"]) > 1),
        "missing": [] if values is None else missing,
        "smallest_change": change,
    }


def _parameters(
    robot: RobotModel, terms: Sequence[str] | None, zero: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parameters (p,) in the order of the paper, and those that are taken for zero."""
    chosen = robot.manifest.terms if terms is None else tuple(terms)
    unknowns = task_of(robot, "robot", chosen).parameters
    usual = () if robot.manifest.paper is None else robot.manifest.paper.zero
    left_out = usual if zero is None else tuple(zero)
    for name in left_out:
        if name not in unknowns:
            raise unknown_name("parameter to be zero", name, unknowns)
    return tuple(name for name in _ordered(robot, unknowns) if name not in left_out), left_out


def _rows(robot: RobotModel, base: BaseMap) -> list[dict[str, Any]]:
    """The sums, each with its coefficients, their symbols and both in print."""
    rows = []
    for terms, symbols in zip(base_expressions(base), _symbols(robot, base), strict=True):
        known = {name: symbols[name] for name in terms if name in symbols}
        texts = {"numbers": expression(terms), "expression": _expression(terms, known)}
        rows.append({"terms": terms, "symbols": known, **texts})
    return rows


def _ordered(robot: RobotModel, unknowns: Sequence[str]) -> tuple[str, ...]:
    """Parameters (p,), body after body as the paper has them, joint terms last; UsageError for a
    body that the robot lacks.

    The order decides which parameters become pivots: those of the links that come last.
    """
    bodies = {body.name: body.columns for body in unknown_bodies(robot)}
    paper = robot.manifest.paper
    first = () if paper is None else paper.order
    for name in first:
        if name not in bodies:
            error = unknown_name("body", name, bodies)
            raise UsageError(f"{robot.manifest.name}: paper.order: {error}")
    columns = [column for name in dict.fromkeys([*first, *bodies]) for column in bodies[name]]
    return tuple(dict.fromkeys([*columns, *unknowns]))


def _symbols(robot: RobotModel, base: BaseMap) -> list[dict[str, str]]:
    """For each row the coefficients that lengths of the robot's table explain.

    The same robot is built with several sets of lengths; a coefficient has a symbol where one
    expression of the lengths gives its value in all of them.
    """
    found: list[dict[str, str]] = [{} for _ in range(base.rank)]
    manifest, dh = robot.manifest, robot.manifest.dh
    if dh is None or manifest.manifest_file is None:
        return found
    table = manifest.manifest_file.parent / dh.table
    if not read_table(table).symbols:
        return found
    sets, maps = random_values(read_table(table).symbols), []
    massless = [body.removeprefix("link") for body in manifest.massless]
    for lengths in sets:
        text = mjcf_of(
            read_table(table, lengths), robot.name, dh.convention, dh.frames, dh.base,
            gravity=robot.tree.gravity.tolist(), massless=massless,
        )  # fmt: skip
        R = structural_factor(load_robot(replace(manifest, text=text)), base.parameters)
        # R = R_pivots K: a QR of its own could choose other pivots at other lengths.
        maps.append(np.linalg.lstsq(R[:, base.pivots], R, rcond=None)[0])
    symbol = cache(partial(symbolic_coefficients, lengths=sets))
    for i, j in np.argwhere(coefficients(base) != 0.0):
        # Rounded, so that coefficients that differ by rounding errors share one search.
        words = symbol(tuple(float(np.round(K[i, j], 9)) for K in maps))
        if words is not None:
            found[i][base.parameters[j]] = words
    return found


def _expression(terms: Mapping[str, float], symbols: Mapping[str, str]) -> str:
    """A sum with symbols of lengths before the parameters, where they are known."""
    words = []  # "- 0.5 link2.m", "+ (a1 + a2) link2.m", "+ link2.m"
    for name, value in terms.items():
        factor = symbols.get(name, f"{value:.4g}")
        if re.search(" [+-] ", factor):  # a sum needs brackets
            words.append(f"+ ({factor}) {name}")
            continue
        sign, size = ("-", factor[1:]) if factor.startswith("-") else ("+", factor)
        words.append(f"{sign} {name}" if size == "1" else f"{sign} {size} {name}")
    return " ".join(words).removeprefix("+ ")


def _values(
    given: Mapping[str, Any] | None, rows: Sequence[Mapping[str, Any]], base: BaseMap
) -> Array:
    """Values (r,) of the rows, NaN where there are none."""
    if given is None:
        return np.full(base.rank, np.nan)
    if isinstance(given.get("base"), list):
        return _in_these_rows(given["base"], base)
    if not all(isinstance(value, (int, float)) for value in given.values()):
        raise UsageError("expected what `identify --json` writes, or {row: value} with numbers.")
    indices: dict[str, int] = {}
    for i, row in enumerate(rows):
        indices |= {row["expression"]: i, row["numbers"]: i, base.names[i]: i}
    out = np.full(base.rank, np.nan)
    for name, value in given.items():
        if name not in indices:
            raise unknown_name("row", name, indices)
        out[indices[name]] = _checked(value, name)
    return out


def _checked(value: Any, name: str) -> Any:
    """The value of a row; raises UsageError for a number that no base parameter is."""
    if isinstance(value, (int, float)) and abs(value) > LARGEST_VALUE:
        raise UsageError(
            f"the value of {name!r} is beyond {LARGEST_VALUE:g}; give base parameters in SI units."
        )
    return value


def _in_these_rows(given: Sequence[Mapping[str, Any]], base: BaseMap) -> Array:
    """Values in these rows of base parameters that were identified in others of the same space:
    K_given.T M = K.T, so that beta = M.T beta_given."""
    # Parameters that are taken for zero here have no column.
    K = np.zeros((len(given), len(base.parameters)))
    for i, row in enumerate(given):
        K[i] = [row["terms"].get(name, 0.0) for name in base.parameters]
    # beta_given = K_given theta and beta = K theta, with equal row spaces of both maps.
    M, *_ = np.linalg.lstsq(K.T, base.K.T, rcond=None)
    if not np.allclose(K.T @ M, base.K.T, atol=1e-6 * np.abs(base.K).max()):
        raise UsageError("the base parameters identified are other ones than those of this table.")
    values = [_checked(row["value"], str(row.get("expression", "a row"))) for row in given]
    return np.asarray(M.T @ np.array(values, dtype=float))
