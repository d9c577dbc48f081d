"""Rankings of methods by the ratio of their errors to those of a reference named beforehand.

Ratio, interval, failures and raw p of a method do not depend on which other methods are entered;
ranks, classes of equal answers and Holm's correction over the declared family do.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.evaluation.robot_statistic import (
    holm,
    rank_interval,
    ratio_profile,
    win_rates,
)
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.method_ratio import MethodRatio, find_copied, method_ratio
from sysid_bench.reporting.ranking_cases import RankingCases, ranking_cases
from sysid_bench.reporting.selection import Choose, label, select_rows
from sysid_bench.reporting.tables import Key
from sysid_bench.types import Array, Metric
from sysid_bench.units import quantity
from sysid_bench.words import MARGIN, REFERENCE

if TYPE_CHECKING:
    import pandas as pd

RATIOS: Final = np.geomspace(0.1, 100.0, 301)
"""Times the reference, at which profiles are drawn."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """Methods, the best first. `same` maps a method to the earlier one that gave the same answers;
    `family` are the methods whose comparisons are corrected together."""

    name: str
    title: str
    metric: Metric
    against: str
    margin: float
    is_replaced: bool  # unconverged answers count as those of the reference
    comparisons: tuple[MethodRatio, ...]
    family: tuple[str, ...]
    same: Mapping[str, str]
    cases: RankingCases = field(repr=False)

    @property
    def method_names(self) -> tuple[str, ...]:
        """Names of the methods, the best first."""
        return tuple(one.method for one in self.comparisons)

    @property
    def profile(self) -> Array:
        """Share (ratios, methods) of a method's cases with an error within RATIOS of the
        reference's."""
        columns = [ratio_profile(one.ratios, RATIOS) for one in self.comparisons]
        return np.asarray(np.nan_to_num(np.column_stack(columns)))

    @cached_property
    def rank_interval(self) -> Mapping[str, tuple[float, float, float]]:
        """Rank of each method that is not a copy, and the interval of it, NaN for few robots."""
        own = [one for one in self.comparisons if one.method not in self.same and one.robots]
        if not own:
            return {}
        figures = rank_interval(np.column_stack([one.logs for one in own]))
        rows = map(tuple, np.column_stack(figures).tolist())
        return dict(zip((one.method for one in own), rows, strict=True))

    @cached_property
    def holm_p(self) -> Mapping[str, float]:
        """p of the comparisons of the family after Holm's correction; equal answers count once."""
        tested = _one_each(self.family, {**self.same, self.against: self.against}, self.against)
        raw = {one.method: one.p for one in self.comparisons}
        return dict(zip(tested, holm(np.array([raw[m] for m in tested])).tolist(), strict=True))

    @cached_property
    def win_rates(self) -> Array:
        """Share (methods, methods) of the common cases in which the row beats the column."""
        errors = np.where(
            self.cases.has_row & np.isnan(self.cases.errors), np.inf, self.cases.errors
        )
        errors = np.where(errors <= self.cases.floor, 0.0, errors)
        order = [self.cases.methods.index(method) for method in self.method_names]
        return win_rates(errors[self.cases.with_ratio][:, order])


def _one_each(methods: Sequence[str], same: Mapping[str, str], without: str) -> list[str]:
    """The first method of each class of equal answers, without the class of one of them."""
    seen, kept = {without}, []
    for method in methods:
        first = same.get(method, method)
        if first not in seen:
            seen.add(first)
            kept.append(method)
    return kept


def rank_cells(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Iterator[Ranking]:
    """Rankings of a [[ranking]] entry of a suite: one for each value of the labels `apart`.

    `metrics` are the records by name. Raises UsageError for fewer than two methods, and for a
    reference or member of the family that is not among them.
    """
    apart = list(spec.get("apart", ()))
    for name in apart:
        if name not in cells.columns:
            raise unknown_name("field of the cells", name, map(str, cells.columns))
    metric = metric_of(str(spec["metric"]), metrics)
    for values, group in _groups(select_rows(cells, spec, choose), apart):
        yield _ranking(ranking_cases(group, metric), spec, values, metric)


def entry_with_cells(spec: Mapping[str, Any], cells: "pd.DataFrame") -> dict[str, Any]:
    """A [[ranking]] entry with the members of its family that have cells: of a part of a run."""
    methods = set(cells["estimator"].map(label))
    return {**spec, "family": [name for name in spec.get("family") or () if name in methods]}


def _groups(cells: "pd.DataFrame", apart: list[str]) -> Iterator[tuple[Key, "pd.DataFrame"]]:
    """Cells by their labels of some fields; all cells together where there is no field."""
    if not apart:
        yield (), cells
        return
    for key, group in cells.groupby(apart, sort=False):
        yield tuple(map(label, key if isinstance(key, tuple) else (key,))), group


def _check_methods(methods: Sequence[str], cases: RankingCases) -> None:
    """Raise UsageError for a method that has no case."""
    for method in methods:
        if method not in cases.methods:
            raise unknown_name("method of this ranking", method, cases.methods)


def _ranking(cases: RankingCases, spec: Mapping[str, Any], values: Key, metric: Metric) -> Ranking:
    title = str(spec.get("title") or f"Methods by {metric.title}")
    against, margin = str(spec.get("against", REFERENCE)), quantity(spec.get("margin", MARGIN), "%")
    family = tuple(spec.get("family", ())) or cases.methods
    _check_methods((against, *family), cases)
    is_replaced = spec.get("unconverged") == "replaced"
    # The reference stands first in its class: a copy of it is not compared with it.
    ordered = (against, *(method for method in cases.methods if method != against))
    found = [method_ratio(cases, method, against, margin, is_replaced) for method in ordered]
    return Ranking(
        name="-".join([str(spec["name"]), *values]),
        title=f"{title}: {', '.join(values)}" if values else title,
        metric=metric,
        against=against,
        margin=margin,
        is_replaced=is_replaced,
        comparisons=tuple(sorted(found, key=_order)),
        family=family,
        same=find_copied(cases, ordered),
        cases=cases,
    )


def _order(one: MethodRatio) -> tuple[float, str]:
    """Median of the deciding ratios, then the name; without any robot last."""
    known = one.logs[~np.isnan(one.logs)]
    return (float(np.median(known)) if len(known) else np.inf, one.method)
