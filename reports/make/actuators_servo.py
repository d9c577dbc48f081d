"""A servo arm whose gains are not known, as Markdown: `python -m reports.make.actuators_servo`.

Each pair of four motions is trained, and each of the others tested: rollout errors (mrad) of the
answer with `--also gain`, of "position = command" and of the model file, over all joints; the ratio
counts as 1 where the answer is refused. Lost motion and backlash are those of the wrist's roll.
"""

import os
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sysid_bench
from reports.make.actuators_ranges import MOTIONS, servo_log
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult


def main() -> None:
    """Print a row for each pair and test."""
    data, ratios = Path(os.environ["SYSID_BENCH_DATA"]), []
    model = data / "robots" / "robotstudio_so101__so101.xml"
    print("| trained | tested | answer | command | model file | ratio | gain | lost motion, mrad | "
          "of which backlash |")  # fmt: skip
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    with TemporaryDirectory() as folder:
        logs = {name: servo_log(data, Path(folder), model, name) for name in MOTIONS}
        for pair in combinations(MOTIONS, 2):
            for test in (name for name in MOTIONS if name not in pair):
                result = sysid_bench.identify(
                    model, task="actuators", log=[logs[name] for name in pair], test=[logs[test]],
                    also=["gain"], accept=["worse"],
                )  # fmt: skip
                assert isinstance(result, ActuatorsResult)
                line, ratio = _row(result)
                ratios.append(ratio)
                print(f"| {' and '.join(pair)} | {test} | {line} |", flush=True)
    print(f"\nMedian ratio {np.median(ratios):.2f}, largest {max(ratios):.2f}.")


def _row(result: ActuatorsResult) -> tuple[str, float]:
    scores, (gain,) = result.scores, result.gains or [{}]
    error, command, null = (
        scores[name] for name in ("rollout_error", "rollout_error_command", "rollout_error_null")
    )
    ratio = 1.0 if scores["beaten_by"] else error / command
    lost = (result.lost_motion or {})["wrist_roll"]
    low, high = (1e3 * end for end in lost["backlash"])
    return (
        f"{1e3 * error:.2f} | {1e3 * command:.2f} | {1e3 * null:.2f} | {ratio:.2f} | "
        f"{gain['gain']:.2g} ({gain['low']:.2g} to {gain['high']:.2g}) | "
        f"{1e3 * lost['width']:.1f} | {low:.1f} to {high:.1f}"
    ), ratio


if __name__ == "__main__":
    main()
