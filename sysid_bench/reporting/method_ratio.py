"""One method against the reference of a ranking, robot by robot.

Per case l = ln(error / error of the reference); per robot the mean over its cases, so that a robot
with many of them counts once; over robots exp(median). Each figure depends on the method and the
reference alone.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.evaluation.intervals import median_interval
from sysid_bench.evaluation.robot_statistic import (
    RatioFigure,
    least_p,
    mean_by_robot,
    rank_test_p,
    verdict,
)
from sysid_bench.reporting.ranking_cases import RankingCases
from sysid_bench.types import Array

MOST_FALLBACKS: Final = 0.1
"""Share of cases without an own answer above which a method is not called better or equivalent."""

BROKEN: Final = 1e-6
"""Error above which an answer from noise-free data breaks the law that they give the truth."""

ALIKE: Final = 1e-4
"""Relative difference of errors up to which two answers are the same."""

UNDECIDED: Final = "undecided"

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
    smallest_p: float
    verdict: str
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
    logs = _logs(cases, m, r)
    planned = _planned(cases, m, r)
    answered, converged = planned & np.isfinite(logs), cases.converged[:, m]
    by_robot = {
        "ratio": _by_robot(cases.robots, logs, answered),
        "fallback": _by_robot(cases.robots, np.where(answered, logs, 0.0), planned),
        "replaced": _by_robot(cases.robots, np.where(answered & converged, logs, 0.0), planned),
    }
    deciding = by_robot["replaced" if is_replaced else "fallback"]
    own = answered & converged if is_replaced else answered
    known = deciding[~np.isnan(deciding)]
    share = 1.0 - own.sum() / max(planned.sum(), 1)
    return MethodRatio(
        method=method,
        ratio=_figure(by_robot["ratio"]),
        fallback=_figure(by_robot["fallback"]),
        replaced=_figure(by_robot["replaced"]),
        robots=len(known),
        cells=int(planned.sum()),
        statuses=_statuses(cases, m, planned & ~answered),
        unconverged=int((answered & ~converged).sum()),
        laws=_laws(cases, m),
        p=rank_test_p(known),
        smallest_p=least_p(int(np.count_nonzero(known))),
        verdict=_verdict(known, margin, share),
        logs=deciding,
        ratios=np.where(answered, np.exp(logs), np.nan)[planned],
        reason=cases.reasons.get(method, ""),
    )


def _logs(cases: RankingCases, m: int, r: int) -> Array:
    """l (cases,) of method m against r; NaN where one has no error. No ratio to a zero: an error
    that is rounding has none."""
    errors = np.where(cases.errors > cases.floor, cases.errors, np.nan)
    return np.round(np.log(errors[:, m]) - np.log(errors[:, r]), _DIGITS)


def _planned(cases: RankingCases, m: int, r: int) -> Array:
    """Cases (cases,) in which the method has a row, be it a failure, and the reference an answer;
    without those in which one of the two errors is rounding."""
    has_row, errors = cases.has_row, cases.errors
    return np.asarray(
        cases.with_ratio
        & has_row[:, m]
        & (errors[:, r] > cases.floor)
        & ~(errors[:, m] <= cases.floor)
    )


def _by_robot(robots: tuple[str, ...], values: Array, which: Array) -> Array:
    """Mean (robots,) of the values of each robot's cases in `which`, in the order of first
    appearance; NaN for a robot without any."""
    return mean_by_robot(robots, np.where(which, values, np.nan), tuple(dict.fromkeys(robots)))


def _figure(by_robot: Array) -> RatioFigure:
    return RatioFigure.of(by_robot[~np.isnan(by_robot)])


def _verdict(logs: Array, margin: float, fallbacks: float) -> str:
    """Verdict from the interval; that of a method which often has no own answer may only be worse
    or undecided, since the answers are those of the reference."""
    ends = median_interval(logs)
    if ends is None:
        return UNDECIDED
    found = verdict(*ends, margin)
    return UNDECIDED if fallbacks > MOST_FALLBACKS and found != "worse" else found


def _statuses(cases: RankingCases, m: int, lost: Array) -> dict[str, int]:
    """Number of cases without an answer by status; "no value" where an ok row has no error."""
    counts = Counter(cases.status[lost, m].tolist())
    counted = {("no value" if status == "ok" else status): n for status, n in counts.items()}
    return dict(sorted(counted.items()))


def _laws(cases: RankingCases, m: int) -> tuple[int, int]:
    """Noise-free cases that keep the law, and all of them that have a row."""
    given = cases.noise_free & cases.has_row[:, m]
    return int((cases.errors[given, m] <= BROKEN).sum()), int(given.sum())


def find_copied(cases: RankingCases, methods: tuple[str, ...]) -> dict[str, str]:
    """The first of `methods` that gave the same answers, for each method that is not it: the same
    cases answered, with errors within ALIKE of each other in every one."""
    found: dict[str, str] = {}
    different: list[str] = []
    for method in methods:
        same = next((one for one in different if _is_same(cases, one, method)), None)
        if same is None:
            different.append(method)
        else:
            found[method] = same
    return found


def _is_same(cases: RankingCases, one: str, other: str) -> bool:
    a, b = (cases.methods.index(name) for name in (one, other))
    if (cases.status[:, a] != cases.status[:, b]).any():
        return False
    first, second = cases.errors[cases.with_ratio][:, [a, b]].T
    known = ~(np.isnan(first) & np.isnan(second))
    close = np.abs(first - second) <= ALIKE * np.maximum(first, cases.floor)
    return bool(known.any() and close[known].all())
