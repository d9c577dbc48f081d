"""Cells that repeat one experiment become the errors of each parameter in each repeat."""

from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.evaluation.repeat_statistic import (
    ENOUGH_REPEATS,
    WITH_BOUND,
    Figure,
    mean_error,
    share_interval,
)
from sysid_bench.types import Array
from sysid_bench.words import STD_FROM

if TYPE_CHECKING:
    import pandas as pd

SETTING: Final = (
    *("robot", "payload", "task", "terms", "plant", "prior", "excitation", "motions", "held_out"),
    *("simulation", "rate", "noise", "signals", "pipeline", "estimator"),
)
HELD: Final = tuple(f"held_{kind}" for kind in ("motions", "periods", "residuals", "textbook"))
ENCODER_BOUND: Final = "bound_encoders"
"""Bound with the noise of encoders, of the first repeat."""

PARAMETER_COLUMNS: Final = (
    *("id", "body", "name", "base_error", "bound", ENCODER_BOUND, "class"),
    *HELD,
)
"""Columns of the parameters that are read here."""


WORST: Final = {f"coverage_worst_{one}": one for one in ("inertial", "friction")}
"""Class of parameters by metric of the worst coverage."""


def repeat_statistic(
    metric: str, cells: "pd.DataFrame", parameters: "pd.DataFrame"
) -> Figure | None:
    """A figure of all repeats of some cells; of several settings together where there are several.

    None where fewer than ENOUGH_REPEATS gave numbers, where all of them gave the same, or, for what
    is measured by the bound, where a parameter has none.
    """
    if metric in WORST:
        return _worst_coverage(WORST[metric], cells, parameters)
    of_encoders = metric == "bound_ratio_encoders"
    errors, bound = repeat_errors(cells, parameters, ENCODER_BOUND if of_encoders else "bound")
    if not _has_scatter(errors):
        return None
    if metric == "bias":
        return mean_error(errors)
    return WITH_BOUND[metric](errors, bound) if np.isfinite(bound).all() else None


def _worst_coverage(one: str, cells: "pd.DataFrame", parameters: "pd.DataFrame") -> Figure | None:
    """Share of repeats whose intervals hold the value, of the parameter of a class where it is
    smallest, and its 95 % interval (Clopper and Pearson 1934); None where a group of cells has
    several kinds of intervals, or fewer than ENOUGH_REPEATS."""
    kinds: list[str] = cells[STD_FROM].unique().tolist() if STD_FROM in cells.columns else []
    if len(kinds) != 1 or f"held_{kinds[0]}" not in parameters.columns:
        return None
    column = f"held_{kinds[0]}"
    lines = parameters[(parameters["class"] == one) & parameters[column].notna()]
    settings = _settings(cells)
    lines = lines.merge(cells[["id", *settings]], on="id")
    groups = lines.groupby([*settings, "body", "name"])[column]
    hits, counts = groups.sum().to_numpy(dtype=int), groups.count().to_numpy(dtype=int)
    if len(counts) == 0 or counts.min() < ENOUGH_REPEATS:
        return None
    worst = int(np.argmin(hits / counts))
    hit, count = int(hits[worst]), int(counts[worst])
    return (hit / count, *share_interval(hit, count))


def _settings(cells: "pd.DataFrame") -> list[str]:
    return [name for name in SETTING if name in cells.columns]


def _has_scatter(errors: Array) -> bool:
    """True where there are enough repeats, and the noise of each moved every parameter."""
    return len(errors) >= ENOUGH_REPEATS and errors.size > 0 and bool(np.ptp(errors, axis=0).all())


def repeat_errors(
    cells: "pd.DataFrame", parameters: "pd.DataFrame", which: str = "bound"
) -> tuple[Array, Array]:
    """Errors (n, r) of each base parameter of each setting (r) in the repeats (n) that all of them
    have, and the bound (r,), NaN where there is none: the root mean square of those of single
    repeats, which differ where noise disturbs the motion."""
    settings = _settings(cells)
    lines = parameters[parameters["id"].isin(cells["id"]) & parameters["base_error"].notna()]
    lines = lines.merge(cells[["id", "repeat", *settings]], on="id")
    if len(lines) == 0:
        return np.zeros((0, 0)), np.zeros(0)
    given = lines[which].astype(float) if which in lines else np.nan
    lines = lines.assign(square=given**2)
    where = [*settings, "body", "name"]
    # A repeat that failed in one setting is left out of all, so that the rows are complete.
    errors = lines.pivot(index="repeat", columns=where, values="base_error").dropna()
    squares = lines.pivot(index="repeat", columns=where, values="square")
    # The bound with encoders is that of the first repeat alone.
    first_alone = which == ENCODER_BOUND
    known = squares[errors.columns] if first_alone else squares[errors.columns].loc[errors.index]
    bound = np.sqrt(known.mean(axis=0, skipna=first_alone))
    return errors.to_numpy(dtype=float), bound.to_numpy(dtype=float)
