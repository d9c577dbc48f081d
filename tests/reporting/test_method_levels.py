"""Laws of effect sizes by level: what all robots share is kept, what is chance is not."""

import numpy as np
import pandas as pd
import pytest

from reports.make.method_levels import effect_lines, kept_signs, mean_logs

METHODS = {"wls": 1.0, "good": 0.7, "poor": 2.0, "alike": 1.0}


def logs(robots: int, seed: int, scatter: float, worth: bool = True) -> pd.DataFrame:
    """Mean log errors of methods that differ by their worth, or by chance alone."""
    rng = np.random.default_rng(seed)
    centre = np.log([size if worth else 1.0 for size in METHODS.values()])
    values = rng.normal(size=(robots, 1)) + centre + rng.normal(0, scatter, (robots, len(METHODS)))
    return pd.DataFrame(values, [f"r{k}" for k in range(robots)], list(METHODS))


@pytest.mark.parametrize("seed", range(4))
def test_common_differences_are_kept_and_chance_is_not(seed: int) -> None:
    level, recorded = logs(8, seed, 0.02), logs(12, seed + 9, 0.02)
    kept, count = kept_signs([level], recorded)
    assert kept == count == 5 * 12  # of six pairs, wls and alike are not apart
    chance = [logs(8, seed, 0.4, worth=False)]
    kept, count = kept_signs(chance, logs(12, seed + 9, 1.0, worth=False))
    assert count == 0 or kept / count < 0.95
    # A predictor of the other sign decides nothing.
    assert kept_signs([-level], recorded) == (0, 0)


def test_a_left_out_robot_is_no_witness_of_itself() -> None:
    """One robot that alone makes the median differ is judged by the others."""
    recorded = logs(3, 1, 0.0)
    recorded["poor"] = recorded["wls"] + [3.0, 0.0, 0.0]
    level = logs(8, 1, 0.0)
    two = ["poor", "wls"]
    assert kept_signs([level[two]], recorded[two]) == (0, 0)


@pytest.mark.parametrize("seed", range(3))
def test_ratios_are_those_of_robots_means(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [
        {"robot": f"r{k}", "repeat": n, "estimator": m, "status": "ok", "torque_error": e}
        for k in range(7)
        for n in range(3)
        for m, e in zip(METHODS, rng.uniform(0.1, 1.0, 4), strict=True)
    ]
    found = mean_logs(pd.DataFrame(rows))
    assert found.shape == (7, 4)
    of = [row for row in rows if (row["robot"], row["estimator"]) == ("r2", "good")]
    own = np.mean([np.log(float(row["torque_error"])) for row in of])
    assert found.loc["r2", "good"] == pytest.approx(own)
    lines = effect_lines({"L1": found, "recorded": found[["wls", "poor"]]})
    assert lines[0] == "| method | L1 (7 robots) | recorded (7 robots) |"
    [wls] = [line for line in lines if line.startswith("| wls |")]
    assert "1.00 [1.00, 1.00]" in wls
    [good] = [line for line in lines if line.startswith("| good |")]
    ratio = np.exp(np.median(found["good"] - found["wls"]))
    assert f"| {ratio:.2f} [" in good
    assert good.endswith("| - |")
