"""Laws of speeds: a part that becomes slower is named, a machine that does is not."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.comparison.baseline import baseline_of, from_text, to_text
from sysid_bench.comparison.changes import changes_between
from sysid_bench.comparison.run_values import CellValues, RunValues
from sysid_bench.comparison.speeds import ALL, EXPERIMENT, Key, speed_changes, speeds_of
from sysid_bench.metrics import METRICS

ROBOTS, ESTIMATORS = ("scara", "ur5", "panda"), ("ols", "wls", "entropic")
SECONDS = {EXPERIMENT: 0.05, "ols": 0.002, "wls": 0.01, "entropic": 0.3}


def times(rng: np.random.Generator, noise: float, **slower: float) -> dict[Key, list[float]]:
    """Times of a run on a machine of its own speed; `slower`: factors of parts."""
    machine = float(rng.uniform(0.2, 5.0))
    return {
        (robot, part): [
            machine * slower.get(part, 1.0) * seconds * (1 + n) * float(np.exp(noise * draw))
            for draw in rng.normal(size=12)
        ]
        for n, robot in enumerate(ROBOTS)
        for part, seconds in SECONDS.items()
    }


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_a_repeat_on_another_machine_changes_no_speed(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    before, after = (speeds_of(times(rng, noise)) for _ in range(2))
    verdicts = {change.verdict for change in speed_changes(before, after)}
    assert verdicts <= {"same", "undecided"}


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("part", SECONDS)
def test_a_part_that_is_twice_as_slow_is_named_alone(seed: int, part: str) -> None:
    rng = np.random.default_rng(seed)
    before, after = speeds_of(times(rng, 0.1)), speeds_of(times(rng, 0.1, **{part: 2.0}))
    found = [change for change in speed_changes(before, after) if change.verdict == "slower"]
    assert {change.part for change in found} == {part}
    assert found[0].robot == ALL
    assert found[0].factor == pytest.approx(2.0, rel=0.2)
    back = [change for change in speed_changes(after, before) if change.verdict == "faster"]
    assert {change.part for change in back} == {part}


def test_noise_that_hides_a_factor_of_two_is_said() -> None:
    rng = np.random.default_rng(0)
    before, after = (speeds_of(times(rng, 3.0)) for _ in range(2))
    assert {change.verdict for change in speed_changes(before, after)} == {"undecided"}


def test_parts_with_few_times_and_robots_with_one_part_have_no_change() -> None:
    few = speeds_of({("ur5", "ols"): [1.0, 2.0], ("ur5", "wls"): [1.0, 0.0, 2.0]})
    assert not few
    one = speeds_of({("ur5", "ols"): [1.0, 2.0, 3.0]})
    assert len(one) == 1
    assert not speed_changes(one, one)


@pytest.mark.parametrize("seed", range(3))
def test_a_baseline_holds_ratios_alone_and_a_slower_part_fails(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = {robot: CellValues(robot, (), "ok", (48.0,)) for robot in ROBOTS}
    measured = times(rng, 0.05)
    run = RunValues("s", (), {"rank": METRICS["rank"]}, cells, {}, {}, speeds_of(measured))
    text = to_text(baseline_of(run))
    known = from_text(text, "b.json")
    scaled = {key: [9.0 * value for value in values] for key, values in measured.items()}
    assert to_text(baseline_of(replace(run, speeds=speeds_of(scaled)))) == text
    for key, speed in run.speeds.items():
        assert known.run.speeds[key].ratio == pytest.approx(speed.ratio, rel=1e-2)
    again = replace(run, speeds=speeds_of(times(rng, 0.05)))
    slow = replace(run, speeds=speeds_of(times(rng, 0.05, wls=2.0)))
    assert not changes_between(known.run, again, known.tolerances).fails
    found = changes_between(known.run, slow, known.tolerances)
    assert found.fails
    assert {change.part for change in found.slower} == {"wls"}
    one = {**measured, ("ur5", "ols"): [3.0 * value for value in measured["ur5", "ols"]]}
    lines = to_text(baseline_of(replace(run, speeds=speeds_of(one)))).splitlines()
    differing = [
        n for n, pair in enumerate(zip(text.splitlines(), lines, strict=True)) if pair[0] != pair[1]
    ]
    block = lines.index('  "ur5": {')
    assert differing
    assert all(n > block for n in differing)
