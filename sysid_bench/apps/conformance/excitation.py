"""Conformance kit of excitations: `design(brief, rng)` gives a motion within the limits.

`brief` is a DesignProblem (limits, rate, regressor of the unknowns), `rng` a random generator. Each
law is checked on a grid four times finer than a recording's, since a motion that keeps its limits
at the recorded samples may exceed them between.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
)
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.limits import joint_limits, largest_use
from sysid_bench.excitation.motion_check import derivative_problems, shape_problem, time_problem
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import Joint
from sysid_bench.types import Trajectory

RATE: Final = 100.0
"""Hz; a usual rate of recordings."""

FINER: Final = 4
"""The grid of the laws, in samples per sample at RATE."""

SAME: Final = 1e-7
"""Largest difference (SI units, relative above 1) of one motion at two rates: rounding, and that
of solvers of closed chains."""

ENDING: Final = 4
"""Samples by which the end of a motion may differ between two rates."""


@dataclass(frozen=True, eq=False)
class _DesignCase:
    """A robot to design a motion for."""

    name: str
    brief: DesignProblem


Law = Callable[[Any, _DesignCase, Trajectory], str | None]
"""(excitation, case, its motion) -> description of the violation, or None."""


@cache
def design_cases() -> tuple[_DesignCase, ...]:
    """An arm with hinges, and a random tree with joints of several kinds."""
    return tuple(_case(name) for name in ("ur5", "random:7"))


def _case(name: str) -> _DesignCase:
    """The design problem of a robot whose inertial parameters are unknown to the estimator."""
    loaded = loaded_robot(name, "none", None, None)
    robot = loaded.robot
    base = loaded.base_map(robot.inertial_columns)
    brief = replace(
        design_problem(robot, FINER * RATE),
        regress=information_model(robot, base.names),
        torque=torque_model(robot),
        scene=partial(collision_model, robot),
    )
    return _DesignCase(name, brief)


def check_excitation(excitation: Any, cases: Sequence[_DesignCase] | None = None) -> list[Finding]:
    """Findings of all laws on all cases (None: `design_cases`)."""
    findings = []
    for case in design_cases() if cases is None else cases:
        before = data_hash(case.brief)
        try:
            motion = _motion(excitation, case)
        except Exception as error:
            findings.append(finding_of_error(error, "returns a motion", case.name))
            continue
        shape = findings_of({"has the shapes of the robot": _has_shapes}, case.name, case, motion)
        findings += shape
        if shape[0].passed:  # the other laws compute with these arrays
            findings += findings_of(LAWS, case.name, excitation, case, motion)
        if data_hash(case.brief) != before:
            message = "it changed an array of the design problem"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    return findings


def _motion(excitation: Any, case: _DesignCase) -> Trajectory:
    motion: Trajectory = excitation.design(case.brief, np.random.default_rng(1))
    return motion


def _has_shapes(case: _DesignCase, motion: Trajectory) -> str | None:
    """t (N,), q (N, nq), v and a (N, nv), all finite."""
    return shape_problem(motion, case.brief.joints)


def _has_a_steady_time_grid(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    return time_problem(motion.t, case.brief.rate)


def _keeps_the_limits(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    """Position, velocity and acceleration of each hinge and slide within its limits."""
    scalar = [joint.vadr for joint in _scalar_joints(case)]
    # Balls and free joints have no limits of position in one coordinate.
    profiles = np.flatnonzero(np.isin(case.brief.dofs, scalar))
    uses = [largest_use(limit, motion) for limit in joint_limits(case.brief, profiles)]
    worst = max(uses, key=lambda use: use.use, default=None)
    if worst is None or worst.use <= 1.0 + 1e-9:
        return None
    return (
        f"{worst.kind} of {worst.name} reaches {worst.value:.3g} {worst.unit} at "
        f"{worst.time:.3g} s; its limit is {worst.limit:.3g} {worst.unit}"
    )


def _has_consistent_derivatives(
    excitation: Any, case: _DesignCase, motion: Trajectory
) -> str | None:
    """v and a are the derivatives of q and v, those of rotations in the frame of the body."""
    return next(derivative_problems(motion, case.brief.joints), None)


def _is_the_same_curve_at_another_rate(
    excitation: Any, case: _DesignCase, motion: Trajectory
) -> str | None:
    """A design at a lower rate has every FINER-th sample of the motion: training and held-out
    motions, playback and closed loop differ in rate alone."""
    slower = excitation.design(case.brief.at(RATE), np.random.default_rng(1))
    count = min(len(slower), (len(motion) - 1) // FINER + 1)
    # A motion may end a few samples later, to reach the end of a move.
    if abs(len(slower) * FINER - len(motion)) > ENDING * FINER:
        return f"at {RATE:g} Hz it takes {slower.t[-1]:.4g} s instead of {motion.t[-1]:.4g} s"
    for name in ("q", "v", "a"):
        fine, coarse = getattr(motion, name)[::FINER][:count], getattr(slower, name)[:count]
        error = np.abs(fine - coarse).max()
        if error > SAME * max(1.0, np.abs(fine).max()):
            return f"{name} at {RATE:g} Hz differs from that at {FINER * RATE:g} Hz by {error:.2g}"
    return None


def _scalar_joints(case: _DesignCase) -> list[Joint]:
    return [joint for joint in case.brief.joints if joint.kind in ("hinge", "slide")]


def _is_reproducible(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    """The same random generator state gives the same motion, bit for bit."""
    again = _motion(excitation, case)
    for name in ("t", "q", "v", "a"):
        if not np.array_equal(getattr(again, name), getattr(motion, name)):
            return f"{name} differs between two calls with the same random generator state"
    return None


LAWS: Final[dict[str, Law]] = {
    "has a steady time grid": _has_a_steady_time_grid,
    "keeps the limits": _keeps_the_limits,
    "has consistent derivatives": _has_consistent_derivatives,
    "is reproducible": _is_reproducible,
    "is the same curve at another rate": _is_the_same_curve_at_another_rate,
}
