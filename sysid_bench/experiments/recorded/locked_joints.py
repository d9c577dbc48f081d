"""Locking of joints that are neither recorded nor driven by recorded ones.

Base parameters and rows are then those of the joints that moved.
"""

from collections.abc import Sequence
from dataclasses import replace

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import NO_JOINT, LogDescription


def locked_manifest(
    manifest: Manifest, robot: RobotModel, logs: Sequence[LogDescription]
) -> Manifest:
    """The manifest with those joints locked that the logs do not list and that depend on none of
    the listed ones.

    Raises UsageError where the logs differ in their joints or in the positions of locked ones.
    """
    first = logs[0]
    scalar = {joint.dofs[0] for joint in robot.joints if joint.kind in ("hinge", "slide")}
    for name in first.joints:
        if name != NO_JOINT and name not in scalar:
            advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
            raise UsageError(f"{first.source}: {unknown_name('joint', name, scalar, advice)}")
    moving = {joint for joint in first.joints if joint != NO_JOINT}
    for log in logs[1:]:
        if {joint for joint in log.joints if joint != NO_JOINT} != moving:
            raise UsageError(
                f"{log.source} lists other joints than {first.source}; logs that are used together "
                "have to move the same ones."
            )
        if dict(log.locked or {}) != dict(first.locked or {}):
            raise UsageError(
                f"{log.source} locks joints elsewhere than {first.source}; identify them apart."
            )
    followers = moving | _followers(robot, moving, first)
    stand = {j.name: 0.0 for j in robot.joints if not followers.intersection(j.dofs)}
    for joint in robot.joints:
        if joint.name in stand and joint.kind in ("hinge", "slide"):
            stand[joint.name] = float(robot.mj.qpos0[joint.qadr])
    for name, position in (first.locked or {}).items():
        if name not in stand:
            known = ", ".join(stand) or "none"
            raise UsageError(
                f"{first.source}: locked names {name!r}, which is recorded or does not exist; "
                f"joints that stand still are: {known}."
            )
        stand[name] = position
    return replace(manifest, locked={**manifest.locked, **stand})


def _followers(robot: RobotModel, moving: set[str], log: LogDescription) -> set[str]:
    """The joints that follow the moving ones; UsageError for a moving one that follows others."""
    if robot.coupling is None:
        return set()
    coupling, rows = robot.coupling, robot.rows
    dependent = {rows[dof]: int(dof) for dof in coupling.dependent}
    wrong = sorted(moving.intersection(dependent))
    if wrong:
        drivers = [rows[dof] for dof in coupling.independent_of(dependent[wrong[0]])]
        raise UsageError(
            f"{log.source}: joint {wrong[0]!r} follows {', '.join(drivers)}; list that one in its "
            "place, or choose the joints that move in a manifest: [coupling] independent = [...]."
        )
    return {
        name
        for name, dof in dependent.items()
        if moving.intersection(rows[driver] for driver in coupling.independent_of(dof))
    }
