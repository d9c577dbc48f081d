"""Rankings of methods over robots by the ratio of their errors to the best.

A case is everything but the method: robot, payload, motion, noise, ... and repeat. Its errors are
divided by the smallest of them, so that robots of different size have the same weight. A cell that
is not ok has no error; it counts as ten times the worst of its case.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.evaluation.comparison import (
    failures_last,
    interquartile_mean,
    performance_profile,
    robot_bootstrap,
    wilcoxon_holm,
    wilcoxon_holm_against,
    win_rates,
)
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.selection import Choose, label, selected
from sysid_bench.reporting.tables import Entry, Key, Table
from sysid_bench.types import Array, Metric

if TYPE_CHECKING:
    import pandas as pd

RATIOS: Final = np.geomspace(1.0, 100.0, 201)
"""Times the best, at which profiles are drawn."""

NEAR: Final = 1.1
"""Times the best that a table calls near it."""

_CASE: Final = (
    "robot", "payload", "task", "terms", "plant", "prior", "excitation", "held_out", "simulation",
    "rate", "noise", "signals", "repeat",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Ranking:
    """Methods, the best first. `ratios` (cases, methods) are errors over the best of the case, NaN
    where there is none; `wins` and `p` (methods, methods) as of evaluation/comparison.py."""

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
        return self.summary_table, self._pairs("wins", self.wins), self._pairs("p", self.p)

    @property
    def summary_table(self) -> Table:
        """The methods from best to worst."""
        others = 1 - np.eye(len(self.methods))
        won = (self.wins * others).sum(axis=1) / max(len(self.methods) - 1, 1)
        reference = self.methods.index(self.against or self.methods[0])
        p = self.p_against if self.against else self.p[reference]
        columns: dict[str, Sequence[Entry]] = {
            "times the best": [
                _number(v, *ends) for v, *ends in zip(self.mean, self.low, self.high, strict=True)
            ],
            f"within {NEAR:g}": [_number(v) for v in self._share(self.ratios <= NEAR)],
            "wins": [_number(v) for v in won],
            "failed": [_number(v) for v in self._share(np.isnan(self.ratios))],
            "p": [
                _number(v) if i != reference else Entry(None, None, None, 0, {})
                for i, v in enumerate(p)
            ],
        }
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
            f"signed-rank test over robots against {self.methods[reference]}, Holm's correction "
            f"over {'these comparisons' if self.against else 'all pairs'}."
        )
        return self._table(self.name, self.title, ("figure",), tuple(columns), entries, caption)

    def _pairs(self, which: str, values: Array) -> Table:
        entries: dict[tuple[Key, Key], Entry] = {
            ((row,), (column,)): _number(values[i, j])
            for i, row in enumerate(self.methods)
            for j, column in enumerate(self.methods)
            if i != j
        }
        caption = {
            "wins": "Share of the cases in which the row beats the column; ties count half.",
            "p": f"Wilcoxon's signed-rank test over {self.robots} robots, Holm's correction over "
            "all pairs: the chance of a difference as clear as this between equals.",
        }[which]
        title = f"{self.title}: {'who beats whom' if which == 'wins' else 'p of each pair'}"
        name = f"{self.name}-{which}"
        return self._table(name, title, ("against",), self.methods, entries, caption)

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

    def _share(self, counted: Array) -> Array:
        return np.asarray(counted.mean(axis=0))


def rankings(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Iterator[Ranking]:
    """Rankings of a [[ranking]] entry of a suite: one for each value of the labels `apart`.

    `metrics` are the records by name. Raises UsageError where no case has rows of two methods.
    """
    apart = tuple(spec.get("apart", ()))
    for field in apart:
        if field not in cells.columns:
            raise unknown_name("field of the cells", field, map(str, cells.columns))
    chosen = selected(cells, spec, choose)
    for key, group in chosen.groupby(list(apart), sort=False) if apart else [((), chosen)]:
        values = [label(part) for part in (key if isinstance(key, tuple) else (key,))]
        yield _ranking(group, spec, values, metric_of(str(spec["metric"]), metrics))


def _ranking(
    cells: "pd.DataFrame", spec: Mapping[str, Any], values: Sequence[str], metric: Metric
) -> Ranking:
    title = str(spec.get("title") or f"Methods by {metric.title}")
    cases = _cases(cells, metric)
    ratios = cases.errors / np.fmin.reduce(cases.errors, axis=1)[:, None]
    logs = _by_robot(np.log(failures_last(ratios)), cases.robots, cases.motions)
    mean = interquartile_mean(np.exp(logs).reshape(-1, logs.shape[-1]))
    low, high = robot_bootstrap(np.exp(logs))
    order = np.argsort(mean, kind="stable")
    pairs, by_robot = np.ix_(order, order), np.exp(logs.mean(axis=1))
    against = str(spec.get("against", ""))
    if against and against not in cases.methods:
        raise unknown_name("method of this ranking", against, cases.methods)
    reference = cases.methods.index(against) if against else int(order[0])
    return Ranking(
        name="-".join([str(spec["name"]), *values]),
        title=f"{title}: {', '.join(values)}" if values else title,
        metric=metric,
        methods=tuple(cases.methods[i] for i in order),
        robots=logs.shape[0],
        motions=logs.shape[1],
        left_out=cases.left_out,
        ratios=ratios[:, order],
        mean=mean[order],
        low=low[order],
        high=high[order],
        wins=win_rates(cases.errors)[pairs],
        p=wilcoxon_holm(by_robot)[pairs],
        p_against=wilcoxon_holm_against(by_robot, reference)[order],
        against=against,
    )


@dataclass(frozen=True, eq=False)
class _Cases:
    """errors (cases, methods), NaN where there is none; robot and motion of each case."""

    errors: Array
    robots: tuple[str, ...]
    motions: tuple[str, ...]
    methods: tuple[str, ...]
    left_out: int


def _cases(cells: "pd.DataFrame", metric: Metric) -> _Cases:
    """The cases in which every method has a row."""
    import pandas as pd

    names = [name for name in _CASE if name in cells.columns]
    values = cells[metric.name] if metric.name in cells else pd.Series(np.nan, cells.index)
    error = pd.to_numeric(values.where(cells["status"] == "ok"), errors="coerce")
    # Errors below the floor are rounding: they compare as equal.
    error = error.clip(lower=max(metric.floor, np.finfo(float).tiny))
    lines = cells[names].map(label).assign(estimator=cells["estimator"].map(label), error=error)
    rows = lines.groupby([*names, "estimator"], sort=False)["error"].agg(["size", "first"])
    size, errors = (rows[which].unstack("estimator") for which in ("size", "first"))
    methods = list(dict.fromkeys(lines["estimator"]))
    whole = size[methods].notna().all(axis=1)
    if len(methods) < 2 or not whole.any():
        raise UsageError(
            f"A ranking by {metric.name} found {len(methods)} methods "
            f"({', '.join(methods) or 'none'}) and no case in which all of them have a row; "
            "'select' those that ran on the same cases."
        )
    errors = errors.loc[whole, methods]
    labels = errors.index.to_frame(index=False)
    motions = labels["excitation"] if "excitation" in labels else labels["robot"].map(lambda _: "")
    return _Cases(
        errors.to_numpy(dtype=float),
        tuple(labels["robot"]),
        tuple(motions),
        tuple(methods),
        int((~whole).sum()),
    )


def _by_robot(logs: Array, robots: Sequence[str], motions: Sequence[str]) -> Array:
    """Means (robots, motions, methods) of logs (cases, methods); where robots moved differently,
    all motions of a robot are one."""
    pairs = list(dict.fromkeys(zip(robots, motions, strict=True)))
    names = list(dict.fromkeys(robots))
    each = {name: [m for r, m in pairs if r == name] for name in names}
    if len({tuple(sorted(moved)) for moved in each.values()}) > 1:
        each, motions = {name: [""] for name in names}, [""] * len(robots)
    who, what = np.array(robots), np.array(motions)
    return np.array([[logs[(who == n) & (what == m)].mean(axis=0) for m in each[n]] for n in names])


def _number(value: float, low: float | None = None, high: float | None = None) -> Entry:
    ends = [None if end is None else float(end) for end in (low, high)]
    return Entry(float(value), ends[0], ends[1], 1, {})
