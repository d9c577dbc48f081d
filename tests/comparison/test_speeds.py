"""Laws of speeds: a part that becomes slower is named, a machine that does is not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.harness.comparison import speed as speeds
from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text
from sysid_bench.harness.comparison.run_difference import find_difference
from sysid_bench.harness.comparison.run_values import CellValues, RunValues, part_times
from sysid_bench.harness.comparison.speed import (
    ALL,
    EXPERIMENT,
    SIGMAS,
    SIGMAS_POOLED,
    Key,
    Speed,
    compare_speed,
    relative_speed,
)
from sysid_bench.metrics import METRICS
from sysid_bench.words import LABELS

ROBOTS, ESTIMATORS = ("scara", "ur5", "panda"), ("ols", "wls", "entropic")
SECONDS = {EXPERIMENT: 0.05, "ols": 0.002, "wls": 0.01, "entropic": 0.3}


Times = dict[Key, list[list[float]]]
TASKS = (1.0, 30.0, 0.2, 5.0)
"""Factors of the times of groups: tasks, payloads and motions of several sizes."""


def times(rng: np.random.Generator, noise: float, *parts: str, **slower: float) -> Times:
    """Times of a run on a machine of its own speed, by group of three repeats of which the first
    makes what all share; `parts`: all where none is named; `slower`: factors of parts."""
    machine = float(rng.uniform(0.2, 5.0))
    return {
        (robot, part): [
            [
                machine * slower.get(part, 1.0) * SECONDS[part] * (1 + n) * task * shared
                * float(np.exp(noise * rng.normal()))
                for shared in (20.0 if part == EXPERIMENT else 1.0, 1.0, 1.0)
            ]
            for task in TASKS
        ]
        for n, robot in enumerate(ROBOTS)
        for part in parts or SECONDS
    }  # fmt: skip


def scaled(measured: Times, factor: float) -> Times:
    return {
        key: [[factor * value for value in group] for group in groups]
        for key, groups in measured.items()
    }


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_a_repeat_on_another_machine_changes_no_speed(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    before, after = (relative_speed(times(rng, noise)) for _ in range(2))
    verdicts = {change.verdict for change in compare_speed(before, after)}
    assert verdicts <= {"same", "undecided"}


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("part", SECONDS)
def test_a_part_that_is_twice_as_slow_is_named_alone(seed: int, part: str) -> None:
    rng = np.random.default_rng(seed)
    before, after = relative_speed(times(rng, 0.1)), relative_speed(times(rng, 0.1, **{part: 2.0}))
    found = [change for change in compare_speed(before, after) if change.verdict == "slower"]
    assert {change.part for change in found} == {part}
    assert found[0].robot == ALL
    assert found[0].factor == pytest.approx(2.0, rel=0.2)
    back = [change for change in compare_speed(after, before) if change.verdict == "faster"]
    assert {change.part for change in back} == {part}


@pytest.mark.parametrize("seed", range(5))
def test_noise_that_hides_a_factor_of_two_is_said(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = (relative_speed(times(rng, 3.0)) for _ in range(2))
    verdicts = [change.verdict for change in compare_speed(before, after)]
    assert verdicts.count("undecided") >= 0.9 * len(verdicts)


@pytest.mark.parametrize("kind", ["normal", "exponential"])
def test_changes_of_unchanged_code_are_as_large_as_their_noise(kind: str) -> None:
    """Three repeats of one group, as in the smallest suite that shows noise."""
    rng = np.random.default_rng(0)

    def run() -> Times:
        drawn = np.exp(0.1 * getattr(rng, f"standard_{kind}")((len(ROBOTS), len(SECONDS), 3)))
        return {
            (robot, part): [drawn[i, j].tolist()]
            for i, robot in enumerate(ROBOTS)
            for j, part in enumerate(SECONDS)
        }

    found = [compare_speed(relative_speed(run()), relative_speed(run())) for _ in range(100)]
    for pooled in (True, False):
        shares = [
            np.log(one.factor) / one.noise
            for changes in found
            for one in changes
            if (one.robot == ALL) == pooled
        ]
        assert 0.7 < np.sqrt(np.mean(np.square(shares))) < 1.2
        assert np.mean(np.abs(shares) > (SIGMAS_POOLED if pooled else SIGMAS)) < 0.015


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("part", SECONDS)
def test_a_disturbed_repeat_hides_no_factor_of_two(seed: int, part: str) -> None:
    """One of the three repeats of each part lost its caches; the other two are as they are."""
    rng = np.random.default_rng(seed)

    def run(**slower: float) -> Times:
        few = {key: groups[:1] for key, groups in times(rng, 0.05, **slower).items()}
        return {key: [[a, b, c * rng.uniform(1, 3)]] for key, [[a, b, c]] in few.items()}

    found = compare_speed(relative_speed(run()), relative_speed(run(**{part: 2.0})))
    assert {one.part for one in found if one.verdict == "slower"} == {part}


def test_parts_with_few_times_and_robots_with_one_part_have_no_change() -> None:
    few = relative_speed({("ur5", "ols"): [[1.0, 2.0]] * 5, ("ur5", "wls"): [[1.0, 0.0, 2.0]]})
    assert not few
    one = relative_speed({("ur5", "ols"): [[1.0, 2.0, 3.0]]})
    assert len(one) == 1
    assert not compare_speed(one, one)


@pytest.mark.parametrize("parts", [(EXPERIMENT, "ols"), (EXPERIMENT, "ols", "wls"), (*SECONDS,)])
@pytest.mark.parametrize("seed", range(3))
def test_a_faster_part_makes_no_other_slower(seed: int, parts: tuple[str, ...]) -> None:
    rng = np.random.default_rng(seed)
    before, after = (
        relative_speed(times(rng, 0.05, *parts, **{EXPERIMENT: factor})) for factor in (1.0, 0.3)
    )
    found = {(one.robot, one.part): one.verdict for one in compare_speed(before, after)}
    if len(parts) == 2:
        assert set(found) == {(robot, part) for robot in ROBOTS for part in parts}
        assert set(found.values()) == {"undecided"}
        return
    assert {key: word for key, word in found.items() if word != "same"} == {
        (robot, EXPERIMENT): "faster" for robot in (ALL, *ROBOTS)
    }


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("part", [EXPERIMENT, "ols"])
def test_groups_of_several_sizes_are_no_noise(seed: int, part: str) -> None:
    rng = np.random.default_rng(seed)
    few = (EXPERIMENT, "ols", "wls")
    before, after = (
        relative_speed(times(rng, 0.1, *few)),
        relative_speed(times(rng, 0.1, *few, **{part: 2.0})),
    )
    assert max(speed.noise for speed in before.values()) < 0.15
    found = [one for one in compare_speed(before, after) if one.verdict == "slower"]
    assert {one.part for one in found} == {part}
    assert {one.robot for one in found} == {ALL, *ROBOTS}


def test_each_experiment_counts_once_and_an_estimator_of_its_name_is_another_part() -> None:
    names = ("ols", EXPERIMENT)
    heads = {
        f"{name}{repeat}": dict.fromkeys(LABELS, "")
        | {"robot": "ur5", "experiment": f"e{repeat}", "estimator": name, "repeat": repeat}
        for repeat in range(3)
        for name in names
    }
    # Equal times of two experiments, as a coarse clock gives them.
    row = {"seconds_cpu": 0.5, "seconds_experiment_cpu": 2.0}
    rows = [{"id": name, **row} for name in heads]
    assert part_times(rows, heads) == {
        ("ur5", "ols"): [[0.5] * 3],
        ("ur5", f"estimator {EXPERIMENT}"): [[0.5] * 3],
        ("ur5", EXPERIMENT): [[2.0] * 3],
    }


def test_speeds_of_other_cells_are_not_judged() -> None:
    rng = np.random.default_rng(0)
    run = RunValues("s", ("task",), {}, {}, {}, {}, relative_speed(times(rng, 0.05)))
    cell = CellValues("ur5", ("robot",), "ok", ())
    more = {"a": cell, "b": replace(cell, labels=("payload",))}
    slow = relative_speed(times(rng, 0.05, wls=3.0))
    found = find_difference(replace(run, cells=more), replace(run, cells={"a": cell}, speeds=slow))
    judged = {change.robot for change in found.failed_speed}
    assert judged == {ALL, *ROBOTS} - {"ur5"}


@pytest.mark.parametrize("seed", range(3))
def test_a_baseline_holds_ratios_alone_and_a_slower_part_fails(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = {robot: CellValues(robot, (), "ok", (48.0,)) for robot in ROBOTS}
    measured = times(rng, 0.05)
    run = RunValues("s", (), {"rank": METRICS["rank"]}, cells, {}, {}, relative_speed(measured))
    text = to_text(baseline_of(run))
    known = from_text(text, "b.json")
    again = replace(run, speeds=relative_speed(scaled(measured, 9.0)))
    assert to_text(baseline_of(again)) == text
    for key, speed in run.speeds.items():
        assert known.run.speeds[key].ratio == pytest.approx(speed.ratio, rel=1e-2)
    again = replace(run, speeds=relative_speed(times(rng, 0.05)))
    slow = replace(run, speeds=relative_speed(times(rng, 0.05, wls=2.0)))
    assert not find_difference(known.run, again, known.tolerances).is_failed
    found = find_difference(known.run, slow, known.tolerances)
    assert found.is_failed
    assert {change.part for change in found.failed_speed} == {"wls"}
    one = {**measured, **scaled({("ur5", "ols"): measured["ur5", "ols"]}, 3.0)}
    lines = to_text(baseline_of(replace(run, speeds=relative_speed(one)))).splitlines()
    differing = [
        n for n, pair in enumerate(zip(text.splitlines(), lines, strict=True)) if pair[0] != pair[1]
    ]
    block = lines.index('  "ur5": {')
    assert differing
    assert all(n > block for n in differing)


@pytest.mark.parametrize("seed", range(6))
def test_ratios_and_noise_are_those_of_their_definition(seed: int) -> None:
    """Load adds exponential times, of which the least deviates by (n - 1) / (n sqrt 2) of the RMS
    gap to the second; the typical gap of the run counts as four groups of each part."""
    rng = np.random.default_rng(seed)
    measured = {
        ("ur5", part): np.exp(rng.normal(size=(rng.integers(1, 5), 4)) * spread).tolist()
        for part, spread in zip(SECONDS, (0.3, 0.02, 0.5, 0.1), strict=True)
    }
    logs = {key: np.sort(np.log(groups), axis=1) for key, groups in measured.items()}
    gaps = {key: table[:, 1] - table[:, 0] for key, table in logs.items()}
    typical = np.sqrt(2) / np.log(2) * np.median(np.concatenate([*gaps.values()]))
    middle = np.mean([table[:, 0].mean() for table in logs.values()])
    found = relative_speed(measured)
    for key, speed in found.items():
        groups = len(gaps[key])
        square = (4 * typical**2 + np.sum(gaps[key] ** 2)) / (4 + groups)
        assert speed.ratio == pytest.approx(np.exp(logs[key][:, 0].mean() - middle))
        assert speed.noise == pytest.approx(3 / 4 * np.sqrt(square / 2 / groups))
        assert speed.count == 4 * groups
    faster = {key: replace(speed, ratio=speed.ratio / 7.0) for key, speed in found.items()}
    for one in compare_speed(faster, found):
        others = [found[key].noise for key in found if key[1] != one.part]
        error = np.hypot(np.sqrt(2) * found["ur5", one.part].noise,
                         np.sqrt(2 * np.sum(np.square(others))) / 3)  # fmt: skip
        if one.robot != ALL:
            assert one.noise == pytest.approx(error)
            assert one.factor == pytest.approx(1.0)


@pytest.mark.parametrize("slower", [True, False])
def test_a_change_at_its_limit_is_none(slower: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A factor of two against a limit of two, and noise that hides just that factor."""
    monkeypatch.setattr(speeds, "LIMIT", 2.0)

    def verdict(ratio: float, noise: float) -> str:
        before = {("ur5", part): Speed(1.0, 0.0, 9) for part in ("ols", "wls", "lmi")}
        after = {**before, ("ur5", "ols"): Speed(ratio, noise, 9)}
        found = compare_speed(before, after)
        return next(one.verdict for one in found if (one.robot, one.part) == ("ur5", "ols"))

    limit = 2.0 if slower else 0.5
    assert verdict(limit, 0.0) == "same"
    beyond = float(np.nextafter(limit, 4.0 if slower else 0.0))
    assert math.log(beyond) != math.log(limit)
    assert verdict(beyond, 0.0) == ("slower" if slower else "faster")
    noise = math.log(2.0) / SIGMAS
    assert verdict(1.0, noise) == "same"
    assert verdict(1.0, float(np.nextafter(noise, 1.0))) == "undecided"


def test_groups_of_fewer_than_three_have_no_speed() -> None:
    assert relative_speed({}) == {}
    assert relative_speed({("ur5", "ols"): [[1.0, 2.0]], ("ur5", "wls"): [[0.0, 1.0, 2.0]]}) == {}
    assert len(relative_speed({("ur5", "ols"): [[1.0, 1.0, 1.0]]})) == 1
