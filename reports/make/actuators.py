"""Table of rollout errors of recorded legs, which `python -m reports.make.actuators` prints.

The folder of the recordings is that of the variable SYSID_BENCH_DATA.
The fit sees the first 60 % of a recording; the rest, less 60 samples, is simulated under the
recorded commands from the recorded state: RMS error over samples and joints, mrad. Beside it the
values of the model file, published values, and least squares as published for these recordings.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.delay_profile import RESOLVED
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, drive_rows
from sysid_bench.apps.actuators.rollout import Drives, rollout_error, test_end
from sysid_bench.evaluation.intervals import left_out_held
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.types import Array

RUNS: Final = {("go2", run): v for run, v in enumerate((4.10, 3.78, 3.72, 3.47, 3.47, 3.30))} | {
    ("aliengo", 0): 6.57
}
"""mrad, figures to compare with: least squares with an offset, without held commands."""

FITTED: Final = 0.6
NORMAL: Final = 1.96


def recording(folder: Path, run: int, robot: RobotModel) -> Log:
    """The log of one run."""
    with np.load(folder / f"run_{run}.npz") as found:
        data = {name: np.asarray(found[name], dtype=float) for name in ("q", "v", "q_des")}
        joints, gains = found["joints"].tolist(), {k: found[k].tolist() for k in ("kp", "kd")}
    controller = {"q_des": "q_des", "delay": "profile", **gains}
    keys = {"joints": joints, "rate": 200.0, "tau": {"pd": controller}}
    return read_log(log_of(data, keys), robot)


def scored(robot: RobotModel, log: Log, drives: Drives) -> float:
    """Rollout error (mrad) on the samples that no fit saw."""
    assert log.commands is not None
    count = len(log.commands)
    errors = rollout_error(robot, drives, log.commands, slice(int(FITTED * count), test_end(count)))
    return 1e3 * float(np.sqrt(np.mean(errors**2)))


def fitted(robot: RobotModel, log: Log, delays: Array | None = None) -> DriveEstimate:
    """The actuators from the first part of a log."""
    part = slice(0, int(FITTED * len(log.recording)))
    return identify_drives(drive_rows(robot, log, log.joints, part), delays=delays)


def of_model(robot: RobotModel, log: Log) -> Drives:
    """The values of the model file, without delay."""
    terms, dofs = robot.joint_terms, [robot.rows.index(name) for name in log.joints]
    columns = [terms.armature, terms.viscous, terms.coulomb, 0.0 * terms.coulomb]
    return Drives(log.joints, np.stack([x[dofs] for x in columns], axis=1), 0.0)


def rows(data: Path) -> Iterator[dict[str, Any]]:
    """One row for each recording, with its fit."""
    for (name, run), published in RUNS.items():
        robot = load_robot(data / name / f"{name}.xml")
        log = recording(data / name, run, robot)
        start = time.process_time()
        found = fitted(robot, log)
        seconds = time.process_time() - start
        whole = fitted(robot, log, np.arange(5) / log.recording.rate)
        yield {
            "recording": f"{name} {run}", "robot": robot, "log": log, "found": found,
            "cpu": seconds, "ours": scored(robot, log, found.drives),
            "whole": scored(robot, log, whole.drives), "least squares": published,
            "model file": scored(robot, log, of_model(robot, log)),
        }  # fmt: skip


def main() -> None:
    """Print the table, then the scatter between files."""
    found = list(rows(Path(os.environ["SYSID_BENCH_DATA"])))
    print("recording   ours  whole  least sq.  model file  CPU s  delay ms  open ms  on bound")
    for row in found:
        fit = row["found"]
        mark = "confounded" if fit.separation.open > RESOLVED else ""
        print(
            f"{row['recording']:10} {row['ours']:5.2f}  {row['whole']:5.2f}  "
            f"{row['least squares']:9.2f}  {row['model file']:10.2f}  {row['cpu']:5.2f}  "
            f"{1e3 * fit.delay:8.1f}  {1e3 * fit.separation.open:7.1f}  "
            f"{int(fit.fit.at_bound.sum()):8d}  {mark}"
        )
    legs = [row for row in found if row["recording"].startswith(found[0]["recording"][:3])]
    _print_exchange(legs)
    _print_scatter(legs)


def _print_exchange(legs: list[dict[str, Any]]) -> None:
    """Print the errors of the values of one run on the others, over those of their own."""
    ratios = [
        scored(other["robot"], other["log"], one["found"].drives) / other["ours"]
        for one in legs
        for other in legs
        if one is not other
    ]
    print(
        f"values of one run on another: {np.median(ratios):.2f} x its own error (median), "
        f"{max(ratios):.2f} x (worst)"
    )


def _print_scatter(legs: list[dict[str, Any]]) -> None:
    """Print deviations between files and leave-one-run-out coverage, of values off their bound."""
    values = np.array([row["found"].fit.values for row in legs])
    std = np.array([row["found"].fit.std for row in legs])
    bound = np.array([row["found"].fit.at_bound for row in legs])
    free = np.logical_not(bound.any(axis=0))
    for i, term in enumerate(UNKNOWNS):
        used = free[:, i]
        if not used.any():
            print(f"{term:7} on its bound in a run for all joints")
            continue
        of_term, own = values[:, used, i], std[:, used, i]
        mean = of_term.mean(axis=0)
        textbook = np.mean(np.abs(of_term - mean) <= NORMAL * own)
        print(
            f"{term:7} {int(used.sum())} joints: between runs / residuals "
            f"{np.median(of_term.std(axis=0, ddof=1) / own.mean(axis=0)):.1f}; left-out run held "
            f"by 95 % {100 * left_out_held(of_term).mean():.0f} %, by 90 % "
            f"{100 * left_out_held(of_term, 0.9).mean():.0f} %; mean held by residuals' 95 % "
            f"{100 * textbook:.0f} %"
        )


if __name__ == "__main__":
    main()
