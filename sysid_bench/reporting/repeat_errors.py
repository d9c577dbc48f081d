"""Cells that repeat one experiment become the errors of each parameter in each repeat."""

from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.evaluation.repeat_statistic import ENOUGH_REPEATS, WITH_BOUND, Figure, mean_error
from sysid_bench.types import Array

if TYPE_CHECKING:
    import pandas as pd

SETTING: Final = (
    *("robot", "payload", "task", "terms", "plant", "prior", "excitation", "motions", "held_out"),
    *("simulation", "rate", "noise", "signals", "pipeline", "estimator"),
)
PARAMETER_COLUMNS: Final = ("id", "body", "name", "base_error", "bound")
"""Columns of the parameters that are read here."""


def repeat_statistic(
    metric: str, cells: "pd.DataFrame", parameters: "pd.DataFrame"
) -> Figure | None:
    """A figure of all repeats of some cells; of several settings together where there are several.

    None where fewer than ENOUGH_REPEATS gave numbers, where all of them gave the same, or, for what
    is measured by the bound, where a parameter has none.
    """
    errors, bound = repeat_errors(cells, parameters)
    if not _has_scatter(errors):
        return None
    if metric == "bias":
        return mean_error(errors)
    return WITH_BOUND[metric](errors, bound) if np.isfinite(bound).all() else None


def _has_scatter(errors: Array) -> bool:
    """True where there are enough repeats, and the noise of each moved every parameter."""
    return len(errors) >= ENOUGH_REPEATS and errors.size > 0 and bool(np.ptp(errors, axis=0).all())


def repeat_errors(cells: "pd.DataFrame", parameters: "pd.DataFrame") -> tuple[Array, Array]:
    """Errors (n, r) of each base parameter of each setting (r) in the repeats (n) that all of them
    have, and the bound (r,), NaN where there is none: the root mean square of those of single
    repeats, which differ where noise disturbs the motion."""
    settings = [name for name in SETTING if name in cells.columns]
    lines = parameters[parameters["id"].isin(cells["id"]) & parameters["base_error"].notna()]
    lines = lines.merge(cells[["id", "repeat", *settings]], on="id")
    if len(lines) == 0:
        return np.zeros((0, 0)), np.zeros(0)
    lines = lines.assign(square=lines["bound"].astype(float) ** 2)
    where = [*settings, "body", "name"]
    # A repeat that failed in one setting is left out of all, so that the rows are complete.
    errors = lines.pivot(index="repeat", columns=where, values="base_error").dropna()
    squares = lines.pivot(index="repeat", columns=where, values="square")
    bound = np.sqrt(squares[errors.columns].loc[errors.index].mean(axis=0, skipna=False))
    return errors.to_numpy(dtype=float), bound.to_numpy(dtype=float)
