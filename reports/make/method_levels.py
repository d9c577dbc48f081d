"""Effect sizes of methods by level, and what of them recordings keep.

    python -m reports.make.method_levels LEVELS [RECORDED]

LEVELS is a run of the suite `method-levels`, RECORDED one of `real` with robots whose torque was
measured (`--select 'task == "robot" and excitation == "training motions" and robot != "so101"'`:
the torque of that one is the law of its servos). Prints, as Markdown:

1. the error of each method over that of wls at each level and on recorded robots (median over
   robots of the difference of their mean log errors);
2. the pairs of methods that L3 and the recordings put more than 10 % apart in the same direction,
   found without one recorded robot each, and the share whose sign that robot keeps; the same for
   pairs that single levels put apart.
"""

import sys
from collections.abc import Mapping
from itertools import combinations
from typing import Any, Final

import numpy as np
import pandas as pd

from sysid_bench.evaluation.intervals import share_interval
from sysid_bench.evaluation.robot_statistic import median_figure
from sysid_bench.reporting.selection import label

REFERENCE: Final = "wls"
RECORDED: Final = "recorded"
APART: Final = float(np.log(1.1))
"""Log ratio from which on two methods differ."""

Logs = Mapping[str, pd.DataFrame]
"""Level -> mean log error (robots x methods)."""


def mean_logs(cells: pd.DataFrame) -> pd.DataFrame:
    """Mean log torque error of each robot (rows) and method (columns) over the draws that it
    answered, NaN where it has no answer."""
    of = cells[(cells["status"] == "ok") & (cells["torque_error"] > 0)]
    named = pd.DataFrame({
        "robot": of["robot"].map(label), "method": of["estimator"].map(label),
        "draw": of["repeat"], "log": np.log(of["torque_error"].astype(float)),
    })  # fmt: skip
    table = named.pivot_table(index=["robot", "draw"], columns="method", values="log")
    return table.groupby("robot").mean()


def effect_lines(logs: Logs) -> list[str]:
    """Table of ratios to the reference by method and level."""
    methods = list(dict.fromkeys(name for one in logs.values() for name in one.columns))
    counts = (f"{level} ({len(one)} robots)" for level, one in logs.items())
    lines = [f"| method | {' | '.join(counts)} |", f"| --- |{' ---: |' * len(logs)}"]
    for method in methods:
        cells = []
        for one in logs.values():
            known = np.zeros(0)
            if method in one:
                known = (one[method] - one[REFERENCE]).dropna().to_numpy(float)
            if len(known) == 0:
                cells.append("-")
                continue
            figure = median_figure(known)
            ends = [np.exp(end) for end in (figure.low, figure.high) if end is not None]
            text = f" [{ends[0]:.2f}, {ends[1]:.2f}]" if ends else ""
            cells.append(f"{np.exp(figure.value):.2f}{text}")
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines


def kept_signs(predictors: list[pd.DataFrame], recorded: pd.DataFrame) -> tuple[int, int]:
    """Pairs and robots left out: how many differences of a left-out robot have the sign that the
    predictors and the other recorded robots agree on, and of how many.

    A pair counts where all predictors and the median of the other recorded robots put it more than
    10 % apart in one direction; a left-out robot on which the two methods are within 1 % has no
    sign.
    """
    methods = sorted(set(recorded.columns).intersection(*(one.columns for one in predictors)))
    kept = count = 0
    for a, b in combinations(methods, 2):
        each = (recorded[a] - recorded[b]).dropna()
        fixed = [float((one[a] - one[b]).median()) for one in predictors]
        for robot, own in each.items():
            said = np.array([*fixed, float(each.drop(robot).median())])
            if abs(own) <= np.log(1.01) or np.isnan(said).any():
                continue
            if (said > APART).all() or (said < -APART).all():
                kept, count = kept + int(own * said[0] > 0), count + 1
    return kept, count


def sign_lines(levels: Logs, recorded: pd.DataFrame) -> list[str]:
    """Table of kept signs, of L3 and the recordings together and of single levels alone."""
    lines = ["| pairs put apart by | signs kept on robots left out | 95 % interval |"]
    lines.append("| --- | ---: | --- |")
    alone = {f"{level} and recordings": [one] for level, one in levels.items()}
    for name, predictors in {**alone, "recordings alone": []}.items():
        kept, count = kept_signs(predictors or [recorded], recorded)
        if count == 0:
            lines.append(f"| {name} | no pair | - |")
            continue
        low, high = share_interval(kept, count)
        share = f"{kept} of {count} ({kept / count:.0%})"
        lines.append(f"| {name} | {share} | {low:.0%} to {high:.0%} |")
    return lines


def main(folders: list[str]) -> str:
    """The tables of runs."""
    import sysid_bench

    frames: list[Any] = [sysid_bench.open_run(folder).cells for folder in folders]
    levels = frames[0]
    if "pipeline" in levels:
        levels = levels[levels["pipeline"].map(label) == "parallel"]
    plants = levels["plant"].map(label)
    logs = {name: mean_logs(levels[plants == name]) for name in sorted(plants.unique())}
    parts = []
    if len(frames) > 1:
        of = frames[1]
        whole = (of["excitation"].map(label) == "training motions") & (of["task"] == "robot")
        logs[RECORDED] = mean_logs(of[whole & (of["pipeline"].map(label) != "plain")])
        simulated = {name: one for name, one in logs.items() if name != RECORDED}
        parts = ["", *sign_lines(simulated, logs[RECORDED])]
    return "\n".join([*effect_lines(logs), *parts])


if __name__ == "__main__":
    print(main(sys.argv[1:]))
