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

from sysid_bench.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.limit_use import largest_use
from sysid_bench.excitation.robot_limits import joint_limits
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import Joint
from sysid_bench.types import Array, Trajectory

RATE: Final = 100.0
"""Hz; a usual rate of recordings."""

FINER: Final = 4
"""The grid of the laws, in samples per sample at RATE."""

MISMATCH: Final = 0.05
"""Largest RMS difference between v or a and the differences of q or v, relative to their RMS: a
wrong unit or sign gives about one, central differences at 400 Hz and jumps of a about 0.01."""


@dataclass(frozen=True, eq=False)
class DesignCase:
    """A robot to design a motion for."""

    name: str
    brief: DesignProblem


Law = Callable[[Any, DesignCase, Trajectory], str | None]
"""(excitation, case, its motion) -> description of the violation, or None."""


@cache
def design_cases() -> tuple[DesignCase, ...]:
    """An arm with hinges, and a random tree with joints of several kinds."""
    return tuple(_case(name) for name in ("ur5", "random:7"))


def _case(name: str) -> DesignCase:
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
    return DesignCase(name, brief)


def check_excitation(excitation: Any, cases: Sequence[DesignCase] | None = None) -> list[Finding]:
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


def _motion(excitation: Any, case: DesignCase) -> Trajectory:
    motion: Trajectory = excitation.design(case.brief, np.random.default_rng(1))
    return motion


def _has_shapes(case: DesignCase, motion: Trajectory) -> str | None:
    """t (N,), q (N, nq), v and a (N, nv), all finite."""
    if not isinstance(motion, Trajectory):
        return f"design returned {type(motion).__name__}, not a Trajectory"
    N = len(motion.t)
    nq, nv = len(case.brief.q0), sum(len(joint.dofs) for joint in case.brief.joints)
    return first_error(
        shape_error(name, getattr(motion, name), (N, width))
        for name, width in (("q", nq), ("v", nv), ("a", nv))
    )


def _has_a_steady_time_grid(excitation: Any, case: DesignCase, motion: Trajectory) -> str | None:
    steps = np.diff(motion.t)
    if len(steps) == 0 or not (steps > 0).all():
        return "its times do not increase from sample to sample"
    # Times are sums or products of the step: rounding grows with their number.
    step = 1.0 / case.brief.rate
    if np.abs(steps - step).max() > 1e-6 * step:
        return (
            f"its time steps are {steps.min():.3g} to {steps.max():.3g} s instead of {step:.3g} s"
        )
    return None


def _keeps_the_limits(excitation: Any, case: DesignCase, motion: Trajectory) -> str | None:
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
    excitation: Any, case: DesignCase, motion: Trajectory
) -> str | None:
    """v and a equal the central differences of q and v, hinges and slides alone: velocities of
    free and ball joints are not derivatives of their quaternions."""
    joints = _scalar_joints(case)
    q = motion.q[:, [joint.qadr for joint in joints]]
    v, a = (array[:, [joint.vadr for joint in joints]] for array in (motion.v, motion.a))
    names = [joint.name for joint in joints]
    return first_error(
        _derivative_error(name, rate, of, signal, motion.t, names)
        for name, rate, of, signal in (("v", v, "q", q), ("a", a, "v", v))
    )


def _derivative_error(
    name: str, rate: Array, of: str, signal: Array, t: Array, joints: Sequence[str]
) -> str | None:
    """Violation where `rate` differs from the differences of `signal`, both (N, n)."""
    # The first and the last sample have no central difference.
    error = _rms(rate[1:-1] - _central_differences(signal, t)) / _floored(_rms(rate))
    if not error.size or not error.max() > MISMATCH:
        return None
    worst = int(np.argmax(error))
    return (
        f"{name} of {joints[worst]} differs from the differences of {of} by "
        f"{100 * error[worst]:.0f} % of its RMS"
    )


def _scalar_joints(case: DesignCase) -> list[Joint]:
    return [joint for joint in case.brief.joints if joint.kind in ("hinge", "slide")]


def _is_reproducible(excitation: Any, case: DesignCase, motion: Trajectory) -> str | None:
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
}


def _central_differences(x: Array, t: Array) -> Array:
    """(x_(k+1) - x_(k-1)) / (t_(k+1) - t_(k-1)), (N - 2, n) of x (N, n)."""
    return np.asarray((x[2:] - x[:-2]) / (t[2:] - t[:-2])[:, None])


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def _floored(size: Array) -> Array:
    # A joint at rest has differences of rounding error alone.
    return np.asarray(np.maximum(size, 1e-6))
