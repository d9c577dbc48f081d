"""Rankings of methods over robots by the ratio of their errors to the best.

The errors of a case (see ranking_cases.py) are divided by the smallest of them, so that robots of
different size have the same weight. A cell that is not ok has no error; it counts as ten times the
worst of its case.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.evaluation.ranking_statistic import (
    failed_last,
    interquartile_mean,
    performance_profile,
    robot_interval,
    wilcoxon_holm,
    wilcoxon_holm_reference,
    win_rates,
)
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.ranking_cases import RankingCases, mean_by_robot, ranking_cases
from sysid_bench.reporting.selection import Choose, label, selected
from sysid_bench.reporting.tables import NO_ENTRY, Entry, Key, Table
from sysid_bench.types import Array, Metric

if TYPE_CHECKING:
    import pandas as pd

RATIOS: Final = np.geomspace(1.0, 100.0, 201)
"""Times the best, at which profiles are drawn."""

NEAR: Final = 1.1
"""Times the best that a table calls near it."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """Methods, the best first. `ratios` (cases, methods) are errors over the best of the case, NaN
    where there is none; `wins` and `p` (methods, methods) as of evaluation/ranking_statistic.py."""

    name: str
    title: str
    metric: Metric
    methods: tuple[str, ...]
    robots: int
    motions: int
    left_out: int  # cases in which not every method has a row
    ratios: Array
    mean: Array  # (methods,), interquartile mean of the ratios over robots and motions
    low: Array
    high: Array
    wins: Array
    p: Array
    p_against: Array
    against: str = ""  # the method that the order's p compare with; the first where empty

    @property
    def profile(self) -> Array:
        """Share (ratios, methods) of the cases within RATIOS of the best."""
        return performance_profile(self.ratios, RATIOS)

    @property
    def tables(self) -> tuple[Table, ...]:
        """The order, and how often which beats which, and whether that is chance."""
        wins = "Share of the cases in which the row beats the column; ties count half."
        p = (
            f"Wilcoxon's signed-rank test over {self.robots} robots, Holm's correction over all "
            "pairs: the chance of a difference as clear as this between equals."
        )
        return (
            self.summary_table,
            self._pairs("wins", "who beats whom", self.wins, wins),
            self._pairs("p", "p of each pair", self.p, p),
        )

    @property
    def summary_table(self) -> Table:
        """The methods from best to worst."""
        columns = self._summary_columns()
        entries: dict[tuple[Key, Key], Entry] = {
            ((method,), (column,)): cell
            for column, cells in columns.items()
            for method, cell in zip(self.methods, cells, strict=True)
        }
        caption = (
            f"{self.metric.title} over the smallest of the case: interquartile mean over "
            f"{self._drawn}, with its 95 % interval (drawn again); share of the cases within "
            f"{NEAR:g} of the best; share of won comparisons with the others; share of cases "
            "without an answer, which count as ten times the worst of their case; p of the "
            f"signed-rank test over robots against {self._reference}, Holm's correction "
            f"over {'these comparisons' if self.against else 'all pairs'}."
        )
        return self._table(self.name, self.title, ("figure",), tuple(columns), entries, caption)

    @property
    def _reference(self) -> str:
        return self.against or self.methods[0]

    def _summary_columns(self) -> dict[str, Sequence[Entry]]:
        # A method ties with itself, which does not count as a comparison.
        others = 1 - np.eye(len(self.methods))
        won = (self.wins * others).sum(axis=1) / max(len(self.methods) - 1, 1)
        reference = self.methods.index(self._reference)
        compared = list(map(_number, self.p_against if self.against else self.p[reference]))
        compared[reference] = NO_ENTRY
        return {
            "times the best": list(map(_number, self.mean, self.low, self.high)),
            f"within {NEAR:g}": list(map(_number, (self.ratios <= NEAR).mean(axis=0))),
            "wins": list(map(_number, won)),
            "failed": list(map(_number, np.isnan(self.ratios).mean(axis=0))),
            "p": compared,
        }

    def _pairs(self, name: str, title: str, values: Array, caption: str) -> Table:
        """Values (methods, methods) of every method against every other."""
        entries: dict[tuple[Key, Key], Entry] = {
            ((self.methods[i],), (self.methods[j],)): _number(values[i, j])
            for i, j in permutations(range(len(self.methods)), 2)
        }
        title = f"{self.title}: {title}"
        return self._table(
            f"{self.name}-{name}", title, ("against",), self.methods, entries, caption
        )

    def _table(
        self,
        name: str,
        title: str,
        fields: Key,
        columns: Sequence[str],
        entries: Mapping[tuple[Key, Key], Entry],
        caption: str,
    ) -> Table:
        return Table(
            name=name,
            title=title,
            metrics=(Metric(name.removeprefix(f"{self.name}-"), self.metric.title),),
            stat="mean",
            interval="ci95",
            row_fields=("estimator",),
            column_fields=fields,
            rows=tuple((method,) for method in self.methods),
            columns=tuple((column,) for column in columns),
            entries=entries,
            notes=self._notes(),
            own_caption=caption,
        )

    @property
    def _drawn(self) -> str:
        robots = f"{self.robots} robots"
        return robots if self.motions == 1 else f"{robots} and {self.motions} motions of each"

    def _notes(self) -> tuple[str, ...]:
        if not self.left_out:
            return ()
        return (
            f"{len(self.ratios)} cases; {self.left_out} more are left out, because not every "
            "method has a row there.",
        )


def rank_cells(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Iterator[Ranking]:
    """Rankings of a [[ranking]] entry of a suite: one for each value of the labels `apart`.

    `metrics` are the records by name. Raises UsageError where no case has rows of two methods.
    """
    apart = list(spec.get("apart", ()))
    for field in apart:
        if field not in cells.columns:
            raise unknown_name("field of the cells", field, map(str, cells.columns))
    metric = metric_of(str(spec["metric"]), metrics)
    for values, group in _groups(selected(cells, spec, choose), apart):
        yield _ranking(ranking_cases(group, metric), spec, values, metric)


def _groups(cells: "pd.DataFrame", apart: list[str]) -> Iterator[tuple[Key, "pd.DataFrame"]]:
    """Cells by their labels of some fields; all cells together where there is no field."""
    if not apart:
        yield (), cells
        return
    for key, group in cells.groupby(apart, sort=False):
        yield tuple(map(label, key if isinstance(key, tuple) else (key,))), group


def _ranking(cases: RankingCases, spec: Mapping[str, Any], values: Key, metric: Metric) -> Ranking:
    title = str(spec.get("title") or f"Methods by {metric.title}")
    # Ratios are averaged as logarithms: twice the best and half of it cancel.
    logs = mean_by_robot(np.log(failed_last(cases.scaled_errors)), cases)
    mean = interquartile_mean(np.exp(logs).reshape(-1, logs.shape[-1]))
    low, high = robot_interval(np.exp(logs))
    order = np.argsort(mean, kind="stable")
    pairs, by_robot = np.ix_(order, order), np.exp(logs.mean(axis=1))
    against = str(spec.get("against", ""))
    reference = _reference(against, cases.methods, order)
    return Ranking(
        name="-".join([str(spec["name"]), *values]),
        title=f"{title}: {', '.join(values)}" if values else title,
        metric=metric,
        methods=tuple(cases.methods[i] for i in order),
        robots=logs.shape[0],
        motions=logs.shape[1],
        left_out=cases.left_out,
        ratios=cases.scaled_errors[:, order],
        mean=mean[order],
        low=low[order],
        high=high[order],
        wins=win_rates(cases.errors)[pairs],
        p=wilcoxon_holm(by_robot)[pairs],
        p_against=wilcoxon_holm_reference(by_robot, reference)[order],
        against=against,
    )


def _reference(against: str, methods: Key, order: Array) -> int:
    """Index of the method that the others are tested against: the named one, else the best."""
    if not against:
        return int(order[0])
    if against not in methods:
        raise unknown_name("method of this ranking", against, methods)
    return methods.index(against)


def _number(value: float, *ends: float) -> Entry:
    low, high = map(float, ends) if ends else (None, None)
    return Entry(float(value), low, high, 1, {})
