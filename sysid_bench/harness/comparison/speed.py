"""Speeds of a run as ratios within it: times of different machines or loads are not compared.

A part is the experiment (simulation, signals, reduction), the kernel of its regressor, or an
estimator. The time of a part in a group of repeats (cells that differ by their repeat alone) is the
least of them: load only adds to times, and in each worker the first repeat also makes what the
others share, which is not compared. Its speed is the geometric mean over groups over that of the
parts of the same robot in the same run. Both runs have the same groups, so that only repeats of one
group differ by noise.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final, Literal

import numpy as np

EXPERIMENT: Final = "experiment"
KERNEL: Final = "kernel"
ALL: Final = "all robots"
LIMIT: Final = 1.5
"""Factor beyond which a part is slower or faster."""
SIGMAS: Final = 4.0
"""Multiples of its noise that a change on one robot exceeds to count."""
SIGMAS_POOLED: Final = 3.0
"""The same of all robots together: they are fewer."""
FEWEST_PARTS: Final = 3
"""Parts of a robot from which on the one that changed is known: of two, either may have."""
_FEWEST: Final = 3
_EXPONENTIAL: Final = math.sqrt(2) / math.log(2)
"""Root mean square over median of an exponential distribution."""
_PRIOR: Final = 4
"""Groups that the typical gap of a run counts as, beside those of a part."""

Key = tuple[str, str]
"""Robot and part."""
SpeedVerdict = Literal["same", "slower", "faster", "undecided"]


@dataclass(frozen=True)
class Speed:
    """Time of a part over the geometric mean of its robot's parts; `noise`: standard error of the
    logarithm, from the repeats among `count` times."""

    ratio: float
    noise: float
    count: int


@dataclass(frozen=True)
class SpeedChange:
    """Factor by which a part became slower, relative to the other parts of its run; `noise`:
    standard error of its logarithm. "undecided": a factor of two would not be seen, or not be known
    to be of this part."""

    robot: str
    part: str
    factor: float
    noise: float
    verdict: SpeedVerdict


def relative_speed(times: Mapping[Key, Sequence[Sequence[float]]]) -> dict[Key, Speed]:
    """Speeds of the parts from their times (s), a sequence for each group of repeats; groups
    of fewer than three show no noise and do not count, parts without any other have no speed."""
    logs = {}
    for key, groups in times.items():
        # A clock may give 0 s for a short part.
        positive = [[math.log(value) for value in group if value > 0] for group in groups]
        if kept := [group for group in positive if len(group) >= _FEWEST]:
            logs[key] = kept
    middle = {key: float(np.mean([*map(min, groups)])) for key, groups in logs.items()}
    # Root mean square of the gap between the two least of a group, of all groups of a run together,
    # from the median of gaps that have an exponential distribution.
    gaps = [_gap(group) for groups in logs.values() for group in groups]
    if not gaps:
        return {}
    typical = _EXPONENTIAL * median(gaps)
    found = {}
    for key, groups in logs.items():
        of_robot = [value for (robot, _), value in middle.items() if robot == key[0]]
        ratio = math.exp(middle[key] - float(np.mean(of_robot)))
        found[key] = Speed(ratio, _noise(groups, typical), sum(map(len, groups)))
    return found


def _gap(group: Sequence[float]) -> float:
    least, second = sorted(group)[:2]
    return second - least


def _noise(groups: Sequence[Sequence[float]], typical: float) -> float:
    """Standard error of the mean over groups of their least value.

    Load adds times of an exponential distribution, of which the least of n values deviates by
    (n - 1) / (n sqrt 2) of the RMS of the gap to the second (Renyi 1953). The gap of few groups
    says little: their squares count beside `_PRIOR` of the typical one.
    """
    squares = [_PRIOR * typical**2, *(_gap(group) ** 2 for group in groups)]
    square = sum(squares) / (_PRIOR + len(groups))
    count = len(groups[0])
    return (count - 1) / count * math.sqrt(square / 2 / len(groups))


def compare_speed(
    before: Mapping[Key, Speed], after: Mapping[Key, Speed], differing: Collection[str] = ()
) -> list[SpeedChange]:
    """Changes of the parts that both runs have, of all robots together first.

    The change of a part is relative to the median change of all parts of its robot, itself among
    them: what slows most of them is the machine. A robot with one part has none; with two parts, or
    where the groups of the runs are `differing`, its changes are undecided.
    """
    both = [key for key in before if key in after]
    logs = {key: math.log(after[key].ratio / before[key].ratio) for key in both}
    noise = {key: math.hypot(before[key].noise, after[key].noise) for key in both}
    parts = Counter(robot for robot, _ in both)
    unknown = {*differing, *(robot for robot, count in parts.items() if count < FEWEST_PARTS)}
    known = [change for change in _relative(logs, noise) if change.robot not in unknown]
    single = [
        replace(change, verdict="undecided") if change.robot in unknown else change
        for change in _relative(logs, noise)
    ]
    return [*_pooled(known), *single]


def _pooled(changes: Iterable[SpeedChange]) -> Iterator[SpeedChange]:
    """Yield the mean change of each part over the robots."""
    by_part: dict[str, list[SpeedChange]] = {}
    for change in changes:
        by_part.setdefault(change.part, []).append(change)
    for part, found in by_part.items():
        mean = float(np.mean([math.log(change.factor) for change in found]))
        error = _mean_noise(change.noise for change in found)
        yield _change(ALL, part, mean, error, SIGMAS_POOLED)


def _relative(logs: Mapping[Key, float], noise: Mapping[Key, float]) -> Iterator[SpeedChange]:
    for robot, part in logs:
        others = [key for key in logs if key[0] == robot and key[1] != part]
        if others:
            # The median, since one part that became slow must not make the others look fast.
            machine = median(map(logs.__getitem__, [(robot, part), *others]))
            error = math.hypot(noise[robot, part], _mean_noise(map(noise.__getitem__, others)))
            yield _change(robot, part, logs[robot, part] - machine, error)


def _mean_noise(noise: Iterable[float]) -> float:
    """Standard error of a mean of independent values."""
    values = list(noise)
    return math.sqrt(sum(value**2 for value in values)) / len(values)


def _change(robot: str, part: str, log: float, noise: float, sigmas: float = SIGMAS) -> SpeedChange:
    verdict: SpeedVerdict = "same"
    limit = max(math.log(LIMIT), sigmas * noise)
    if log > limit:
        verdict = "slower"
    elif log < -limit:
        verdict = "faster"
    elif sigmas * noise > math.log(2.0):
        verdict = "undecided"
    return SpeedChange(robot, part, math.exp(log), noise, verdict)
