"""Model file with identified actuators, and its simulation by MuJoCo alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.apps.actuators.rollout import simulated_positions
from sysid_bench.apps.actuators.written_model import (
    largest_difference,
    replay_positions,
    written_mjcf,
)
from sysid_bench.commands.result import file_text
from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel

REPEATED: Final = 1e-6
"""rad, m; a written file whose simulated positions differ by more is not the identified robot."""


def write_actuators(target: Path, found: DriveEstimate, judged: DrivePart) -> dict[str, Any]:
    """Write the model, read it again by MuJoCo alone, and repeat the judged simulation.

    Raises UsageError where the torque was measured, so that gains are not known.
    """
    commands = judged.log.commands
    if commands is None:
        raise UsageError(
            "A model with position actuators needs their gains: describe the torque by tau = { pd "
            "= { q_des = ..., kp = ..., kd = ... } }, or use the values of --json-out."
        )
    commands = commands.of(found.rows.joints)
    text = written_mjcf(judged.robot, found.drives, commands)
    target.write_text(text, encoding="utf-8")
    written: dict[str, Any] = {"file": str(target), "gap": None, "reason": _no_replay(judged.robot)}
    if not written["reason"]:
        again = replay_positions(target, found.drives.apply(commands), judged.rows)
        simulated = simulated_positions(judged.robot, found.drives, commands, judged.rows)
        bias = found.drives.more.get("bias", np.zeros(len(commands.joints)))
        written["gap"] = largest_difference(again, simulated + bias)
    return {"model_out": file_text(target), "written": written}


def _no_replay(robot: RobotModel) -> str:
    """Reason for which a written file is not the robot that was simulated; empty if it is."""
    if robot.manifest.locked:
        return "joints are locked"
    if robot.manifest.free_base:
        return "the file may hold the base"
    return "" if robot.payload_body is None else "the file has no payload"


def replay_warnings(written: Mapping[str, Any]) -> list[str]:
    """Sentence about a written file that does not repeat the simulation."""
    gap = written["gap"]
    if gap is None or gap <= REPEATED:
        return []
    return [
        f"{written['file']} does not repeat the simulation: positions differ by up to {gap:.1e} "
        "rad (m); other actuators, tendons or options of the file may act"
    ]
