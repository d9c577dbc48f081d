"""Diagnosis of recorded commands: what the fit of actuators says of their time."""

from collections.abc import Sequence

from sysid_bench.apps.actuators.drive_estimate import identify_drives
from sysid_bench.apps.actuators.drive_rows import drive_rows
from sysid_bench.diagnosis.finding import WARNING, Finding
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log


def command_delay(robot: RobotModel, log: Log, findings: Sequence[Finding]) -> list[Finding]:
    """Return a finding where a delay below zero fits the commands of a position controller better;
    none behind contradictions, which a fit would inherit."""
    if log.commands is None or log.commands.delay is not None:
        return []
    if any(one.is_error for one in findings):
        return []
    profile = identify_drives(drive_rows(robot, log, log.joints)).profile
    if profile is None or not profile.ahead:
        return []
    return [
        Finding(
            name="delay",
            severity=WARNING,
            message="commands act before they are stamped: a delay below zero fits better",
            joints=log.joints,
            blind="a delay of the drive that is longer than the stamps are late",
            edit="check when the controller stores q_des, and shift its column by a sample",
        )
    ]
