"""Robots and motions that the laws of plant effects are checked on."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import Effect
from sysid_bench.types import Trajectory


@dataclass(frozen=True, eq=False)
class EffectMotion:
    """A robot and a periodic motion to evaluate force laws along."""

    name: str
    robot: RobotModel
    motion: Trajectory


Law = Callable[[Effect, EffectMotion, Any], str | None]
"""(effect, case, what it prepares) -> description of the violation, or None."""


@cache
def effect_cases() -> tuple[EffectMotion, ...]:
    """An arm and a random tree, along Fourier series."""
    cases = []
    for name in ("ur5", "random:7"):
        robot = loaded_robot(name, "none", None, None).robot
        motion = Fourier(period=2.0, cycles=1).design(
            design_problem(robot, 50.0), np.random.default_rng(1)
        )
        cases.append(EffectMotion(name, robot, motion))
    return tuple(cases)
