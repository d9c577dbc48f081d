"""Sections that pages share."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import count_text
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import EXACT
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.tables import ABSENT, Table, notation
from sysid_bench.words import RECORDED

if TYPE_CHECKING:
    import pandas as pd


SCORE: Final = "torque_error"
_MEDIAN: Final = {"metric": SCORE, "interval": "iqr"}


def plant_tables(cells: "pd.DataFrame") -> Iterator[Table]:
    """Median error of each method by plant, where cells have several plants and an error."""
    if _is_scored(cells) and "plant" in cells and cells["plant"].map(label).nunique() > 1:
        shape = {"name": "levels", "rows": ["estimator"], "columns": ["plant"]}
        yield build_table(cells, {**shape, "cells": _MEDIAN})


def source_tables(cells: "pd.DataFrame") -> Iterator[Table]:
    """Median error of each method on recorded and on simulated data with noise, of the robots that
    have both; nothing where no robot has."""
    if not _is_scored(cells) or not {"plant", "noise"} <= set(cells.columns):
        return
    is_recorded = cells["plant"].map(label) == RECORDED
    # Noise-free cells have errors of rounding, which no recording can have.
    is_noisy = is_recorded | (cells["noise"].map(label) != EXACT)
    kept = cells[is_noisy & cells[SCORE].notna()]
    data = is_recorded[kept.index].map({True: RECORDED, False: "simulated"})
    lines = kept.assign(data=data)
    sources = lines.groupby("robot")["data"].nunique()
    # Only robots that have both: else easy robots on one side would pass for easy data.
    lines = lines[lines["robot"].isin(sources.index[sources > 1])]
    if len(lines):
        spec: dict[str, Any] = {
            "name": "recorded-and-simulated",
            "title": "Recorded and simulated",
            "rows": ["robot", "estimator"],
            "columns": ["data"],
        }
        yield build_table(lines, {**spec, "cells": _MEDIAN})


def _is_scored(cells: "pd.DataFrame") -> bool:
    return SCORE in cells and bool(cells[SCORE].notna().any())


_SETTINGS: Final = (
    ("Simulation", "simulation"), ("Excitation", "excitation"), ("Rate", "rate"),
    ("Noise", "noise"), ("Signals", "signals"), ("Pipeline", "pipeline"),
    ("Held-out motions", "held_out"),
)  # fmt: skip
_PLANTS: Final = {"matched": " (the robot with exactly the terms of its model)"}
_NOISE_FREE: Final = "noise-free torque of held-out motions"
_EMPTY: Final = {"noise": "exact"}
"""Reading of an empty setting by key; that of every other key is "default"."""


def experiment_lines(suite: Mapping[str, Any], cells: "pd.DataFrame") -> list[tuple[str, str]]:
    """Assumptions behind the numbers, from the suite, else from the cells."""
    defaults, runs = suite.get("defaults") or {}, suite.get("run") or {}
    plant, prior = (_setting(defaults, cells, key) for key in ("plant", "prior"))
    # A prior that is drawn around the truth names the deviation of a mass.
    prior += " (standard deviations of a draw around the truth)" if "mass" in prior else ""
    data, against = _data_texts(set(map(label, cells.get("plant", ()))))
    lines = [
        ("Data", data),
        ("Task", _setting(defaults, cells, "task")),
        ("Plant", plant + _PLANTS.get(plant, "")),
        ("Prior knowledge given to methods", prior),
        *((title, _setting(defaults, cells, key)) for title, key in _SETTINGS),
        ("Repeats", count_text(runs["repeats"], "noise draw") if "repeats" in runs else ""),
        ("Payload and link tasks", "Payload and link tasks take the rest of the robot as known."),
        ("Scores", f"Torque errors are against the {against}."),
    ]
    return [line for line in lines if line[1]]


def _data_texts(plants: set[str]) -> tuple[str, str]:
    """Origin of the data of plants, and the reference of their torque errors."""
    if plants == {RECORDED}:
        return "Recorded on robots.", "measured torque of held-out recordings"
    data, against = "Simulated with MuJoCo; no real robot was measured.", _NOISE_FREE
    if RECORDED in plants:
        data = "Recorded on robots, and simulated with MuJoCo."
        against += " or the measured torque of held-out recordings"
    return data, against


def _setting(defaults: Mapping[str, Any], cells: "pd.DataFrame", key: str) -> str:
    """Choices of a setting: those that the suite declares, else those that the cells have."""
    if key not in defaults:
        return "; ".join(dict.fromkeys(map(label, cells.get(key, ()))))
    value, empty = defaults[key], _EMPTY.get(key, "default")
    choices = value if isinstance(value, list) else [value]
    return "; ".join(empty if choice == {} else label(choice) for choice in choices)


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
    # The estimator of each cell and its noise where there are several: exact data would hide what
    # noise does.
    names, noises = list(map(label, cells["estimator"])), list(map(label, cells.get("noise", ())))
    if len(set(noises)) > 1:
        names = [f"{name}, {noise}" for name, noise in zip(names, noises, strict=True)]
    methods = cells[["id", "robot"]].assign(method=names)
    # Joints may carry fields of their cell, too; those of the cells are the ones to group by.
    columns = [name for name in JOINT_COLUMNS if name in joints.columns]
    merged = joints[columns].merge(methods, on="id").drop(columns="id")
    return [_errors_of_robot(*group) for group in merged.groupby("robot", sort=False)]


def _errors_of_robot(robot: Any, group: "pd.DataFrame") -> JointErrors:
    estimators = tuple(dict.fromkeys(group["method"]))
    # A column of None alone is one of objects before pandas 3.
    group = group.astype({"relative": float})
    errors = group.groupby(["name", "method"], sort=False)["relative"].agg(["median", "max"])
    found = {key: (median, worst) for key, median, worst in errors.itertuples()}
    rows = []
    for joint, lines in group.groupby("name", sort=False):
        numbers = [_median_and_worst(found.get((joint, name))) for name in estimators]
        # An error relative to a small torque is large without being a fault.
        has_small_torque = "small" in lines and bool(lines["small"].any())
        rows.append((label(joint) + (" (small torque)" if has_small_torque else ""), *numbers))
    return JointErrors(label(robot), estimators, tuple(rows))


def _median_and_worst(errors: tuple[float, float] | None) -> str:
    """Median (largest), each in its own notation: a table holds exact and noisy cells."""
    if errors is None or math.isnan(errors[0]):
        return ABSENT
    median, worst = (notation([float(x)], 2).html_text(float(x)) for x in errors)
    return f"{median} ({worst})"
