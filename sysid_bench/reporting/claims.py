"""Verdicts on the claims of a suite, from stored rows.

A claim selects rows, pairs them with those of a reference by case where it compares, and counts
robots (or what `over` says). Its figure and interval decide (evaluation/robot_statistic.py).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pandas as pd

from sysid_bench.errors import UsageError, count_text
from sysid_bench.evaluation.intervals import left_out_held, tails
from sysid_bench.evaluation.robot_statistic import (
    MOST_LOST,
    ClaimFigure,
    ClaimInterval,
    Verdict,
    benjamini_hochberg,
    by_robot,
    claim_p,
    claim_verdict,
    mean_figure,
    median_figure,
    rank_figure,
    ratio_figure,
    share_figure,
    units_needed,
)
from sysid_bench.metrics import metric_of
from sysid_bench.reporting.selection import Choose, label, select_rows
from sysid_bench.types import Array, Metric
from sysid_bench.words import (
    AT_BOUND,
    JOINT,
    LABELS,
    LEFT_OUT,
    PAIRED,
    PARAMETER,
    STD_FROM,
    VERDICT,
)

RUN: Final = "run"
"""Column of lines with the run that they are from: rows of two runs are never paired."""
CONTENT: Final = "robot_content"
"""Column of lines of several runs with the hash of their robot's model: what counts as a robot."""

LEFT_OUT_SHARE: Final = 0.9
"""Probability that a range between units holds a new one."""

BOOTSTRAPPED: Final = ("rank", "coverage", LEFT_OUT)
"""Statistics whose interval is of robots drawn again: its ends far out in the tails, from few
robots and draws, are not a p-value, and none is corrected."""

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


def _selected_lines(lines: pd.DataFrame, select: str, choose: Choose, what: str) -> pd.DataFrame:
    """The lines that a condition selects, without those that a method does not apply to; raises
    MissingRowsError where there are none."""
    try:
        found = select_rows(lines, {"select": select}, choose)
    except UsageError as error:
        raise MissingRowsError(f"no rows of {what}: {select}") from error
    kept = found[~found["status"].isin(_NO_ROW)]
    if len(kept) > 0:
        return kept
    counts = ", ".join(f"{count} {status}" for status, count in Counter(found["status"]).items())
    reasons = Counter(label(reason) for reason in found["reason"].dropna())
    why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
    raise MissingRowsError(f"no rows of {what} ({counts}{why})")


def _numbers(lines: pd.DataFrame, metric: str) -> Array:
    """Values (n,) of a metric, NaN where a line is not ok or has none; raises MissingRowsError
    where no line has one."""
    given = lines[metric] if metric in lines else pd.Series(np.nan, lines.index)
    values = pd.to_numeric(given.where(lines["status"] == "ok"), errors="coerce").to_numpy(float)
    if np.isnan(values).all():
        raise MissingRowsError(f"no row has the metric {metric}")
    # An infinite error cannot be averaged: it counts as an answer that is missing.
    return np.where(np.isfinite(values), values, np.nan)


def _units(lines: pd.DataFrame, over: str) -> Array:
    """Label (n,) of what a claim counts; each line counts for itself over "cell"."""
    if over == "cell":
        return np.arange(len(lines))
    if over not in lines:
        raise MissingRowsError(f"no row has the label {over}")
    if over == "robot" and CONTENT in lines:
        return lines[CONTENT].to_numpy(str)
    return lines[over].map(label).to_numpy(str)


def _selection_values(lines: pd.DataFrame, metric: str, over: str) -> ClaimValues:
    """Values of one selection."""
    own = _numbers(lines, metric)
    nothing, lost = np.full(len(own), np.nan), int(np.isnan(own).sum())
    return ClaimValues(_units(lines, over), own, nothing, _methods(lines), lost)


def _left_out_values(lines: pd.DataFrame, over: str) -> ClaimValues:
    """For each unit and parameter 1 or 0: its value lies in the 90 % range of the other units, or
    not. Parameters that are on a bound, or have no value, in one of them are left out."""
    of = lines.assign(unit=_units(lines, over))
    table = of.pivot_table(index="unit", columns=PARAMETER, values="estimate", aggfunc="mean")
    # A value on its bound is not an estimate, and the range of equal values would be a point.
    bound = set(of.loc[of[VERDICT] == AT_BOUND, PARAMETER])
    free = table.drop(columns=[name for name in table if name in bound]).dropna(axis=1)
    if free.shape[1] == 0 or len(free) < 3:
        raise MissingRowsError("fewer than three units, or no value that is off its bound in all")
    # Each unit against the range of all others: a range that its own value has widened would hold
    # it too often.
    held = left_out_held(free.to_numpy(float), LEFT_OUT_SHARE).ravel()
    robots = np.repeat(free.index.to_numpy(str), free.shape[1])
    nothing = np.full(len(held), np.nan)
    return ClaimValues(robots, held, nothing, np.full(len(held), ""), 0)


def _by_case(lines: pd.DataFrame, metric: str, over: str, keys: list[str]) -> pd.DataFrame:
    """Mean `value` and the `unit` of the lines that share the keys."""
    # Labels as text: mappings and lists of settings cannot be grouped by.
    labels = [name for name in keys if name != "method"]
    table = (
        lines[labels]
        .map(label)
        .assign(
            value=_numbers(lines, metric),
            unit="" if over == "cell" else _units(lines, over),
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
    named_by_both = _fields_of_both(named)
    both = [name for name in there if name in named_by_both]
    compared = {
        name for name in both if set(map(label, own[name])).isdisjoint(map(label, against[name]))
    }
    compared.update(*(_ALONG.get(name, ()) for name in compared))
    return [name for name in there if name not in compared]


def _fields_of_both(named: Compared) -> set[str]:
    """Fields that both selections name, without what stands behind a dot."""
    of_own, of_others = ({name.partition(".")[0] for name in names} for names in named)
    return of_own & of_others


def _mean_by_robot(values: ClaimValues, numbers: Array) -> Array:
    """Mean (robots,) of numbers (n,) of the cells; raises MissingRowsError where there is none."""
    means = by_robot(values.robots, numbers)
    if len(means) == 0:
        raise MissingRowsError("no case has a value")
    return means


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
    exact: bool
    sentence: str | None
    protocol: str | None
    needed: int | None  # units with which it can hold; None: no number
    p: float | None = None  # None: exact, without an interval, or with one of the bootstrap
    p_corrected: float | None = None  # over all verdicts that are printed together


def correct_findings(findings: Sequence[ClaimFinding]) -> list[ClaimFinding]:
    """The findings with p-values corrected over all that have one, by the rate of false
    discoveries; those that the correction leaves undecided are open."""
    tested = [one.p for one in findings if one.p is not None]
    corrected, at_most = iter(benjamini_hochberg(np.array(tested)).tolist()), 2.0 * tails()[0]
    found = []
    for one in findings:
        p = None if one.p is None else next(corrected)
        if p is not None and p > at_most and one.verdict in ("holds", "fails"):
            reason = f"p {one.p:.2g}, {p:.2g} over {len(tested)} verdicts"
            one = replace(one, verdict="open", reason=reason)
        found.append(replace(one, p_corrected=p))
    return found


@dataclass(frozen=True, eq=False)
class ClaimRows:
    """Stored rows that claims of a `suite` are tested on, and how conditions on them are read."""

    suite: str
    lines: LinesOf
    choose: Choose
    fields: FieldsOf
    metrics: Mapping[str, Metric]


def claim_findings(claim: Mapping[str, Any], rows: ClaimRows) -> Iterator[ClaimFinding]:
    """The verdict on a claim, for each of its levels where it names some; `correct_findings`
    corrects those that are printed together."""
    if claim.get("withdrawn"):
        yield _without_figure(claim, rows, "-", "withdrawn", claim["withdrawn"])
        return
    for level in claim["level"] or (None,):
        try:
            yield _finding(claim, level, rows)
        except MissingRowsError as error:
            yield _without_figure(claim, rows, level or "-", "not testable", str(error))


def _without_figure(
    claim: Mapping[str, Any], rows: ClaimRows, level: str, verdict: Verdict, reason: str
) -> ClaimFinding:
    return ClaimFinding(
        **_said(claim, rows), level=level, verdict=verdict, reason=reason,
        value=None, low=None, high=None, count=0, cells=0, lost=0,
    )  # fmt: skip


def _said(claim: Mapping[str, Any], rows: ClaimRows) -> dict[str, Any]:
    """Statement of the suite on a claim."""
    kept = {key: claim[key] for key in ("name", "statement", "source", "over", "gate")}
    kept["exact"] = is_exact = bool(claim.get("exact"))
    kept |= {key: claim.get(key) for key in ("sentence", "protocol")}
    is_tested = bool(claim["threshold"]) and not is_exact
    threshold = ClaimInterval.of(claim["direction"], claim["threshold"]) if is_tested else None
    needed = None if threshold is None else units_needed(claim["statistic"], threshold)
    limits = [f"{limit:g}" for limit in claim["threshold"]]
    of = claim.get("metric") or claim.get("meets") or "values"
    return kept | {
        "suite": rows.suite,
        "needed": 1 if is_exact else needed,
        "statistic": "-" if claim.get("missing") else f"{claim['statistic']} of {of}",
        "wanted": f"{claim['direction']} {' to '.join(limits)}" if limits else "-",
    }


def _finding(claim: Mapping[str, Any], level: str | None, rows: ClaimRows) -> ClaimFinding:
    if claim.get("missing"):
        raise MissingRowsError(f"needs {claim['missing']}")
    lines = rows.lines(_kind(claim, rows))
    if level is not None:
        # Realism levels are claims of their own: what holds without friction may fail with it.
        lines = lines[lines["plant"].map(label) == level]
    if len(lines) == 0:
        raise MissingRowsError(f"no rows at {level}" if level else "no rows")
    of = _selected_lines(lines, claim["select"], rows.choose, "the claim")
    values = _values(claim, of, lines, rows)
    threshold = ClaimInterval.of(claim["direction"], claim["threshold"])

    def figure_of() -> ClaimFigure:
        found = _figure(claim, values, rows)
        # No interval over cells: a single robot may have any number of them.
        one_robot = "cells do not replicate each other: one robot may have all of them"
        return found.without_interval(one_robot) if claim["over"] == "cell" else found

    is_exact = bool(claim.get("exact"))
    if is_exact:
        figure, p = _exact_figure(values), None
        verdict: Verdict = "holds" if figure.value == 1.0 else "fails"
        missed = int((values.own < 1.0).sum())
        reason = (
            f"{missed} of {count_text(len(values.own), 'cell')} do not meet it" if missed else ""
        )
    else:
        figure = figure_of()
        verdict = claim_verdict(figure, threshold)
        reason = _open_reason(figure, verdict, values, claim["over"])
        is_tested = figure.low is not None and claim["statistic"] not in BOOTSTRAPPED
        p = claim_p(figure_of, threshold) if is_tested else None
    # Of a claim without a level its plants; recordings have none.
    plants = [name for name in dict.fromkeys(map(label, of["plant"])) if name != "none"]
    return ClaimFinding(
        **_said(claim, rows), level=level or ", ".join(plants) or "recorded",
        verdict="open" if reason and not is_exact else verdict,
        reason=reason, value=figure.value, low=figure.low, high=figure.high, count=figure.count,
        cells=values.cells, lost=values.lost, p=p,
    )  # fmt: skip


def _exact_figure(values: ClaimValues) -> ClaimFigure:
    """Share of all cells that meet an exact statement: each cell is a proof or a counterexample."""
    return ClaimFigure(float(values.own.mean()), None, None, len(np.unique(values.robots)))


def _open_reason(figure: ClaimFigure, verdict: Verdict, values: ClaimValues, over: str) -> str:
    """Reason for which a claim stays open although its figure may be on one side; else empty."""
    if figure.low is None:
        counted = count_text(figure.count, over)
        return f"{counted}: no interval{figure.reason and f' ({figure.reason})'}"
    # A claim on the cells that answered says nothing of those that did not.
    if verdict == "holds" and values.lost > MOST_LOST * values.cells:
        return f"{values.lost} of {values.cells} cells have no answer"
    return "the interval straddles the threshold" if verdict == "open" else ""


def _kind(claim: Mapping[str, Any], rows: ClaimRows) -> str:
    """Kind of the lines that a claim looks at: "joint" where one of its fields is of joints."""
    fields = frozenset[str]()
    for key in ("select", "against", "meets"):
        fields |= rows.fields(claim[key]) if claim.get(key) else frozenset()
    levels = {metric_of(name, rows.metrics).level for name in fields}
    if "joint" in fields | levels or claim["over"] == "joint":
        return "joint"
    kind: str = metric_of(claim.get("metric") or "", rows.metrics).level
    return LEFT_OUT if claim["statistic"] == LEFT_OUT else kind


def _values(
    claim: Mapping[str, Any], of: "pd.DataFrame", lines: "pd.DataFrame", rows: ClaimRows
) -> ClaimValues:
    if claim["statistic"] == "share":
        records = ({str(key): one for key, one in row.items()} for row in of.to_dict("records"))
        met = [rows.choose(claim["meets"], row) for row in records]
        # A failed cell counts as one that does not meet the condition, not as one that is missing.
        shares = of.assign(status="ok", met=np.asarray(met, dtype=float))
        return _selection_values(shares, "met", claim["over"])
    if claim["statistic"] == LEFT_OUT:
        return _left_out_values(of, claim["over"])
    if claim["statistic"] not in PAIRED:
        return _selection_values(of, claim["metric"], claim["over"])
    against = _selected_lines(lines, claim["against"], rows.choose, "the reference")
    named = (rows.fields(claim["select"]), rows.fields(claim["against"]))
    # A case is all labels but those that the claim compares. Lines of one case are averaged, and a
    # case without a reference says nothing of the ratio: it is left out, not counted as lost.
    metric, over = claim["metric"], claim["over"]
    case = _case_fields(of, against, named)
    first = _by_case(of, metric, over, case)
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


def _logs(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> Array:
    """ln(own / against) (n,): zero where the method has no answer, since the reference is what is
    left then; NaN where one of the two is rounding."""
    floor = max(metric_of(claim["metric"], rows.metrics).floor, float(np.finfo(float).tiny))
    own = np.where(np.isnan(values.own), values.against, values.own)
    # Below the floor both are rounding, and their ratio is chance.
    known = (own > floor) & (values.against > floor)
    ratios = np.divide(own, values.against, out=np.full(len(own), np.nan), where=known)
    return np.asarray(np.log(ratios))


def _figure(claim: Mapping[str, Any], values: ClaimValues, rows: ClaimRows) -> ClaimFigure:
    """The statistic of a claim over robots, and its interval."""
    statistic = claim["statistic"]
    if statistic == "rank":
        # Among the methods of the reference, on the robots where all of them answer: else a method
        # that fails on hard robots would be ranked on easy ones.
        logs = _logs(claim, values, rows)
        methods, robots = np.unique(values.methods), np.unique(values.robots)
        table = np.full((len(robots), len(methods)), np.nan)
        for column, method in enumerate(methods):
            known = (values.methods == method) & ~np.isnan(logs)
            named = np.unique(values.robots[known])
            # ln(own / other) with its sign changed is the log error of the other; that of the own
            # is zero.
            table[np.isin(robots, named), column] = -_mean_by_robot(
                values, np.where(known, logs, np.nan)
            )
        complete = table[~np.isnan(table).any(axis=1)]
        if len(complete) == 0:
            raise MissingRowsError("no robot has an answer of every method")
        return rank_figure(np.column_stack([np.zeros(len(complete)), complete]))
    if statistic == "ratio":
        return ratio_figure(_mean_by_robot(values, _logs(claim, values, rows)))
    if statistic == "difference":
        # A method without an answer leaves that of the reference.
        own = np.where(np.isnan(values.own), values.against, values.own)
        return median_figure(_mean_by_robot(values, own - values.against))
    figure_of = {
        "median": median_figure,
        "coverage": mean_figure,
        LEFT_OUT: mean_figure,
        "share": share_figure,
    }
    return figure_of[statistic](_mean_by_robot(values, values.own))
