"""Rows that a claim selects, paired and counted by robot."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import left_out_held
from sysid_bench.evaluation.robot_statistic import by_robot
from sysid_bench.reporting.selection import Choose, label, select_rows
from sysid_bench.types import Array
from sysid_bench.words import AT_BOUND, JOINT, LABELS, PARAMETER, STD_FROM, VERDICT

RUN: Final = "run"
"""Column of lines with the run that they are from: rows of two runs are never paired."""

LEFT_OUT_SHARE: Final = 0.9
"""Probability that a range between units holds a new one."""

_CASE: Final = (RUN, *LABELS, "repeat", JOINT, STD_FROM)
_ALONG: Final[Mapping[str, tuple[str, ...]]] = {
    "pipeline": ("signals",),
    "plant": ("noise", "simulation"),
}
"""Labels that follow from another one."""

_NO_ROW: Final = ("unsupported", "skipped")
"""Statuses of cells that a method does not apply to."""

Compared = tuple[frozenset[str], frozenset[str]]
"""Fields that the two selections of a claim name."""


class MissingRowsError(UsageError):
    """A claim without the rows that it needs; the message is the reason."""


@dataclass(frozen=True, eq=False)
class ClaimValues:
    """Values (n,) of a claim's cells by robot, NaN where a cell has none; of pairs, `own` and
    `against` (n,), and the `methods` (n,) that a rank is among. `lost` cells have no answer."""

    robots: Array
    own: Array
    against: Array
    methods: Array
    lost: int

    @property
    def cells(self) -> int:
        """Number of cells or pairs."""
        return len(self.own)


def select_lines(lines: pd.DataFrame, select: str, choose: Choose, what: str) -> pd.DataFrame:
    """The lines that a condition selects, without those that a method does not apply to; raises
    MissingRowsError where there are none."""
    try:
        found = select_rows(lines, {"select": select}, choose)
    except UsageError as error:
        raise MissingRowsError(f"no rows of {what}: {select}") from error
    kept = found[~found["status"].isin(_NO_ROW)]
    if len(kept) == 0:
        raise MissingRowsError(_reason(found, what))
    return kept


def _reason(found: pd.DataFrame, what: str) -> str:
    """Statuses of rows that do not count, and the most frequent reason."""
    statuses = Counter(found["status"])
    counts = ", ".join(f"{count} {status}" for status, count in statuses.items())
    reasons = Counter(label(reason) for reason in found["reason"].dropna())
    why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
    return f"no rows of {what} ({counts}{why})"


def numbers(lines: pd.DataFrame, metric: str) -> Array:
    """Values (n,) of a metric, NaN where a line is not ok or has none; raises MissingRowsError
    where no line has one."""
    given = lines[metric] if metric in lines else pd.Series(np.nan, lines.index)
    values = pd.to_numeric(given.where(lines["status"] == "ok"), errors="coerce").to_numpy(float)
    if np.isnan(values).all():
        raise MissingRowsError(f"no row has the metric {metric}")
    return np.where(np.isfinite(values), values, np.nan)


def units(lines: pd.DataFrame, over: str) -> Array:
    """Label (n,) of what a claim counts; each line counts for itself over "cell"."""
    if over == "cell":
        return np.arange(len(lines))
    if over not in lines:
        raise MissingRowsError(f"no row has the label {over}")
    return lines[over].map(label).to_numpy(str)


def selection_values(lines: pd.DataFrame, metric: str, over: str) -> ClaimValues:
    """Values of one selection."""
    own = numbers(lines, metric)
    nothing = np.full(len(own), np.nan)
    lost = int(np.isnan(own).sum())
    return ClaimValues(units(lines, over), own, nothing, _methods(lines), lost)


def left_out_values(lines: pd.DataFrame, over: str) -> ClaimValues:
    """For each unit and parameter 1 or 0: its value lies in the 90 % range of the other units, or
    not. Parameters that are on a bound, or have no value, in one of them are left out."""
    of = lines.assign(unit=units(lines, over))
    table = of.pivot_table(index="unit", columns=PARAMETER, values="estimate", aggfunc="mean")
    bound = set(of.loc[of[VERDICT] == AT_BOUND, PARAMETER])
    free = table.drop(columns=[name for name in table if name in bound]).dropna(axis=1)
    if free.shape[1] == 0 or len(free) < 3:
        raise MissingRowsError("fewer than three units, or no value that is off its bound in all")
    held = left_out_held(free.to_numpy(float), LEFT_OUT_SHARE).ravel()
    robots = np.repeat(free.index.to_numpy(str), free.shape[1])
    nothing = np.full(len(held), np.nan)
    return ClaimValues(robots, held, nothing, np.full(len(held), ""), 0)


def compare_values(
    own: pd.DataFrame, against: pd.DataFrame, metric: str, over: str, named: Compared
) -> ClaimValues:
    """Values of two selections, by case: all labels but those that they compare. A value of several
    lines of one case is their mean; a case without a reference is left out."""
    case = _case_fields(own, against, named)
    first = _by_case(own, metric, over, case)
    others = _by_case(against, metric, over, [*case, "method"])
    pairs = pd.merge(first, others, on=case, suffixes=("", "_against"))
    pairs = pairs[pairs["value_against"].notna()]
    if len(pairs) == 0:
        raise MissingRowsError("no case has rows of both selections")
    values = pairs["value"].to_numpy(float)
    return ClaimValues(
        robots=np.arange(len(pairs)) if over == "cell" else pairs["unit"].to_numpy(str),
        own=values,
        against=pairs["value_against"].to_numpy(float),
        methods=pairs["method"].to_numpy(str),
        lost=int(pairs[pairs["value"].isna()].groupby(case).ngroups),
    )


def _by_case(lines: pd.DataFrame, metric: str, over: str, keys: list[str]) -> pd.DataFrame:
    """Mean `value` and the `unit` of the lines that share the keys."""
    labels = [name for name in keys if name != "method"]
    table = (
        lines[labels]
        .map(label)
        .assign(
            value=numbers(lines, metric),
            unit="" if over == "cell" else units(lines, over),
            method=_methods(lines),
        )
    )
    groups = table.groupby(keys, sort=False, dropna=False)
    return groups.agg(value=("value", "mean"), unit=("unit", "first")).reset_index()


def _methods(lines: pd.DataFrame) -> Array:
    return lines["estimator"].map(label).to_numpy(str)


def _case_fields(own: pd.DataFrame, against: pd.DataFrame, named: Compared) -> list[str]:
    """Labels that a pair shares: all but those that both selections name and have no value of in
    common, and those that follow from these."""
    there = [name for name in _CASE if name in own and name in against]
    of_own, of_others = ({name.partition(".")[0] for name in names} for names in named)
    both = [name for name in there if name in of_own & of_others]
    compared = {name for name in both if not _shared(own[name], against[name])}
    compared.update(*(_ALONG.get(name, ()) for name in compared))
    return [name for name in there if name not in compared]


def _shared(one: pd.Series, other: pd.Series) -> bool:
    return not set(map(label, one)).isdisjoint(map(label, other))


def mean_by_robot(values: ClaimValues, numbers: Array) -> Array:
    """Mean (robots,) of numbers (n,) of the cells; raises MissingRowsError where there is none."""
    means = by_robot(values.robots, numbers)
    if len(means) == 0:
        raise MissingRowsError("no case has a value")
    return means


def record_of(lines: pd.DataFrame) -> list[dict[str, Any]]:
    """Lines as mappings, for a condition."""
    return [{str(key): value for key, value in row.items()} for row in lines.to_dict("records")]
