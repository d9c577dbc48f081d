"""Peers at equal CPU time on recorded legs: `python -m reports.make.actuators_peers
[--budgets 1,10] [RUN...]`.

Parameters, split, simulation and score are those of `python -m reports.make.actuators`, the
delay is that of the linear fit. Peers start from the values of the model file with that delay
("delayed"); those that are "warm" start from the linear fit. A peer that is not installed is left
out with its reason. Recordings are named as "go2:0". Answers at the end of a CPU time depend on the
clock. Values on a bound are named below each line.
"""

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from reports.make.actuators import FITTED, RUNS, fitted, of_model, recording, scored
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.apps.actuators.rollout import Drives, SimulatedPart
from sysid_bench.apps.peers.optimisers import CmaEs, MujocoSysid
from sysid_bench.errors import UnsupportedError
from sysid_bench.identification.optimisers import LeastSquares, Optimiser
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log
from sysid_bench.types import Array

BUDGETS: Final = (1, 10, 60)
PEERS: Final[dict[str, Optimiser]] = {
    "scipy": LeastSquares(),
    "mujoco.sysid": MujocoSysid(),
    "cma-es": CmaEs(sigma=1.0),
}


def main() -> None:
    """Print a line for each recording, method and budget, as soon as it is there."""
    data = Path(os.environ["SYSID_BENCH_DATA"])
    parser = argparse.ArgumentParser()
    parser.add_argument("--budgets", default=",".join(map(str, BUDGETS)), help="s of CPU time")
    parser.add_argument("runs", nargs="*", default=[f"{name}:{run}" for name, run in RUNS])
    options = parser.parse_args()
    budgets = [int(text) for text in options.budgets.split(",")]
    print("recording   method          start   budget   mrad   CPU s  simulations  on bound  stop")
    for name, run in (text.split(":") for text in options.runs):
        robot = load_robot(data / name / f"{name}.xml")
        log = recording(data / name, int(run), robot)
        began = time.process_time()
        found = fitted(robot, log)
        seconds = time.process_time() - began
        bound = _bound_names(found.drives.joints, found.fit.at_bound)
        _line(
            f"{name}:{run}",
            "linear fit",
            "",
            "",
            (scored(robot, log, found.drives), seconds, 0, bound),
        )
        model = of_model(robot, log)
        cold = Drives(model.joints, model.values, found.delay)
        for text, drives in (("", model), ("delayed", cold)):
            error = scored(robot, log, drives)
            _line(f"{name}:{run}", "model file", text, "", (error, 0.0, 0, []))
        for budget in budgets:
            for peer in PEERS:
                _peer(robot, log, (f"{name}:{run}", peer, "file", budget), cold)
        _peer(robot, log, (f"{name}:{run}", "mujoco.sysid", "warm", budgets[-1]), found.drives)


def _peer(robot: RobotModel, log: Log, named: tuple[str, str, str, int], start: Drives) -> None:
    """Print the line of a peer, or why there is none."""
    text, peer, kind, budget = named
    assert log.commands is not None
    section = SimulatedPart(robot, log.commands, slice(0, int(FITTED * len(log.commands))))
    began = time.process_time()
    try:
        found = section.fit(PEERS[peer], start, f"{budget} s")
    except UnsupportedError as reason:
        print(f"{text:10}  {peer:14}  {reason}", flush=True)
        return
    seconds, best = time.process_time() - began, found.optimum
    figures = (
        scored(robot, log, found.drives),
        seconds,
        best.simulations,
        _bound_names(start.joints, found.at_bound),
    )
    _line(text, peer, kind, f"{budget} s", figures, best.stop.reason)


def _bound_names(joints: Sequence[str], at_bound: Array) -> list[str]:
    return [f"{joints[j]}.{UNKNOWNS[i]}" for j, i in np.argwhere(at_bound)]


def _line(
    text: str, method: str, start: str, budget: str, figures: tuple[float, float, int, list[str]],
    stop: str = "",
) -> None:  # fmt: skip
    mrad, seconds, simulations, bound = figures
    print(
        f"{text:10}  {method:14}  {start:6}  {budget:6}  {mrad:5.2f}  {seconds:6.2f}  "
        f"{simulations:11d}  {len(bound):8d}  {stop}",
        flush=True,
    )
    if bound:
        print(f"    on bound: {', '.join(bound)}", flush=True)


if __name__ == "__main__":
    main()
