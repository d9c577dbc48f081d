"""Table of rollout errors of recorded legs, which `python -m reports.make.actuators` prints.

The folder of the recordings is that of the variable SYSID_BENCH_DATA.
The fit sees the first 60 % of a recording; the rest, less 60 samples, is simulated under the
recorded commands from the recorded state: RMS error over samples and joints, mrad. Beside it the
values of the model file, published values, and least squares as published for these recordings.
"""

import os
import time
from pathlib import Path
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_rows import drive_rows
from sysid_bench.apps.actuators.rollout import Drives, rollout_error, test_end
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


def main() -> None:
    """Print a row for each recording."""
    data = Path(os.environ["SYSID_BENCH_DATA"])
    print("| recording | linear fit | whole samples | least squares | model file | CPU s "
          "| delay, ms | open by, ms | values on a bound |")  # fmt: skip
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for (name, run), published in RUNS.items():
        robot = load_robot(data / name / f"{name}.xml")
        log = recording(data / name, run, robot)
        start = time.process_time()
        fit = fitted(robot, log)
        seconds = time.process_time() - start
        whole = fitted(robot, log, np.arange(5) / log.recording.rate)
        ours, same, model = (
            scored(robot, log, drives)
            for drives in (fit.drives, whole.drives, of_model(robot, log))
        )
        assert fit.separation is not None
        print(
            f"| {name} {run} | {ours:.2f} | {same:.2f} | {published:.2f} | {model:.2f} | "
            f"{seconds:.2f} | {1e3 * fit.delay:.1f} | {1e3 * fit.separation.open:.1f} | "
            f"{int(fit.fit.at_bound.sum())} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
