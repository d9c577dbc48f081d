"""Errors of recorded robots by the length of the training."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.reporting.size_figure import SizeErrors
from sysid_bench.words import REFERENCE

if TYPE_CHECKING:
    import pandas as pd

DRAWN: Final = ("wls", "lmi", "entropic", "a-priori")
"""Methods in the figure of training lengths."""


def size_errors(cells: "pd.DataFrame", joints: "pd.DataFrame") -> tuple[SizeErrors, ...]:
    """Return the errors of DRAWN methods by the length of the training, robot by robot."""
    found = []
    for name, every in cells.groupby("robot", sort=False):
        lengths = every.groupby("pipeline")["log.seconds"].nunique()
        part = every[every["pipeline"] == lengths.idxmax()]
        errors = {method: _by_length(part, method) for method in DRAWN}
        drawn = {method: points for method, points in errors.items() if points}
        found.append(SizeErrors(str(name), drawn, floor_of(cells_of_motions(part), joints)))
    return tuple(found)


def _by_length(cells: "pd.DataFrame", method: str) -> dict[float, float]:
    rows: Sequence[tuple[float, float]] = list(
        cells.loc[cells["estimator"] == method, ["log.seconds", "torque_error"]].itertuples(
            index=False, name=None
        )
    )
    return {float(s): float(e) for s, e in rows if math.isfinite(e)}


def cells_of_motions(cells: "pd.DataFrame") -> "pd.DataFrame":
    """Return the cells with whole training motions: the longest of each robot."""
    longest = cells.groupby("robot")["log.seconds"].transform("max")
    return cells[cells["log.seconds"] >= 0.9 * longest]


def floor_of(cells: "pd.DataFrame", joints: "pd.DataFrame") -> float | None:
    """Return the RMS over joints of the error of repeating the training torque; None where the test
    is another motion."""
    wanted = cells.loc[cells["estimator"] == REFERENCE, "id"]
    parts = joints[joints["id"].isin(wanted) & ~joints["small"].fillna(False).astype(bool)]
    squares = parts["replayed"].dropna().astype(float) ** 2
    # Pipelines filter the training torque differently, and the test torque alike.
    means = squares.groupby(parts["id"]).mean()
    return None if means.empty else float(np.sqrt(means.min()))
