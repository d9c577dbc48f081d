"""Laws of rankings: every case counts once, a failure never wins, no robot is worth more."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.reporting.performance_profile import profile, profile_svg
from sysid_bench.reporting.ranking import NEAR, RATIOS, Ranking, rank_cells

METHODS = {"poor": 3.0, "good": 1.0, "middling": 1.5, "failing": 0.5}


def fabricate(robots: int = 14, seed: int = 0, swap: str = "") -> pd.DataFrame:
    """Errors of a size of each robot, times what a method is worth, times luck; "failing" fails on
    every other robot. On the plant `swap` the good one is as bad as the poor one is."""
    rng, rows = np.random.default_rng(seed), []
    for robot in range(robots):
        for plant in ("matched", "stribeck"):
            for payload in ("none", "box-2kg"):
                size = 10.0 ** rng.uniform(-4, 0)
                for method, worth in METHODS.items():
                    failed = method == "failing" and robot % 2 == 0
                    if plant == swap and method in ("poor", "good"):
                        worth = 4.0 - worth
                    error = size * worth * rng.lognormal(0, 0.1)
                    rows.append(
                        {
                            "robot": f"r{robot}", "payload": payload, "plant": plant,
                            "excitation": "fourier", "repeat": 0, "estimator": method,
                            "status": "failed" if failed else "ok",
                            "torque_error": None if failed else error,
                        }
                    )  # fmt: skip
    return pd.DataFrame(rows)


def ranked(cells: pd.DataFrame, **spec: Any) -> list[Ranking]:
    return list(rank_cells(cells, {"name": "r", "metric": "torque_error", **spec}))


def test_the_better_stands_first_and_the_interval_holds_its_mean() -> None:
    [ranking] = ranked(fabricate())
    assert ranking.methods == ("good", "middling", "poor", "failing")
    assert (ranking.low <= ranking.mean).all()
    assert (ranking.mean <= ranking.high).all()
    assert ranking.p[0, 2] < 0.01
    np.testing.assert_allclose(ranking.wins + ranking.wins.T, 1.0)


def test_plants_are_ranked_apart() -> None:
    cells = fabricate(swap="stribeck")
    first = {r.name: r.methods[0] for r in ranked(cells, apart=["plant"])}
    assert first == {"r-matched": "good", "r-stribeck": "poor"}


def test_neither_the_unit_nor_the_order_of_cells_matters() -> None:
    cells = fabricate()
    [one] = ranked(cells)
    scale = cells["robot"].map({name: 10.0**i for i, name in enumerate(cells["robot"].unique())})
    other = cells.assign(torque_error=cells["torque_error"].astype(float) * scale)
    [two] = ranked(other.sample(frac=1, random_state=1))
    assert one.methods == two.methods
    np.testing.assert_allclose(np.sort(one.mean), np.sort(two.mean))
    np.testing.assert_allclose(one.p, two.p)


def test_a_failure_is_counted_and_never_near_the_best() -> None:
    [ranking] = ranked(fabricate())
    table = ranking.summary_table
    share = table.entries[("failing",), ("failed",)].value
    assert share == pytest.approx(0.5)
    near = table.entries[("failing",), (f"within {NEAR:g}",)].value
    assert near is not None
    assert near <= 0.5
    assert ranking.profile[-1, ranking.methods.index("failing")] == pytest.approx(0.5)


def test_profiles_rise_from_the_share_of_wins() -> None:
    [ranking] = ranked(fabricate())
    shares = ranking.profile
    assert shares.shape == (len(RATIOS), 4)
    assert (np.diff(shares, axis=0) >= 0).all()
    assert shares[0].sum() >= 1.0  # somebody is best in every case


def test_a_method_named_beforehand_needs_fewer_robots_to_be_reported_from() -> None:
    [ranking] = ranked(fabricate(robots=8), against="poor")
    best = ranking.methods.index("good")
    assert ranking.p_against[best] < ranking.p[best, ranking.methods.index("poor")]
    entry = ranking.summary_table.entries[("poor",), ("p",)]
    assert entry.value is None
    with pytest.raises(UsageError, match="good"):
        ranked(fabricate(robots=2), against="gud")


def test_cases_that_some_method_never_saw_are_left_out_and_reported() -> None:
    cells = fabricate()
    lost = (cells["estimator"] == "poor") & (cells["robot"] == "r0")
    [ranking] = ranked(cells[~lost])
    assert ranking.left_out == 4
    assert any("4 more are left out" in note for note in ranking.summary_table.notes)
    with pytest.raises(UsageError, match="no case"):
        ranked(cells[cells["estimator"] == "poor"])


def test_a_profile_is_the_same_picture_every_time(tmp_path: Path) -> None:
    [ranking] = ranked(fabricate(robots=3))
    one, two = (profile(ranking, tmp_path / f"{i}.pdf").read_bytes() for i in range(2))
    assert one == two
    assert profile_svg(ranking).startswith("<svg")
    with pytest.raises(UsageError, match=r"\.pdf or \.svg"):
        profile(ranking, tmp_path / "profile.png")
