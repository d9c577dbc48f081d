"""Identified actuators for simulators: MJCF with its simulation by MuJoCo alone, and Python text to
paste for simulators of many robots.

Fields of the text are those of mjlab 1.6 (`BuiltinPositionActuatorCfg`) and Isaac Lab 2.3
(`DelayedPDActuatorCfg`), whose delays are counted in steps of the physics."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.apps.actuators.rollout import Drives, positions_of, simulation_step
from sysid_bench.errors import ModelError, UnsupportedError
from sysid_bench.models.mjcf import stated_actuators
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
            "An MJCF holds no friction that grows with the load; take the values from --json."
        )
    commands = drives.apply(commands)
    limits = torque_limits(robot, commands)
    if robot.format != "mjcf":
        raise UnsupportedError(
            f"{robot.manifest.path.name} is a URDF, which has no armature and no actuators; "
            "identify with the robot's MJCF, or take the values from --json."
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
            limit=float(limits[j]),
            delay=max(delay - SHORTER, 0.0),
            samples=samples,
        )
        for j, name in enumerate(drives.joints)
    ]
    path = robot.manifest.path
    return with_position_actuators(update_mjcf(path, {}, joints), actuators, path.name)


def torque_limits(robot: RobotModel, commands: Commands) -> Array:
    """Return the largest torques (k,): those of the recording, else of the joints or of the
    actuators of the model file; infinite where none of them states one."""
    dofs = [robot.rows.index(joint) for joint in commands.joints]
    limits = np.where(np.isfinite(commands.limit), commands.limit, robot.limits.tau[dofs])
    if robot.format != "mjcf" or np.isfinite(limits).all():
        return limits
    stated = stated_actuators(robot.manifest)
    of_file = [stated[joint].limit if joint in stated else np.inf for joint in commands.joints]
    return np.where(np.isfinite(limits), limits, of_file)


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
    # By name: joint orders differ between simulators.
    joints = [mj.joint(name) for name in commands.joints]
    places = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    return positions_of(mj, places, 0.0, commands, rows)


def largest_difference(q: Array, other: Array) -> float:
    """Return the largest difference (rad, m) of two simulated motions."""
    return float(np.abs(q - other).max())


STEP: Final = 0.005
"""s, of the physics: the usual one of both."""


@dataclass(frozen=True)
class JointSettings:
    """Gains kp (N m/rad) and kd (N m s/rad), torque limit (N m, infinite: none), armature
    (kg m^2), viscous damping (N m s/rad), Coulomb friction (N m), largest speed (rad/s, infinite:
    none) of a joint; slides: N, m."""

    kp: float
    kd: float
    limit: float
    armature: float
    damping: float
    friction: float
    slides: bool = False
    speed: float = np.inf


def settings_text(
    joints: Mapping[str, JointSettings], delay: tuple[float, float], step: float = STEP
) -> dict[str, str]:
    """Return texts for "mjlab", "isaaclab" and "usd" (JSON of a joint's attributes); the range of
    the delay (s), which USD does not have, is rounded outward to physics steps (s)."""
    # Outward: randomisation should cover the whole interval. 1e-9: a delay of whole steps stays.
    lags = int(np.floor(delay[0] / step + 1e-9)), int(np.ceil(delay[1] / step - 1e-9))
    return {
        "mjlab": _mjlab(joints, lags, step),
        "isaaclab": _isaaclab(joints, lags, step),
        "usd": json.dumps({name: _usd(one) for name, one in joints.items()}, indent=1),
    }


def _usd(one: JointSettings) -> dict[str, float]:
    """Attributes of UsdPhysics.DriveAPI and of PhysX's PhysxJointAxisAPI (5.6, Isaac Sim 5.0), of
    which those over an angle or its rate count in degrees."""
    kind, unit = ("linear", 1.0) if one.slides else ("angular", np.pi / 180.0)
    drive, axis = f"drive:{kind}:physics", f"physxJointAxis:{kind}"
    limit = {} if np.isinf(one.limit) else {f"{drive}:maxForce": one.limit}
    if np.isfinite(one.speed):
        limit["physxJoint:maxJointVelocity"] = one.speed / unit
    return {
        f"{drive}:stiffness": one.kp * unit,
        f"{drive}:damping": one.kd * unit,
        **limit,
        f"{axis}:armature": one.armature,
        f"{axis}:staticFrictionEffort": one.friction,
        f"{axis}:dynamicFrictionEffort": one.friction,
        f"{axis}:viscousFrictionCoefficient": one.damping * unit,
    }


def _mjlab(joints: Mapping[str, JointSettings], lags: tuple[int, int], step: float) -> str:
    lines = [f"# mjlab; lags in physics steps of {1e3 * step:g} ms", "actuators = ("]
    for name, one in joints.items():
        effort = "" if np.isinf(one.limit) else f" effort_limit={one.limit:.6g},"
        lines += [
            "    BuiltinPositionActuatorCfg(",
            f"        target_names_expr=({_pattern(name)},), "
            f"stiffness={one.kp:.6g}, damping={one.kd:.6g},{effort}",
            f"        armature={one.armature:.6g}, viscous_damping={one.damping:.6g}, "
            f"frictionloss={one.friction:.6g},",
            f"        delay_min_lag={lags[0]}, delay_max_lag={lags[1]},",
            "    ),",
        ]
    return "\n".join([*lines, ")"])


def _isaaclab(joints: Mapping[str, JointSettings], lags: tuple[int, int], step: float) -> str:
    columns = {
        "stiffness": "kp", "damping": "kd", "armature": "armature", "friction": "friction",
        "dynamic_friction": "friction", "viscous_friction": "damping",
    }  # fmt: skip
    if not any(np.isinf(one.limit) for one in joints.values()):
        columns["effort_limit"] = "limit"
    lines = [
        f"# Isaac Lab; delays in physics steps of {1e3 * step:g} ms, friction in N m",
        "actuator = DelayedPDActuatorCfg(",
        f"    joint_names_expr=[{', '.join(_pattern(name) for name in joints)}],",
    ]
    for field, value in columns.items():
        words = ", ".join(
            f"{_pattern(name)}: {getattr(one, value):.6g}" for name, one in joints.items()
        )
        lines.append(f"    {field}={{{words}}},")
    return "\n".join([*lines, f"    min_delay={lags[0]}, max_delay={lags[1]},", ")"])


def _pattern(name: str) -> str:
    """Regular expression of one name, as Python text."""
    return repr(re.escape(name))
