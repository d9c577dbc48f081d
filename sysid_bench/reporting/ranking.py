"""Rankings of methods by the ratio of their errors to those of a reference named beforehand.

A case is everything but the method: robot, payload, motion, noise, ... and repeat. Per case
l = ln(error / error of the reference); per robot the mean over its cases, so that a robot with many
of them counts once; over robots exp(median). Ratio, interval, failures and raw p of a method depend
on the method and the reference alone; ranks, classes of equal answers and Holm's correction over
all verdicts of a suite, and so the verdicts, depend on which other methods are entered.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.evaluation.robot_statistic import (
    UNDECIDED,
    RatioFigure,
    equivalence_p,
    holm,
    least_p,
    mean_by_robot,
    rank_interval,
    rank_test_p,
    ratio_profile,
    verdict,
    win_rates,
)
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.baseline_rows import BASELINES, ERROR, with_baselines
from sysid_bench.reporting.selection import Choose, label, select_rows
from sysid_bench.reporting.tables import Key
from sysid_bench.types import Array, Metric
from sysid_bench.units import quantity
from sysid_bench.words import FRAME_DEPENDENT, LABELS, MARGIN, REFERENCE

if TYPE_CHECKING:
    import pandas as pd


_CASE: Final = (*(name for name in LABELS if name != "estimator"), "repeat")
_OK: Final = "ok"


@dataclass(frozen=True, eq=False)
class RankingCases:
    """Cells by case and method. `errors` (cases, methods) are NaN where a cell has no row or no
    error, `status` (cases, methods) is "" where it has no row; `converged` is True where a row does
    not say otherwise. Noise-free cases are a law that an answer keeps or breaks, and have no ratio;
    nor have those whose prior is the truth."""

    robots: tuple[str, ...]  # of each case, in order
    methods: tuple[str, ...]
    errors: Array
    status: Array
    converged: Array
    noise_free: Array  # (cases,)
    told: Array  # (cases,), the prior is the truth
    floor: float  # errors up to it are rounding
    reasons: Mapping[str, str]  # the most frequent one of each method that failed

    @cached_property
    def with_ratio(self) -> Array:
        """Cases (cases,) that a ratio may come from."""
        return np.asarray(~(self.noise_free | self.told))

    @property
    def has_row(self) -> Array:
        """Cells (cases, methods) that have a row, whatever its status."""
        return np.asarray(self.status != "")


def ranking_cases(cells: "pd.DataFrame", metric: Metric) -> RankingCases:
    """The cases of some cells. Raises UsageError where there are fewer than two methods."""
    names = [name for name in _CASE if name in cells.columns]
    lines = _answer_lines(cells, names, metric)
    methods = list(dict.fromkeys(lines["estimator"]))
    entered = [method for method in methods if method not in BASELINES]
    if len(entered) < 2:
        raise UsageError(
            f"A ranking by {metric.name} compares methods, and 'select' leaves "
            f"{', '.join(entered) or 'none'}."
        )
    # In the order of the labels: draws of robots do not depend on which rows came first.
    rows = lines.drop_duplicates([*names, "estimator"]).set_index([*names, "estimator"])
    table = {
        name: rows[name].unstack("estimator")[methods] for name in ("error", "status", "converged")
    }
    cases = table["error"].index.to_frame(index=False)
    # The most frequent reason of each method with a cell that is not ok.
    reasons = {}
    if "reason" in cells:
        lost = cells[(cells["status"] != _OK) & cells["reason"].notna()]
        groups = lost.groupby(lost["estimator"].map(label), sort=False)["reason"]
        reasons = {str(method): str(given.value_counts().index[0]) for method, given in groups}
    return RankingCases(
        robots=tuple(cases.get("robot", ["robot"] * len(cases))),
        methods=tuple(methods),
        errors=table["error"].to_numpy(dtype=float),
        status=table["status"].fillna("").to_numpy(dtype=str),
        # fillna would warn of a change of type: a missing row is not unconverged.
        converged=(table["converged"] != False).to_numpy(dtype=bool),  # noqa: E712
        noise_free=_noise_free(cases),
        told=_is(cases, "prior", "truth"),
        floor=max(metric.floor, float(np.finfo(float).tiny)),
        reasons=reasons,
    )


def _answer_lines(cells: "pd.DataFrame", names: list[str], metric: Metric) -> "pd.DataFrame":
    """Labels, method, error, status and convergence of each cell."""
    import pandas as pd

    values = cells[metric.name] if metric.name in cells else pd.Series(np.nan, cells.index)
    # Rows without the field have converged.
    converged = cells["converged"] if "converged" in cells else [None] * len(cells)
    numbers = (bool, np.bool_, int, float)
    return (
        cells[names]
        .map(label)
        .assign(
            estimator=cells["estimator"].map(label),
            error=pd.to_numeric(values.where(cells["status"] == _OK), errors="coerce"),
            status=cells["status"].map(label),
            converged=[not (isinstance(one, numbers) and one == 0) for one in converged],
        )
    )


def _is(cases: "pd.DataFrame", field: str, text: str) -> Array:
    """Cases (cases,) whose label is a text; none where the field is absent."""
    if field not in cases:
        return np.zeros(len(cases), dtype=bool)
    return np.asarray(cases[field] == text, dtype=bool)


def _noise_free(cases: "pd.DataFrame") -> Array:
    """Cases (cases,) with exact signals of a plant that the model can match: an error is then one
    of rounding, or a broken law."""
    parts = [_is(cases, "noise", "exact")]
    if "plant" in cases:
        parts.append(_is(cases, "plant", "matched"))
    if "signals" in cases:
        parts.append(np.array(["exact" in text.split(", ") for text in cases["signals"]]))
    return np.asarray(np.logical_and.reduce(parts))


MOST_FALLBACKS: Final = 0.1
"""Share of cases without an own answer above which a method is not called better or equivalent."""

BROKEN: Final = 1e-6
"""Error above which an answer from noise-free data breaks the law that they give the truth."""

ALIKE: Final = 1e-4
"""Relative difference of errors up to which two answers are the same."""

_DIGITS: Final = 9
"""Decimals of l: rounding makes equal ratios exact ties."""


@dataclass(frozen=True, eq=False)
class MethodRatio:
    """A method against the reference.

    `ratio` is over the cases that it answered; in `fallback` a case without an answer counts as the
    answer of the reference, in `replaced` also one that has not converged. `logs` (robots,) decide:
    those of `fallback` or `replaced`, NaN for a robot without a row. `ratios` (cases,) are single
    ones, NaN where there is none; `laws` counts the noise-free cases that keep the law, and all.
    """

    method: str
    ratio: RatioFigure
    fallback: RatioFigure
    replaced: RatioFigure
    robots: int
    cells: int
    statuses: Mapping[str, int]  # of cells without an answer, by status
    unconverged: int
    laws: tuple[int, int]
    p: float
    p_equivalent: float
    smallest_p: float
    fallbacks: int  # cases that count as the reference where it decides
    logs: Array
    ratios: Array
    reason: str = ""

    @property
    def failed(self) -> int:
        """Cells without an answer."""
        return sum(self.statuses.values())


def method_ratio(
    cases: RankingCases, method: str, against: str, margin: float, is_replaced: bool
) -> MethodRatio:
    """The method compared with `against`; `is_replaced`: the verdict takes unconverged answers as
    those of the reference."""
    m, r = cases.methods.index(method), cases.methods.index(against)
    # No ratio to a zero: an error that is rounding has none, as that of a failure.
    is_sound = cases.errors > cases.floor
    errors = np.where(is_sound, cases.errors, np.nan)
    logs = np.round(np.log(errors[:, m]) - np.log(errors[:, r]), _DIGITS)
    # The method has a row, be it a failure, and the reference an answer.
    failed = np.isnan(cases.errors[:, m])
    planned = cases.with_ratio & cases.has_row[:, m] & is_sound[:, r] & (is_sound[:, m] | failed)
    answered, converged = planned & np.isfinite(logs), cases.converged[:, m]
    # l = 0 is the answer of the reference: a failure neither wins nor loses by it. A penalty of ten
    # times the worst depends on who else is entered (measured: 20 to 4351 times the best).
    by_robot = {
        "ratio": _robot_means(cases, logs, answered),
        "fallback": _robot_means(cases, np.where(answered, logs, 0.0), planned),
        "replaced": _robot_means(cases, np.where(answered & converged, logs, 0.0), planned),
    }
    # Answers without convergence may be good or a stroke of luck; a suite says beforehand which
    # reading decides.
    deciding = by_robot["replaced" if is_replaced else "fallback"]
    own = answered & converged if is_replaced else answered
    known = deciding[~np.isnan(deciding)]
    given = cases.noise_free & cases.has_row[:, m]
    lost = cases.status[planned & ~answered, m].tolist()
    statuses = Counter("no value" if status == _OK else status for status in lost)
    return MethodRatio(
        method=method,
        **{name: RatioFigure.of(means[~np.isnan(means)]) for name, means in by_robot.items()},
        robots=len(known),
        cells=int(planned.sum()),
        statuses=dict(sorted(statuses.items())),
        unconverged=int((answered & ~converged).sum()),
        laws=(int((cases.errors[given, m] <= BROKEN).sum()), int(given.sum())),
        p=rank_test_p(known),
        p_equivalent=equivalence_p(known, margin),
        smallest_p=least_p(int(np.count_nonzero(known))),
        fallbacks=int((planned & ~own).sum()),
        logs=deciding,
        ratios=np.where(answered, np.exp(logs), np.nan)[planned],
        reason=cases.reasons.get(method, ""),
    )


def _robot_means(cases: RankingCases, logs: Array, which: Array) -> Array:
    """Mean (robots,) of the log ratios of some cases: cells of one robot share its dynamics and are
    no replicates."""
    names = tuple(dict.fromkeys(cases.robots))
    return mean_by_robot(cases.robots, np.where(which, logs, np.nan), names)


def find_copied(cases: RankingCases, methods: tuple[str, ...]) -> dict[str, str]:
    """The first of `methods` that gave the same answers, for each method that is not it: the same
    cases answered, with errors within ALIKE of each other in every one."""
    found: dict[str, str] = {}
    different: list[str] = []
    for method in methods:
        same = next((one for one in different if _is_same(cases, one, method)), None)
        # Copies of one answer would be tested again and again, and make Holm's correction harder
        # for all others.
        if same is None:
            different.append(method)
        else:
            found[method] = same
    return found


def _is_same(cases: RankingCases, one: str, other: str) -> bool:
    a, b = (cases.methods.index(name) for name in (one, other))
    # Copies fail alike: a method that fails elsewhere is another one.
    if (cases.status[:, a] != cases.status[:, b]).any():
        return False
    first, second = cases.errors[cases.with_ratio][:, [a, b]].T
    known = ~(np.isnan(first) & np.isnan(second))
    close = np.abs(first - second) <= ALIKE * np.maximum(first, cases.floor)
    return bool(known.any() and close[known].all())


RATIOS: Final = np.geomspace(0.1, 100.0, 301)
"""Times the reference, at which profiles are drawn."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """Methods, the best first. `same` maps a method to the earlier one that gave the same answers;
    `family` are the methods that have a verdict."""

    name: str
    title: str
    metric: Metric
    against: str
    margin: float
    is_replaced: bool  # unconverged answers count as those of the reference
    comparisons: tuple[MethodRatio, ...]
    baselines: tuple[MethodRatio, ...]  # null model and floors, which are no methods
    family: tuple[str, ...]
    same: Mapping[str, str]
    cases: RankingCases = field(repr=False)
    # p of a difference and of equivalence by method, corrected over `verdicts` of all rankings.
    corrected: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    verdicts: int = 0
    left_out: Mapping[str, str] = field(default_factory=dict)  # methods, and why

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
    def tested(self) -> tuple[str, ...]:
        """Methods of the family that have a verdict; equal answers count once."""
        # The first method of each class of equal answers, without the class of the reference.
        first = dict.fromkeys(self.same.get(name, name) for name in self.family)
        compared = {one.method for one in self.comparisons if one.robots}
        return tuple(name for name in first if name != self.against and name in compared)

    def verdict(self, one: MethodRatio) -> str:
        """Verdict on a method of the family or a copy of one, from its corrected p; "" for others.
        One that often has no own answer may only be worse or undecided, since the answers are those
        of the reference."""
        corrected = self.corrected.get(self.same.get(one.method, one.method))
        if corrected is None:
            return ""
        found = verdict(one.logs[~np.isnan(one.logs)], self.margin, *corrected)
        often = one.fallbacks > MOST_FALLBACKS * one.cells
        return UNDECIDED if often and found != "worse" else found

    @cached_property
    def win_rates(self) -> Array:
        """Share (methods, methods) of the common cases in which the row beats the column."""
        errors = np.where(
            self.cases.has_row & np.isnan(self.cases.errors), np.inf, self.cases.errors
        )
        # Below the floor errors are rounding: ties, and no wins.
        errors = np.where(errors <= self.cases.floor, 0.0, errors)
        order = [self.cases.methods.index(method) for method in self.method_names]
        return win_rates(errors[self.cases.with_ratio][:, order])


def rank_cells(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Iterator[Ranking]:
    """Rankings of a [[ranking]] entry of a suite: one for each value of the labels `apart`, which
    have verdicts once they are corrected together with the others of the suite.

    `metrics` are the records by name. Raises UsageError for fewer than two methods, and for a
    reference or member of the family that is not among them.
    """
    apart = list(spec.get("apart", ()))
    for name in apart:
        if name not in cells.columns:
            raise unknown_name("field of the cells", name, map(str, cells.columns))
    metric = metric_of(str(spec["metric"]), metrics)
    kept = select_rows(cells, spec, choose)
    against, left_out = str(spec.get("against", REFERENCE)), {}
    if FRAME_DEPENDENT in kept:
        # Who wrote the model file would be ranked, and not the method.
        reasons = kept[kept[FRAME_DEPENDENT].notna()].drop_duplicates("estimator")
        left_out = dict(zip(reasons["estimator"].map(label), reasons[FRAME_DEPENDENT], strict=True))
        left_out.pop(against, None)
        kept = kept[~kept["estimator"].map(label).isin(left_out)]
        spec = _with_family(spec, lambda one: one not in left_out)
    if metric.name == ERROR:
        kept = with_baselines(kept)
    groups = kept.groupby(apart, sort=False) if apart else [((), kept)]
    for key, group in groups:
        values = tuple(map(label, key if isinstance(key, tuple) else (key,)))
        ranking = _ranking(ranking_cases(group, metric), spec, values, metric)
        yield replace(ranking, left_out=left_out)


def correct_together(rankings: Iterable[Ranking]) -> tuple[Ranking, ...]:
    """The rankings with the p-values of all their verdicts corrected together: whoever prints some
    of them prints those of a suite."""
    rankings = tuple(rankings)
    raw = [
        (one.p, one.p_equivalent)
        for ranking in rankings
        for name in ranking.tested
        for one in ranking.comparisons
        if one.method == name
    ]
    corrected = iter(holm(np.array(raw).reshape(-1, 2)).tolist())
    return tuple(
        replace(
            ranking,
            corrected={name: tuple(next(corrected)) for name in ranking.tested},
            verdicts=len(raw),
        )
        for ranking in rankings
    )


def entry_with_cells(spec: Mapping[str, Any], cells: "pd.DataFrame") -> dict[str, Any]:
    """A [[ranking]] entry with the members of its family that have cells: of a part of a run."""
    methods = set(cells["estimator"].map(label))
    return _with_family(spec, lambda name: name in methods)


def _with_family(spec: Mapping[str, Any], is_member: Callable[[str], bool]) -> dict[str, Any]:
    """A [[ranking]] entry with some members of its family. Where none is left it is the reference,
    which has no verdict: without a family all methods would have one."""
    family = spec.get("family") or ()
    known = [name for name in family if is_member(name)]
    if family and not known:
        known = [str(spec.get("against", REFERENCE))]
    return {**spec, "family": known}


def _of_whole_robots(cases: RankingCases, baseline: str) -> RankingCases:
    """The cases with a baseline for robots alone that have it in each case: methods are judged over
    all of them, and the mean over other cases would be no bound of theirs."""
    m, errors, status = cases.methods.index(baseline), cases.errors.copy(), cases.status.copy()
    partly = {r for r, error in zip(cases.robots, errors[:, m], strict=True) if np.isnan(error)}
    absent = [robot in partly for robot in cases.robots]
    # No row: a failure would count as the reference.
    errors[absent, m], status[absent, m] = np.nan, ""
    return replace(cases, errors=errors, status=status)


def _ranking(cases: RankingCases, spec: Mapping[str, Any], values: Key, metric: Metric) -> Ranking:
    title = str(spec.get("title") or f"Methods by {metric.title}")
    against, margin = str(spec.get("against", REFERENCE)), quantity(spec.get("margin", MARGIN), "%")
    methods = tuple(name for name in cases.methods if name not in BASELINES)
    family = tuple(spec.get("family", ())) or methods
    for method in (against, *family):
        if method not in methods:
            raise unknown_name("method of this ranking", method, methods)
    is_replaced = spec.get("unconverged") == "replaced"
    # The reference stands first in its class: a copy of it is not compared with it.
    ordered = (against, *(method for method in methods if method != against))
    found = [method_ratio(cases, name, against, margin, is_replaced) for name in ordered]
    whole = [(name, _of_whole_robots(cases, name)) for name in BASELINES if name in cases.methods]
    baselines = [
        method_ratio(of, name, against, margin, is_replaced)
        for name, of in whole
        if not np.isnan(of.errors[:, of.methods.index(name)]).all()
    ]

    def order(one: MethodRatio) -> tuple[float, str]:
        """Median of the deciding ratios, then the name; without any robot last."""
        known = one.logs[~np.isnan(one.logs)]
        return (float(np.median(known)) if len(known) else np.inf, one.method)

    return Ranking(
        name="-".join([str(spec["name"]), *values]),
        title=f"{title}: {', '.join(values)}" if values else title,
        metric=metric,
        against=against,
        margin=margin,
        is_replaced=is_replaced,
        comparisons=tuple(sorted(found, key=order)),
        baselines=tuple(baselines),
        family=family,
        same=find_copied(cases, ordered),
        cases=cases,
    )
