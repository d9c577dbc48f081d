"""Robots with couplings for laws: random ones, and a planar four-bar whose parts can be changed."""

from functools import cache

import numpy as np

from sysid_bench.models.load import load_robot
from sysid_bench.models.random_robot import MECHANISMS
from sysid_bench.models.robot import RobotModel

KINDS = tuple(MECHANISMS)
LOOPS = ("four-bar", "parallelogram", "slider-crank")
INERTIAL = '<inertial pos="0.1 0.02 0.03" mass="1" diaginertia="0.01 0.012 0.013"/>'


@cache
def mechanism(kind: str, seed: int = 0) -> RobotModel:
    """A random robot with a mechanism, loaded once: its arrays are not to be written to."""
    return load_robot(f"random:{kind}:{seed}")


def hinge(name: str, pos: str, inside: str = "", axis: str = "0 1 0", more: str = "") -> str:
    """A body on a hinge of the same name."""
    return (
        f'<body name="{name}" pos="{pos}"><joint name="{name}" axis="{axis}" {more}/>'
        f"{INERTIAL}{inside}</body>"
    )


def mjcf(bodies: str, equality: str, more: str = "") -> str:
    """An MJCF with these bodies and equalities."""
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        f"<worldbody>{bodies}</worldbody><equality>{equality}</equality>{more}</mujoco>"
    )


def four_bar(height: float = 0.2, pin: float = 0.4, joint: str = "", base: str = "") -> str:
    """Crank, coupler and rocker; flat where the height is zero. `pin`: where the rocker stands,
    `joint`: words of its joint, `base`: the joint of the body that carries all."""
    bars = hinge("crank", "0 0 0", hinge("coupler", f"0.1 0 {height}"))
    rocker = hinge("rocker", f"{pin} 0 0", more=joint)
    loop = '<connect name="loop" body1="coupler" body2="rocker" anchor="0.2 0 0"/>'
    body = (
        f'<body name="ground" pos="0 0 1" euler="0.2 0.3 0.1">{base}{INERTIAL}{bars}{rocker}</body>'
    )
    return mjcf(body, loop)


def chain(name: str, joints: int, pos: str, rng: np.random.Generator) -> str:
    """Bodies name1, name2, ... on hinges with any axes, one on the other."""
    text = ""
    for k in range(joints, 0, -1):
        axis, offset = (" ".join(map(str, rng.normal(size=3))) for _ in range(2))
        place = pos if k == 1 else " ".join(str(0.2 * float(x)) for x in offset.split())
        text = hinge(f"{name}{k}", place, text, axis)
    return text
