"""Laws of what simulations predict of recorded robots: no verdict is carried by one type."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.apps.twins.agreement import VerdictCounts
from sysid_bench.apps.twins.commands import transfer
from sysid_bench.apps.twins.commands.transfer import TransferResult


def counts(false: float, found: float, pairs: int = 20) -> VerdictCounts:
    """Counts of one robot with these shares."""
    numbers = (pairs, round(false * pairs), pairs, round(found * pairs))
    return VerdictCounts(*numbers, misfit=0.05, level=1.0, tau=0.5)


def figures(robots: dict[str, VerdictCounts], types: dict[str, str] | None = None) -> Any:
    """Figures of one source, each robot its own type unless `types` says otherwise."""
    return transfer._of_robots(robots, {name: (types or {}).get(name, name) for name in robots})


def verdict(by_source: dict[str, VerdictCounts], types: dict[str, str] | None = None) -> str:
    found = {"L1, wls": figures(by_source, types)}
    result = TransferResult([], [], ["wls"], 1, {}, {}, {"all": found}, {}, 0.0)
    [text] = result._verdicts(found)
    return text.removeprefix("L1 ")


GOOD, BAD = counts(0.1, 0.9), counts(0.9, 0.1)


@pytest.mark.parametrize("robots", [4, 9])
def test_robots_that_agree_decide(robots: int) -> None:
    assert verdict({f"r{k}": GOOD for k in range(robots)}) == "reached"
    assert verdict({f"r{k}": BAD for k in range(robots)}) == "missed"


def test_a_verdict_that_one_robot_carries_is_not_decided() -> None:
    """Nor is one of a single robot; robots of one type go together."""
    carried = {f"r{k}": counts(0.1, 0.45) for k in range(4)} | {"strong": counts(0.1, 1.0, 60)}
    assert verdict(carried).startswith("not decided")
    alone = "not decided (one type of robot alone, and none to confirm it)"
    assert verdict({"r0": GOOD}) == alone
    two = {"a": GOOD, "b": GOOD, "c": counts(0.9, 0.9, 7)}
    assert verdict(two) == "not decided (one type of robot more or less changes it)"
    same = {f"r{k}": GOOD for k in range(5)}
    assert verdict(same, dict.fromkeys(same, "ur10e")) == alone


@pytest.mark.parametrize("seed", range(8))
def test_decided_verdicts_stay_without_any_robot(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots = {
        f"r{k}": counts(rng.uniform(0, 0.4), rng.uniform(0.3, 1.0), int(rng.integers(5, 80)))
        for k in range(rng.integers(2, 9))
    }
    word = verdict(robots)
    others = [
        transfer._reaches(figures({name: one for name, one in robots.items() if name != left_out}))
        for left_out in robots
    ]
    whole = transfer._reaches(figures(robots))
    changes = any(one != whole for one in others)
    assert word.startswith("not decided") == changes
    # Every row has the range of both shares without one type, interval or not.
    line = transfer._line("L1, wls", figures(robots))
    assert line.count(" to ") == 2
    found = figures(robots)
    for share in ("false", "found"):
        low, high = found["without_one"][share]
        assert low <= found[share]["value"] + 1e-12
        assert found[share]["value"] <= high + 1e-12


def test_without_real_differences_nothing_is_tested() -> None:
    none = VerdictCounts(3, 1, 0, 0, 0.1, 1.0, 0.2)
    assert verdict({"a": none, "b": none}).startswith("not testable")
