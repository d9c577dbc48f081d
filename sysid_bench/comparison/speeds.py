"""Speeds of a run as ratios within it: times of different machines or loads are not compared.

A part is the experiment (simulation, signals, regressor, reduction) or an estimator. Its speed is
its median CPU time over the geometric mean of the parts of the same robot in the same run.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final, Literal

import numpy as np

EXPERIMENT: Final = "experiment"
ALL: Final = "all robots"
LIMIT: Final = 1.5
"""Factor beyond which a part is slower or faster."""
SIGMAS: Final = 4.0
"""Multiples of its noise that a change exceeds to count."""
_FEWEST: Final = 3
_MEDIAN_NOISE: Final = math.sqrt(math.pi / 2) * 1.4826
"""Standard error of a median times the root of the count, over the median absolute deviation."""

Key = tuple[str, str]
"""Robot and part."""
SpeedVerdict = Literal["same", "slower", "faster", "undecided"]


@dataclass(frozen=True)
class Speed:
    """Time of a part over the geometric mean of its robot's parts; `noise`: standard error of the
    logarithm, from `count` times."""

    ratio: float
    noise: float
    count: int


@dataclass(frozen=True)
class SpeedChange:
    """Factor by which a part became slower, relative to the other parts of its run; `noise`:
    standard error of its logarithm. "undecided": a factor of two would not be seen."""

    robot: str
    part: str
    factor: float
    noise: float
    verdict: SpeedVerdict


def speeds_of(times: Mapping[Key, Sequence[float]]) -> dict[Key, Speed]:
    """Speeds of the parts with three times (s) or more."""
    logs = {
        key: np.log([value for value in values if value > 0])
        for key, values in times.items()
        if sum(value > 0 for value in values) >= _FEWEST
    }
    middle = {key: float(np.median(values)) for key, values in logs.items()}
    found = {}
    for key, values in logs.items():
        common = np.mean([middle[other] for other in middle if other[0] == key[0]])
        spread = float(np.median(np.abs(values - middle[key])))
        noise = _MEDIAN_NOISE * spread / math.sqrt(len(values))
        found[key] = Speed(math.exp(middle[key] - float(common)), noise, len(values))
    return found


def speed_changes(before: Mapping[Key, Speed], after: Mapping[Key, Speed]) -> list[SpeedChange]:
    """Changes of the parts that both runs have, of all robots together first.

    The change of a part is relative to the median change of the other parts of its robot: what
    slows all of them is the machine. A robot with one part has none.
    """
    both = [key for key in before if key in after]
    logs = {key: math.log(after[key].ratio / before[key].ratio) for key in both}
    noise = {key: math.hypot(before[key].noise, after[key].noise) for key in both}
    single = list(_relative(logs, noise))
    parts = dict.fromkeys(change.part for change in single)
    pooled = (_pooled([change for change in single if change.part == part]) for part in parts)
    return [*pooled, *single]


def _relative(logs: Mapping[Key, float], noise: Mapping[Key, float]) -> Iterator[SpeedChange]:
    for robot, part in logs:
        others = [key for key in logs if key[0] == robot and key[1] != part]
        if others:
            machine = median(logs[key] for key in others)
            error = math.hypot(noise[robot, part], _mean_noise(noise[key] for key in others))
            yield _change(robot, part, logs[robot, part] - machine, error)


def _pooled(changes: Sequence[SpeedChange]) -> SpeedChange:
    mean = float(np.mean([math.log(change.factor) for change in changes]))
    return _change(ALL, changes[0].part, mean, _mean_noise(change.noise for change in changes))


def _mean_noise(noise: Iterable[float]) -> float:
    """Standard error of a mean of independent values."""
    values = list(noise)
    return math.sqrt(sum(value**2 for value in values)) / len(values)


def _change(robot: str, part: str, log: float, noise: float) -> SpeedChange:
    verdict: SpeedVerdict = "same"
    if abs(log) > max(math.log(LIMIT), SIGMAS * noise):
        verdict = "slower" if log > 0 else "faster"
    elif SIGMAS * noise > math.log(2.0):
        verdict = "undecided"
    return SpeedChange(robot, part, math.exp(log), noise, verdict)
