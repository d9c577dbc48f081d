"""Changes between two runs: cells, values of metrics, true parameters, code and libraries."""

import math
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, product, starmap
from typing import Any, Final, TypeVar

import numpy as np

from sysid_bench.evaluation.robot_statistic import (
    RatioFigure,
    equivalence_p,
    holm,
    least_p,
    mean_by_robot,
    rank_test_p,
    verdict,
)
from sysid_bench.harness.comparison.drift import Drift, find_drift
from sysid_bench.harness.comparison.run_values import (
    RunValues,
    Tolerance,
    Value,
    Verdict,
    tolerance_of,
    verdict_of,
    with_ids_of,
)
from sysid_bench.harness.comparison.speed import SpeedChange, compare_speed
from sysid_bench.models.behaviour_change import BehaviourChange, behaviour_changes
from sysid_bench.types import Array, Metric
from sysid_bench.words import MACHINE_FIELDS

_Name = TypeVar("_Name")
STATUS: Final = "status"
_SAME_PARAMETER: Final = Tolerance("ratio", 1.0 + 1e-6)
ROUNDING_SHARE: Final = 1e-9
"""Share of the largest base parameter of a robot that is rounding."""


@dataclass(frozen=True)
class Change:
    """Change of a metric, or of the status, of one cell."""

    cell: str
    metric: str
    before: Value | str
    after: Value | str
    verdict: Verdict
    tolerance: str = "exact"
    reason: str = ""

    @property
    def is_failed(self) -> bool:
        """True where a gate fails by it: worse, or of a value that has to stay exactly."""
        is_exact = self.tolerance == "exact" and self.before is not None
        return self.verdict == "worse" or (self.verdict == "changed" and is_exact)


@dataclass(frozen=True)
class ParameterChange:
    """Change of a robot's true base parameter, or of their names (None: not there)."""

    robot: str
    setting: str
    parameter: str
    before: float | None
    after: float | None


@dataclass(frozen=True)
class RunDifference:
    """All changes from the run `before` to the run `after`.

    `appeared`, `vanished`, `open`: ids of cells that only one of them has, or that have a row only
    before. `origin`: (what, before, after) of code, libraries and machine. `speeds`: changes of
    speed, where both have speeds. `models`: changed behaviour of robots; `drifts`: metrics whose
    cells move together within their tolerance.
    """

    before: RunValues
    after: RunValues
    cells: tuple[Change, ...]
    parameters: tuple[ParameterChange, ...]
    appeared: tuple[str, ...]
    vanished: tuple[str, ...]
    open: tuple[str, ...]
    origin: tuple[tuple[str, str, str], ...]
    speeds: tuple[SpeedChange, ...] = ()
    models: tuple[BehaviourChange, ...] = ()
    drifts: tuple[Drift, ...] = ()

    @property
    def failed_drifts(self) -> tuple[Drift, ...]:
        """Metrics that became worse in common."""
        return tuple(drift for drift in self.drifts if drift.verdict == "worse")

    @property
    def without_model(self) -> tuple[str, ...]:
        """Robots of both runs whose behaviour is not known in both."""
        runs = (self.before, self.after)
        robots = ({cell.robot for cell in run.cells.values()} for run in runs)
        known = self.before.models.keys() & self.after.models.keys()
        return tuple(sorted(set.intersection(*robots) - known))

    @property
    def without_time(self) -> tuple[str, ...]:
        """Robots and parts that have a speed before alone."""
        return tuple(map(" ".join, _missing(self.before.speeds, self.after.speeds)))

    @property
    def failed_speed(self) -> tuple[SpeedChange, ...]:
        """Parts that became slower relative to the others of their run."""
        return tuple(change for change in self.speeds if change.verdict == "slower")

    @property
    def failed_cells(self) -> tuple[Change, ...]:
        """Changes by which a gate fails."""
        return tuple(change for change in self.cells if change.is_failed)

    @property
    def is_failed(self) -> bool:
        """True where a gate fails."""
        wrong = (self.failed_cells, self.parameters, self.vanished, self.open, self.failed_speed)
        return any((*wrong, self.models, self.failed_drifts))


def find_difference(
    before: RunValues,
    after: RunValues,
    tolerances: Mapping[str, Tolerance] | None = None,
    *,
    partial: bool = False,
) -> RunDifference:
    """Compare two runs; `tolerances` replace the default ones of their metrics.

    `partial`: cells of `before` without a row in `after` do not count; a gate of some cells.
    """
    before = with_ids_of(before, after)
    both = [cell for cell, was in before.cells.items() if not was.is_open and cell in after.cells]
    ran = [cell for cell in both if not after.cells[cell].is_open]
    # Speeds are undecided for robots that have not the same cells in both runs.
    robots = {robot for robot, _ in before.speeds}
    known = before.models.keys() & after.models.keys()
    pairs = ((robot, before.models[robot], after.models[robot]) for robot in sorted(known))
    differing = {robot for robot in robots if before.cell_labels(robot) != after.cell_labels(robot)}
    return RunDifference(
        before=before,
        after=after,
        cells=tuple(_cell_changes(before, after, ran, tolerances or {})),
        parameters=tuple(_parameter_changes(before, after)),
        appeared=_missing(after.cells, before.cells),
        vanished=() if partial else _missing(before.cells, after.cells),
        open=() if partial else tuple(sorted({*both} - {*ran})),
        origin=tuple(_origin_changes(before, after)),
        speeds=tuple(compare_speed(before.speeds, after.speeds, differing)),
        models=tuple(chain.from_iterable(starmap(behaviour_changes, pairs))),
        drifts=find_drift(before, after, ran, _tolerances(before, after, tolerances or {})),
    )


def _tolerances(
    before: RunValues, after: RunValues, given: Mapping[str, Tolerance]
) -> dict[str, Tolerance]:
    """Return the tolerance of each metric that both runs have and no machine changes."""
    return {
        name: given.get(name) or tolerance_of(after.metrics[name])
        for name in before.metrics
        if name in after.metrics and name not in MACHINE_FIELDS  # those differ in any run
    }


def _missing(names: Iterable[_Name], there: Container[_Name]) -> tuple[_Name, ...]:
    """Return the names that are not there, in their order."""
    return tuple(name for name in names if name not in there)


def _cell_changes(
    before: RunValues, after: RunValues, cells: list[str], tolerances: Mapping[str, Tolerance]
) -> Iterator[Change]:
    """Yield the changes of status and, where it is the same, of each metric that both have."""
    compared = [
        (after.metrics[name], tolerance, *_places(name, before, after))
        for name, tolerance in _tolerances(before, after, tolerances).items()
    ]
    for cell in cells:
        was, now = before.cells[cell], after.cells[cell]
        if was.status != now.status:
            # Changed fails a gate as well: a refusal that becomes an answer is to be looked at.
            verdict: Verdict = "worse" if was.status == "ok" else "changed"
            reason = now.reason if now.status != "ok" else was.reason
            yield Change(cell, STATUS, was.status, now.status, verdict, reason=reason)
            continue
        for metric, tolerance, old, new in compared:
            pair = was.values[old], now.values[new]
            verdict = verdict_of(metric.better, tolerance, *pair)
            if verdict != "same":
                yield Change(cell, metric.name, *pair, verdict, str(tolerance))


_EXACT: Final = 1e-12
"""Relative difference of two values that are the same number: one digit above the rounding of a
double, so that the last bits of other kernels stay unmentioned."""


def moved_values(
    before: RunValues, after: RunValues, tolerances: Mapping[str, Tolerance]
) -> tuple[Change, ...]:
    """Return the values that are another number, whatever their tolerance: what changes in the last
    digits while code and libraries are the same. Below the floor of its tolerance a value is 0."""
    before, known = with_ids_of(before, after), _tolerances(before, after, tolerances)
    moved = []
    for cell, name in product(before.cells.keys() & after.cells.keys(), known):
        old, new = _places(name, before, after)
        pair = before.cells[cell].values[old], after.cells[cell].values[new]
        if None not in pair:
            a, b = (known[name].stored_value(float(value or 0.0)) for value in pair)
            if not math.isclose(a, b, rel_tol=_EXACT):
                moved.append(Change(cell, name, *pair, "changed", f"{_EXACT:g}"))
    return tuple(sorted(moved, key=lambda change: (before.label(change.cell), change.metric)))


def _parameter_changes(before: RunValues, after: RunValues) -> Iterator[ParameterChange]:
    """Yield what differs in the true base parameters of the settings that both have."""
    for key, was in before.parameters.items():
        if (now := after.parameters.get(key)) is None:
            continue
        largest = max((0.0, *map(abs, (*was.values(), *now.values()))))
        # Below this share of the robot's largest parameter both are rounding.
        same = replace(_SAME_PARAMETER, floor=ROUNDING_SHARE * largest)
        for name in dict.fromkeys((*was, *now)):
            a, b = was.get(name), now.get(name)
            if a is None or b is None or not same.holds(a, b):
                yield ParameterChange(*key, name, a, b)


def _places(name: str, before: RunValues, after: RunValues) -> tuple[int, int]:
    """Return where the values of a metric stand in the cells of two runs."""
    return [*before.metrics].index(name), [*after.metrics].index(name)


def _origin_changes(before: RunValues, after: RunValues) -> Iterator[tuple[str, str, str]]:
    """Yield (name, before, after) of what differs in the origins, "-" where a run lacks it."""
    old, new = _flat_origin(before.origin), _flat_origin(after.origin)
    for name in dict.fromkeys((*old, *new)):
        if old.get(name) != new.get(name):
            yield name, old.get(name, "-"), new.get(name, "-")


def _flat_origin(origin: Mapping[str, Any]) -> dict[str, str]:
    """Commit, versions of libraries, Python, BLAS and processor."""
    machine = {key: origin.get(key) for key in ("python", "blas", "cpu")}
    git = origin.get("git") or {}
    commit = str(git.get("commit", ""))[:12] + (" with changes" if git.get("dirty") else "")
    named = {"commit": commit, **machine, **(origin.get("versions") or {})}
    return {name: str(value) for name, value in named.items() if value}


MARGIN: Final = 0.1
"""Equivalence margin: ratios within a factor of 1.1 are equal in practice."""
_DIGITS: Final = 1e-6


@dataclass(frozen=True)
class MetricRatio:
    """A metric after over before: the median over `robots` of the mean log ratio of their cells,
    as `ratio`, with its 95 % interval (None for fewer than six robots).

    `lower` and `higher` count robots; `p` is that of Wilcoxon's signed-rank test, never below
    `smallest_p` with this many that differ. `zeros`: cells left out, since a value is zero,
    rounding or not there. `verdict`: better, worse, equivalent, undecided; "" without an interval
    or direction.
    """

    metric: str
    robots: int
    cells: int
    zeros: int
    ratio: float | None
    low: float | None
    high: float | None
    lower: int
    higher: int
    p: float
    smallest_p: float
    verdict: str


def metric_ratio(before: RunValues, after: RunValues) -> tuple[MetricRatio, ...]:
    """Ratios of the metrics of both runs that are compared by a factor, over the cells that are ok
    in both."""
    before = with_ids_of(before, after)
    is_ok = {name for name, cell in after.cells.items() if cell.is_ok}
    cells = [name for name, cell in before.cells.items() if cell.is_ok and name in is_ok]
    ratios = []
    for name, metric in before.metrics.items():
        tolerance = tolerance_of(metric)
        if name not in after.metrics or tolerance.kind != "ratio":
            continue
        old, new = _places(name, before, after)
        pairs: dict[str, list[tuple[float, float]]] = {}  # values before and after by robot
        absent = 0
        for cell in cells:
            was, now = before.cells[cell].values[old], after.cells[cell].values[new]
            if was is None or now is None:
                absent += was is not now
            else:
                pairs.setdefault(before.cells[cell].robot, []).append((was, now))
        ratios.append(_ratio(metric, tolerance.floor, pairs, absent))
    return _with_verdicts(before.metrics, ratios)


def _with_verdicts(
    metrics: Mapping[str, Metric], found: list[tuple[Array, MetricRatio]]
) -> tuple[MetricRatio, ...]:
    """The ratios with their verdicts, from p-values that are corrected together."""
    signs = {"lower": 1.0, "higher": -1.0}
    judged = {
        one.metric: signs[better] * logs
        for logs, one in found
        if (better := metrics[one.metric].better) and one.low is not None
    }
    p = [(rank_test_p(logs), equivalence_p(logs, MARGIN)) for logs in judged.values()]
    corrected = dict(zip(judged, holm(np.array(p).reshape(-1, 2)).tolist(), strict=True))
    return tuple(
        replace(one, verdict=verdict(judged[one.metric], MARGIN, *corrected[one.metric]))
        if one.metric in judged
        else one
        for _, one in found
    )


def _ratio(
    metric: Metric, floor: float, pairs: Mapping[str, list[tuple[float, float]]], absent: int
) -> tuple[Array, MetricRatio]:
    """Mean log ratios (robots,) and their figures, without a verdict."""
    logs: dict[str, list[float]] = {}
    for robot, values in pairs.items():
        # A ratio of two roundings says nothing. Those within the digits of a baseline are zero.
        sound = (pair for pair in values if min(pair) > floor)
        of_robot = [float(np.log(now / was)) for was, now in sound]
        # Below the digits of a baseline: such a log must not give the rank test a sign.
        logs[robot] = [0.0 if abs(log) < _DIGITS else log for log in of_robot]
    means = mean_by_robot(
        [robot for robot, values in logs.items() for _ in values],
        np.array([value for values in logs.values() for value in values]),
        tuple(logs),
    )
    used = means[~np.isnan(means)]
    count, figure = sum(map(len, logs.values())), RatioFigure.of(used)
    return used, MetricRatio(
        metric=metric.name,
        robots=len(used),
        cells=count,
        zeros=absent + sum(map(len, pairs.values())) - count,
        ratio=figure.value,
        low=figure.low,
        high=figure.high,
        lower=int((used < 0).sum()),
        higher=int((used > 0).sum()),
        p=rank_test_p(used),
        smallest_p=least_p(int(np.count_nonzero(used))),
        verdict="",
    )
