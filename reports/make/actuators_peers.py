"""Peers at equal CPU time on recorded robots, as Markdown: `python -m reports.make.actuators_peers
[--budget 20] [RECORDING...]`.

Parameters, split, simulation and score are those of `python -m reports.make.actuators`; delay, and
of servos the gain, are those of the linear fit, which peers are given. They start from the values
of the model file. A peer that is not installed is left out with its reason. Recordings are named as
"go2:0" and "so101:multisine". Answers at the end of a CPU time depend on the clock.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from reports.make.actuators import FITTED, RUNS, recording
from reports.make.actuators_ranges import MOTIONS, servo_log
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_rows import drive_rows, model_values
from sysid_bench.apps.actuators.rollout import (
    Drives,
    SimulatedPart,
    rollout_error,
    test_end,
)
from sysid_bench.apps.peers.optimisers import CmaEs, MujocoSysid
from sysid_bench.errors import SimulationError, UnsupportedError
from sysid_bench.identification.optimisers import Optimiser
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.position_control import Commands

PEERS: Final[dict[str, Optimiser]] = {"mujoco.sysid": MujocoSysid(), "cma-es": CmaEs(sigma=1.0)}
SETS: Final = [f"{name}:{run}" for name, run in RUNS] + [f"so101:{motion}" for motion in MOTIONS]


@dataclass(frozen=True)
class Recorded:
    """A recording with the linear fit of its first part, and what it took (CPU s)."""

    robot: RobotModel
    log: Log
    found: DriveEstimate
    seconds: float

    @property
    def commands(self) -> Commands:
        """Values of the joints at the gain that was found."""
        assert self.log.commands is not None
        gain = {k: x for k, x in self.found.drives.more.items() if k == "gain"}
        return replace(self.found.drives, more=gain).apply(self.log.commands)

    def error(self, drives: Drives, commands: Commands) -> float:
        """Rollout error (mrad) on the samples that no fit saw; infinite where it diverges."""
        first, end = int(FITTED * len(commands)), test_end(len(commands))
        try:
            errors = rollout_error(self.robot, drives, commands, slice(first, end))
        except SimulationError:
            return np.inf
        return 1e3 * float(np.sqrt(np.mean(errors**2)))


def main() -> None:
    """Print a line for each recording and method, as soon as it is there."""
    data = Path(os.environ["SYSID_BENCH_DATA"])
    parser = argparse.ArgumentParser()
    parser.add_argument("--budget", type=int, default=20, help="s of CPU time")
    parser.add_argument("recordings", nargs="*", default=SETS)
    options = parser.parse_args()
    print("| recording | method | mrad | CPU s | simulations | values on a bound |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    with TemporaryDirectory() as folder:
        for text in options.recordings:
            for line in _lines(_read(data, Path(folder), text), options.budget):
                print(f"| {text} | {line} |", flush=True)


def _read(data: Path, folder: Path, text: str) -> Recorded:
    name, _, part = text.partition(":")
    if name == "so101":
        model = data / "robots" / "robotstudio_so101__so101.xml"
        robot = load_robot(model)
        log = read_log(read_description(servo_log(data, folder, model, part)), robot)
    else:
        robot = load_robot(data / name / f"{name}.xml")
        log = recording(data / name, int(part), robot)
    began = time.process_time()
    rows = slice(0, int(FITTED * len(log.recording)))
    more = ("gain",) if name == "so101" else ()
    found = identify_drives(drive_rows(robot, log, log.joints, rows, more))
    return Recorded(robot, log, found, time.process_time() - began)


def _lines(one: Recorded, budget: int) -> Iterator[str]:
    commands, found, whole = one.commands, one.found, one.log.commands
    assert whole is not None
    bound = int(found.fit.at_bound.sum())
    own = Drives(one.log.joints, found.fit.values, found.delay)
    yield f"linear fit | {one.error(own, commands):.2f} | {one.seconds:.2f} | 0 | {bound}"
    rows = slice(int(FITTED * len(whole)), test_end(len(whole)))
    error = 1e3 * float(np.sqrt(np.mean((whole.q_des - whole.q)[rows] ** 2)))
    yield f"position = command | {error:.2f} | - | - | -"
    start = Drives(one.log.joints, model_values(one.robot, one.log.joints), found.delay)
    yield f"model file, stated gains | {one.error(start, whole):.2f} | - | - | -"
    if found.gains:
        yield f"model file, gain of the fit | {one.error(start, commands):.2f} | - | - | -"
    section = SimulatedPart(one.robot, commands, slice(0, int(FITTED * len(commands))))
    for name, peer in PEERS.items():
        began = time.process_time()
        try:
            best = section.fit(peer, start, f"{budget} s")
        except UnsupportedError as reason:
            yield f"{name} | {reason} | - | - | -"
            continue
        spent, optimum = time.process_time() - began, best.optimum
        yield (
            f"{name} | {one.error(best.drives, commands):.2f} | {spent:.1f} | "
            f"{optimum.simulations} | {int(best.at_bound.sum())}"
        )


if __name__ == "__main__":
    main()
