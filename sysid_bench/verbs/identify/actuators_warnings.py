"""Warnings of an identification of actuators."""

from collections.abc import Sequence

from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.position_control import DELAY
from sysid_bench.verbs.identify.actuators_errors import DriveErrors


def base_warnings(robot: RobotModel, log: LogDescription) -> list[str]:
    """Sentence about a floating base, with or without its recorded motion."""
    if log.base is not None:
        return ["the base moves as recorded: feet must not touch the ground"]
    if not robot.floating:
        return []
    return ["the base is held fixed: feet must not touch the ground, and the trunk must not move"]


def rollout_warnings(judged: DriveErrors) -> list[str]:
    """Sentence about a robot whose values are not judged by a simulation."""
    return [f"no rollout: {judged.reason}"] if judged.reason else []


def delay_warnings(found: DriveEstimate) -> list[str]:
    """Sentence about a delay at the end of those that were tried."""
    if found.profile is None:
        return []
    if found.profile.ahead:
        return [
            "a delay below zero would fit better: q_des is stamped later than it acts; check its "
            "times"
        ]
    if not found.profile.on_edge:
        return []
    return [
        f"the delay is the longest that was tried, {1e3 * found.delay:.3g} ms: check the times of "
        "q_des, or state a delay"
    ]


def log_findings(parts: Sequence[DrivePart]) -> list[str]:
    """Repairs of the model, and findings in the recordings, but for the delay that is found."""
    found = [
        f"{part.name}: {one.text}"
        for part in parts
        for one in part.log.findings
        if one.name != DELAY
    ]
    return list(dict.fromkeys([*parts[0].robot.repairs, *found]))
