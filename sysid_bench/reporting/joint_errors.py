"""Relative torque errors per joint of every robot, as tables of the HTML report."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.notation import ABSENT, notation
from sysid_bench.reporting.selection import label

if TYPE_CHECKING:
    import pandas as pd

JOINT_COLUMNS: Final = ("id", "name", "relative", "small")
"""Columns of the joints that are read here."""


@dataclass(frozen=True)
class JointErrors:
    """Relative torque error per joint of a robot; one column per estimator, median and worst."""

    robot: str
    estimators: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def joint_errors(cells: "pd.DataFrame", joints: "pd.DataFrame") -> list[JointErrors]:
    """Per robot: joints as rows; joints of small torque are named so.

    `joints` name their cell in the column `id` or `cell`.
    """
    joints = joints if "id" in joints else joints.rename(columns={"cell": "id"})
    if joints.empty or not {"id", "name", "relative"} <= set(joints.columns):
        return []
    methods = cells[["id", "robot"]].assign(method=_methods(cells))
    # Joints may carry fields of their cell, too; those of the cells are the ones to group by.
    columns = [name for name in JOINT_COLUMNS if name in joints.columns]
    merged = joints[columns].merge(methods, on="id").drop(columns="id")
    return [_errors_of_robot(*group) for group in merged.groupby("robot", sort=False)]


def _methods(cells: "pd.DataFrame") -> list[str]:
    """The estimator of each cell and its noise where there are several: exact data would hide
    what noise does."""
    names = list(map(label, cells["estimator"]))
    noises = list(map(label, cells.get("noise", ())))
    if len(set(noises)) < 2:
        return names
    return [f"{name}, {noise}" for name, noise in zip(names, noises, strict=True)]


def _errors_of_robot(robot: Any, group: "pd.DataFrame") -> JointErrors:
    estimators = tuple(dict.fromkeys(group["method"]))
    errors = group.groupby(["name", "method"], sort=False)["relative"].agg(["median", "max"])
    found = {key: (median, worst) for key, median, worst in errors.itertuples()}
    rows = []
    for joint, lines in group.groupby("name", sort=False):
        numbers = [_median_and_worst(found.get((joint, name))) for name in estimators]
        rows.append((_title(joint, lines), *numbers))
    return JointErrors(label(robot), estimators, tuple(rows))


def _title(joint: Any, cells: "pd.DataFrame") -> str:
    """A joint's name. An error relative to a small torque is large without being a fault."""
    has_small_torque = "small" in cells and bool(cells["small"].any())
    return f"{label(joint)} (small torque)" if has_small_torque else label(joint)


def _median_and_worst(errors: tuple[float, float] | None) -> str:
    """Median (largest), each in its own notation: a table holds exact and noisy cells."""
    if errors is None or math.isnan(errors[0]):
        return ABSENT
    return f"{_two_digits(errors[0])} ({_two_digits(errors[1])})"


def _two_digits(value: Any) -> str:
    return notation([float(value)], 2).html_text(float(value))
