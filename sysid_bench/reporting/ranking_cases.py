"""Cases in which methods are compared: robot, payload, motion, noise, ... and repeat, that is,
everything but the method."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.reporting.selection import label
from sysid_bench.types import Array, Metric

if TYPE_CHECKING:
    import pandas as pd

_CASE: Final = (
    "robot", "payload", "task", "terms", "plant", "prior", "excitation", "motions", "held_out",
    "simulation", "rate", "noise", "signals", "pipeline", "repeat",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class RankingCases:
    """errors (cases, methods), NaN where there is none; robot and motion of each case."""

    errors: Array
    robots: tuple[str, ...]
    motions: tuple[str, ...]
    methods: tuple[str, ...]
    left_out: int

    @property
    def scaled_errors(self) -> Array:
        """Errors (cases, methods) over the smallest of the case."""
        return np.asarray(self.errors / np.fmin.reduce(self.errors, axis=1)[:, None])


def ranking_cases(cells: "pd.DataFrame", metric: Metric) -> RankingCases:
    """The cases in which every method has a row. Raises UsageError where there is none, or only
    one method."""
    names = [name for name in _CASE if name in cells.columns]
    labels = cells[names].map(label)
    lines = labels.assign(estimator=cells["estimator"].map(label), error=_errors(cells, metric))
    rows = lines.groupby([*names, "estimator"], sort=False)["error"].agg(["size", "first"])
    size, errors = (rows[which].unstack("estimator") for which in ("size", "first"))
    methods = list(dict.fromkeys(lines["estimator"]))
    # A failed cell has a row without an error; a cell that was never planned has no row.
    whole = size[methods].notna().all(axis=1)
    if len(methods) < 2 or not whole.any():
        raise UsageError(
            f"A ranking by {metric.name} found {len(methods)} methods "
            f"({', '.join(methods) or 'none'}) and no case in which all of them have a row; "
            "'select' those that ran on the same cases."
        )
    errors = errors.loc[whole, methods]
    cases = errors.index.to_frame(index=False)
    return RankingCases(
        errors.to_numpy(dtype=float),
        tuple(cases["robot"]),
        tuple(cases.get("excitation", [""] * len(cases))),
        tuple(methods),
        int((~whole).sum()),
    )


def _errors(cells: "pd.DataFrame", metric: Metric) -> "pd.Series":
    """Errors of the cells, NaN where a cell is not ok or has none."""
    import pandas as pd

    values = cells[metric.name] if metric.name in cells else pd.Series(np.nan, cells.index)
    error = pd.to_numeric(values.where(cells["status"] == "ok"), errors="coerce")
    # Errors below the floor are rounding: they compare as equal. A zero would divide by zero.
    return error.clip(lower=max(metric.floor, np.finfo(float).tiny))


def mean_by_robot(logs: Array, cases: RankingCases) -> Array:
    """Means (robots, motions, methods) of logs (cases, methods); where robots moved differently,
    all motions of a robot are one."""
    moved: dict[str, set[str]] = {}
    for robot, motion in zip(cases.robots, cases.motions, strict=True):
        moved.setdefault(robot, set()).add(motion)
    is_same = len(set(map(frozenset, moved.values()))) == 1
    motions = cases.motions if is_same else ("",) * len(cases.motions)
    return _block_means(logs, cases.robots, motions)


def _block_means(logs: Array, robots: Sequence[str], motions: Sequence[str]) -> Array:
    """Means over the cases of every robot and motion, in the order of first appearance."""
    who, what = np.array(robots), np.array(motions)
    each = {robot: dict.fromkeys(what[who == robot]) for robot in dict.fromkeys(robots)}
    return np.array(
        [
            [logs[(who == robot) & (what == motion)].mean(axis=0) for motion in moved]
            for robot, moved in each.items()
        ]
    )
