"""MJCF with identified actuators, and its simulation by MuJoCo alone."""

from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.rollout import Drives, positions_of, simulation_step
from sysid_bench.errors import ModelError, UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.mjcf_writer import (
    PositionDrive,
    update_mjcf,
    with_position_actuators,
)
from sysid_bench.signals.position_control import Commands
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Array

SPARE: Final = 2
"""Samples of the buffer of past inputs beyond the delay."""

SHORTER: Final = 1e-6
"""s by which a delay of whole steps is written shorter: MuJoCo compares times that are sums of
steps, whose rounding would otherwise decide between two inputs."""


def written_mjcf(robot: RobotModel, drives: Drives, commands: Commands) -> str:
    """Return the text of the robot's MJCF with armature, damping and frictionloss of its joints,
    and actuators with the gains of the last sample, the offset as their bias, and the delay.

    The delay is rounded to steps of `simulation_step`; its buffer also serves steps of the file
    itself, where these are shorter. Raises UnsupportedError for a URDF, which has no place
    for them or for friction that grows with the load, ModelError for values that must not be
    written. Gains and limits are those that act, so that positions are those of the joints.
    """
    if "load" in drives.more:
        raise UnsupportedError(
            "An MJCF holds no friction that grows with the load; take the values from --json-out."
        )
    commands = drives.apply(commands)
    if robot.format != "mjcf":
        raise UnsupportedError(
            f"{robot.manifest.path.name} is a URDF, which has no armature and no actuators; "
            "identify with the robot's MJCF, or take the values from --json-out."
        )
    joints = {
        name: dict(zip(("armature", "damping", "frictionloss"), row[:3].tolist(), strict=True))
        for name, row in zip(drives.joints, drives.values, strict=True)
    }
    step = simulation_step(commands.rate)
    delay = round(drives.delay / step) * step
    samples = int(np.ceil(delay / min(step, robot.mj.opt.timestep) - 1e-9)) + SPARE
    actuators = [
        PositionDrive(
            joint=name,
            kp=float(commands.kp[-1, j]),
            kd=float(commands.kd[-1, j]),
            offset=float(drives.values[j, 3]),
            limit=float(commands.limit[j]),
            delay=max(delay - SHORTER, 0.0),
            samples=samples,
        )
        for j, name in enumerate(drives.joints)
    ]
    path = robot.manifest.path
    return with_position_actuators(update_mjcf(path, {}, joints), actuators, path.name)


def replay_positions(file: Path, commands: Commands, rows: slice) -> Array:
    """Return q (n, k) that MuJoCo simulates with a written file under the recorded commands, whose
    delay is that of the file; without contacts and limits, as `simulated_positions`.

    Raises ModelError where MuJoCo does not read the file.
    """
    try:
        mj = contact_free(mujoco.MjModel.from_xml_path(str(file)))
    except ValueError as error:
        raise ModelError(f"MuJoCo does not read {file.name} again: {error}.") from error
    mj.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    mj.opt.timestep = simulation_step(commands.rate)
    joints = [mj.joint(name) for name in commands.joints]
    places = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    return positions_of(mj, places, 0.0, commands, rows)


def largest_difference(q: Array, other: Array) -> float:
    """Return the largest difference (rad, m) of two simulated motions."""
    return float(np.abs(q - other).max())
