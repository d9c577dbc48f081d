"""Configurations of actuators for simulators of many robots, as Python text to paste.

Fields are those of mjlab 1.6 (`BuiltinPositionActuatorCfg`) and Isaac Lab 2.3
(`DelayedPDActuatorCfg`), whose delays are counted in steps of the physics.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

STEP: Final = 0.005
"""s, of the physics: the usual one of both."""


@dataclass(frozen=True)
class JointSettings:
    """Gains kp (N m/rad) and kd (N m s/rad), torque limit (N m, infinite: none), armature
    (kg m^2), viscous damping (N m s/rad) and Coulomb friction (N m) of a joint; slides: N, m."""

    kp: float
    kd: float
    limit: float
    armature: float
    damping: float
    friction: float


def settings_text(
    joints: Mapping[str, JointSettings], delay: tuple[float, float], step: float = STEP
) -> dict[str, str]:
    """Return texts for "mjlab" and "isaaclab"; the range of the delay (s) is rounded outward to
    physics steps (s)."""
    lags = int(np.floor(delay[0] / step + 1e-9)), int(np.ceil(delay[1] / step - 1e-9))
    return {"mjlab": _mjlab(joints, lags, step), "isaaclab": _isaaclab(joints, lags, step)}


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
    columns: dict[str, Callable[[JointSettings], float]] = {
        "stiffness": lambda one: one.kp, "damping": lambda one: one.kd,
        "armature": lambda one: one.armature, "friction": lambda one: one.friction,
        "dynamic_friction": lambda one: one.friction, "viscous_friction": lambda one: one.damping,
    }  # fmt: skip
    if not any(np.isinf(one.limit) for one in joints.values()):
        columns["effort_limit"] = lambda one: one.limit
    lines = [
        f"# Isaac Lab; delays in physics steps of {1e3 * step:g} ms, friction in N m",
        "actuator = DelayedPDActuatorCfg(",
        f"    joint_names_expr=[{', '.join(_pattern(name) for name in joints)}],",
    ]
    for field, value in columns.items():
        words = ", ".join(f"{_pattern(name)}: {value(one):.6g}" for name, one in joints.items())
        lines.append(f"    {field}={{{words}}},")
    return "\n".join([*lines, f"    min_delay={lags[0]}, max_delay={lags[1]},", ")"])


def _pattern(name: str) -> str:
    """Regular expression of one name, as Python text."""
    return repr(re.escape(name))
