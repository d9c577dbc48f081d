"""Claims of a suite with their verdicts, from the lines of runs."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import count_text
from sysid_bench.evaluation.robot_statistic import (
    MOST_LOST,
    ClaimFigure,
    ClaimInterval,
    Verdict,
    claim_verdict,
    mean_figure,
    median_figure,
    rank_figure,
    ratio_figure,
    share_figure,
)
from sysid_bench.metrics import metric_of
from sysid_bench.reporting import claim_lines
from sysid_bench.reporting.claim_lines import ClaimValues, MissingRowsError
from sysid_bench.reporting.selection import Choose, label
from sysid_bench.types import Array, Metric
from sysid_bench.words import LEFT_OUT, PAIRED

if TYPE_CHECKING:
    import pandas as pd

LinesOf = Callable[[str], "pd.DataFrame"]
"""Level of a metric ("cell", "joint", "interval") -> the lines of all runs at that level."""

FieldsOf = Callable[[str], frozenset[str]]
"""Condition -> the fields that it names."""


@dataclass(frozen=True)
class ClaimFinding:
    """Verdict on one claim at one level, and what it rests on: `count` robots (or what `over` says)
    and `cells`, of which `lost` have no answer; `wanted` is the threshold in words."""

    suite: str
    name: str
    statement: str
    source: str
    level: str
    statistic: str
    wanted: str
    verdict: Verdict
    reason: str
    value: float | None
    low: float | None
    high: float | None
    over: str
    count: int
    cells: int
    lost: int
    gate: bool


@dataclass(frozen=True, eq=False)
class ClaimRows:
    """Stored rows that claims of a `suite` are tested on, and how conditions on them are read."""

    suite: str
    lines: LinesOf
    choose: Choose
    fields: FieldsOf
    metrics: Mapping[str, Metric]


def claim_findings(claim: Mapping[str, Any], rows: ClaimRows) -> Iterator[ClaimFinding]:
    """The verdict on a claim, for each of its levels where it names some."""
    for level in claim["level"] or (None,):
        try:
            yield _finding(claim, level, rows)
        except MissingRowsError as error:
            yield ClaimFinding(
                **_said(claim, rows), level=level or "-", verdict="not testable",
                reason=str(error), value=None, low=None, high=None, count=0, cells=0, lost=0,
            )  # fmt: skip


def _said(claim: Mapping[str, Any], rows: ClaimRows) -> dict[str, Any]:
    """What the suite says of a claim."""
    kept = {key: claim[key] for key in ("name", "statement", "source", "over", "gate")}
    texts = {"suite": rows.suite, "statistic": _statistic_text(claim), "wanted": _wanted(claim)}
    return kept | texts


def _statistic_text(claim: Mapping[str, Any]) -> str:
    if claim.get("missing"):
        return "-"
    of = claim.get("metric") or claim.get("meets") or "values"
    return f"{claim['statistic']} of {of}"


def _wanted(claim: Mapping[str, Any]) -> str:
    limits = [f"{limit:g}" for limit in claim["threshold"]]
    return f"{claim['direction']} {' to '.join(limits)}" if limits else "-"


def _finding(claim: Mapping[str, Any], level: str | None, rows: ClaimRows) -> ClaimFinding:
    if claim.get("missing"):
        raise MissingRowsError(f"needs {claim['missing']}")
    of, lines = _selection(claim, level, rows)
    values = _values(claim, of, lines, rows)
    figure = _figure(claim, values, rows)
    verdict = claim_verdict(figure, ClaimInterval.of(claim["direction"], claim["threshold"]))
    reason = _reason(claim, verdict, figure, values)
    return ClaimFinding(
        **_said(claim, rows), level=level or _plants(of), verdict="open" if reason else verdict,
        reason=reason, value=figure.value, low=figure.low, high=figure.high, count=figure.count,
        cells=values.cells, lost=values.lost,
    )  # fmt: skip


def _figure(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    """The figure of a claim; without an interval over cells, of which a single robot may have any
    number."""
    found = _STATISTICS[claim["statistic"]](claim, values, rows)
    one_robot = "cells do not replicate each other: one robot may have all of them"
    return found.without_interval(one_robot) if claim["over"] == "cell" else found


def _selection(
    claim: Mapping[str, Any], level: str | None, rows: ClaimRows
) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """The lines of `select`, and all lines at the level."""
    lines = rows.lines(_kind(claim, rows))
    if level is not None:
        lines = lines[lines["plant"].map(label) == level]
    if len(lines) == 0:
        raise MissingRowsError(f"no rows at {level}" if level else "no rows")
    return claim_lines.select_lines(lines, claim["select"], rows.choose, "the claim"), lines


def _kind(claim: Mapping[str, Any], rows: ClaimRows) -> str:
    """Kind of the lines that a claim looks at."""
    kind: str = metric_of(claim.get("metric") or "", rows.metrics).level
    if "joint" in _fields(claim, rows):
        return "joint"
    return LEFT_OUT if claim["statistic"] == LEFT_OUT else kind


def _fields(claim: Mapping[str, Any], rows: ClaimRows) -> frozenset[str]:
    """Fields that a claim names, with "joint" where it looks at single joints."""
    fields = frozenset[str]()
    for key in ("select", "against", "meets"):
        fields |= rows.fields(claim[key]) if claim.get(key) else frozenset()
    levels = {metric_of(name, rows.metrics).level for name in fields}
    return fields | {"joint"} if "joint" in levels or claim["over"] == "joint" else fields


def _values(
    claim: Mapping[str, Any], of: "pd.DataFrame", lines: "pd.DataFrame", rows: ClaimRows
) -> ClaimValues:
    if claim["statistic"] == "share":
        met = [rows.choose(claim["meets"], row) for row in claim_lines.record_of(of)]
        shares = of.assign(status="ok", met=np.asarray(met, dtype=float))
        return claim_lines.selection_values(shares, "met", claim["over"])
    if claim["statistic"] == LEFT_OUT:
        return claim_lines.left_out_values(of, claim["over"])
    if claim["statistic"] not in PAIRED:
        return claim_lines.selection_values(of, claim["metric"], claim["over"])
    against = claim_lines.select_lines(lines, claim["against"], rows.choose, "the reference")
    named = (rows.fields(claim["select"]), rows.fields(claim["against"]))
    return claim_lines.compare_values(of, against, claim["metric"], claim["over"], named)


def _plants(lines: "pd.DataFrame") -> str:
    """The plants of a claim without a level; recordings have none."""
    names = [name for name in dict.fromkeys(map(label, lines["plant"])) if name != "none"]
    return ", ".join(names) or "recorded"


def _reason(
    claim: Mapping[str, Any], verdict: Verdict, figure: ClaimFigure, values: ClaimValues
) -> str:
    """Why a claim stays open although its figure may be on one side; "" where it does not."""
    if figure.low is None:
        units = count_text(figure.count, claim["over"])
        return f"{units}: no interval{figure.reason and f' ({figure.reason})'}"
    if verdict == "holds" and values.lost > MOST_LOST * values.cells:
        return f"{values.lost} of {values.cells} cells have no answer"
    return "the interval straddles the threshold" if verdict == "open" else ""


def _logs(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> Array:
    """ln(own / against) (n,): zero where the method has no answer, since the reference is what is
    left then; NaN where one of the two is rounding."""
    floor = max(metric_of(claim["metric"], rows.metrics).floor, float(np.finfo(float).tiny))
    own = np.where(np.isnan(values.own), values.against, values.own)
    known = (own > floor) & (values.against > floor)
    ratios = np.divide(own, values.against, out=np.full(len(own), np.nan), where=known)
    return np.asarray(np.log(ratios))


def _ratio(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    logs = _logs(claim, values, rows)
    return ratio_figure(claim_lines.mean_by_robot(values, logs))


def _difference(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    own = np.where(np.isnan(values.own), values.against, values.own)
    return median_figure(claim_lines.mean_by_robot(values, own - values.against))


def _median(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    return median_figure(claim_lines.mean_by_robot(values, values.own))


def _mean(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    return mean_figure(claim_lines.mean_by_robot(values, values.own))


def _share(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    return share_figure(claim_lines.mean_by_robot(values, values.own))


def _rank(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    """Rank among the methods of the reference, over the robots on which all of them answer."""
    logs = _logs(claim, values, rows)
    methods, robots = np.unique(values.methods), np.unique(values.robots)
    table = np.full((len(robots), len(methods)), np.nan)
    for column, method in enumerate(methods):
        known = (values.methods == method) & ~np.isnan(logs)
        named = np.unique(values.robots[known])
        table[np.isin(robots, named), column] = -claim_lines.mean_by_robot(
            values, np.where(known, logs, np.nan)
        )
    complete = table[~np.isnan(table).any(axis=1)]
    if len(complete) == 0:
        raise MissingRowsError("no robot has an answer of every method")
    return rank_figure(np.column_stack([np.zeros(len(complete)), complete]))


_STATISTICS: Final = {
    "ratio": _ratio,
    "difference": _difference,
    "median": _median,
    "coverage": _mean,
    LEFT_OUT: _mean,
    "share": _share,
    "rank": _rank,
}
