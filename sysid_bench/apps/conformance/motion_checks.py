"""Conformance kits of plug-ins that make motions: excitations and simulations.

An excitation has `design(brief, rng)`: `brief` is a DesignProblem (limits, rate, regressor of the
unknowns), `rng` a random generator. Its laws are checked on a grid four times finer than a
recording's, since a motion that keeps its limits at the recorded samples may exceed them between.

A simulation has `run(plant, commanded, encoder)`, which gives (result, controller): `result.motion`
is the exact motion (a Trajectory) and `result.tau` (N, n) the noise-free torque of the actuated
degrees of freedom; the controller is None where nothing tracks the motion. `design_rate(recording)`
is the rate (Hz) at which the commanded motion is sampled.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    Finding,
    Kit,
    Laws,
    finding_of_error,
    first_error,
    motion_of_kit,
    robot_of_kit,
    shape_error,
)
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.limits import joint_limits, largest_use
from sysid_bench.excitation.motion_check import derivative_problems, shape_problem, time_problem
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.simulation.effects.presliding import Stribeck
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.types import Array, Controller, Trajectory

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


def check_excitation(excitation: Any) -> list[Finding]:
    """Findings of all laws on `design_cases`."""
    return _EXCITATION_KIT.findings(excitation, design_cases())


def _motion(excitation: Any, case: _DesignCase) -> Trajectory:
    motion: Trajectory = excitation.design(case.brief, np.random.default_rng(1))
    return motion


def _has_finite_arrays(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    """t (N,), q (N, nq), v and a (N, nv), all finite."""
    return shape_problem(motion, case.brief.joints)


def _has_a_steady_time_grid(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    return time_problem(motion.t, case.brief.rate)


def _keeps_the_limits(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    """Position, velocity and acceleration of each hinge and slide within its limits."""
    scalar = [joint.vadr for joint in case.brief.joints if joint.kind in ("hinge", "slide")]
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


def _is_reproducible(excitation: Any, case: _DesignCase, motion: Trajectory) -> str | None:
    """The same random generator state gives the same motion, bit for bit."""
    again = _motion(excitation, case)
    for name in ("t", "q", "v", "a"):
        if not np.array_equal(getattr(again, name), getattr(motion, name)):
            return f"{name} differs between two calls with the same random generator state"
    return None


EXCITATION_LAWS: Final[Laws] = {
    "has a steady time grid": _has_a_steady_time_grid,
    "keeps the limits": _keeps_the_limits,
    "has consistent derivatives": _has_consistent_derivatives,
    "is reproducible": _is_reproducible,
    "is the same curve at another rate": _is_the_same_curve_at_another_rate,
}

_EXCITATION_KIT: Final = Kit(
    runs="returns a motion",
    run=_motion,
    laws=lambda case, motion: (
        {"has the shapes of the robot": _has_finite_arrays}, EXCITATION_LAWS,
    ),
    given=lambda case: case.brief,
    changed="it changed an array of the design problem",
)  # fmt: skip


CONSISTENT: Final = 0.02
"""Largest RMS difference from inverse dynamics along the simulated motion, relative to the RMS
torque of the joint: an integrator's error is below 0.001, a missing term far above."""


@dataclass(frozen=True, eq=False)
class _SimulationCase:
    """A plant and the motion that it is to make."""

    name: str
    plant: Plant
    commanded: Trajectory


@cache
def simulated_plants() -> Mapping[str, Plant]:
    """A tree without Coulomb friction (sticking joints have no unique torque), plain and with an
    effect that its identified model lacks."""
    robot = robot_of_kit("random:94")
    stribeck = plant_of(robot, (Stribeck(),))
    return {"random:94": plant_of(robot), "random:94 with Stribeck friction": stribeck}


def check_simulation(simulation: Any) -> list[Finding]:
    """Findings of all laws on `simulated_plants`, commanded to move at the simulation's rate."""
    try:
        rate = simulation.design_rate(RATE)
        cases = [
            _SimulationCase(name, plant, motion_of_kit(plant.robot, rate))
            for name, plant in simulated_plants().items()
        ]
    except Exception as error:
        return [finding_of_error(error, "runs", "all plants")]
    return _SIMULATION_KIT.findings(simulation, cases)


def _run(simulation: Any, case: _SimulationCase) -> Any:
    exact_encoders = np.zeros((len(case.commanded), len(case.plant.robot.torque_dofs)))
    return simulation.run(case.plant, case.commanded, exact_encoders)


def _simulation_input(case: _SimulationCase) -> Any:
    plant = case.plant
    return case.commanded, plant.robot.phi, plant.terms, plant.laws, plant.phi


def _gives_a_pair(simulation: Any, case: _SimulationCase, result: Any) -> str | None:
    """(result, controller or None); motion on the commanded grid, tau (N, n), all finite."""
    if not (isinstance(result, tuple) and len(result) == 2):
        return f"run returned {type(result).__name__}, not a pair (result, controller)"
    done, controller = result
    if controller is not None and not isinstance(controller, Controller):
        return f"its controller is a {type(controller).__name__}, not a Controller or None"
    commanded, N = case.commanded, len(case.commanded)
    shapes = {
        "motion.t": (done.motion.t, (N,)),
        "motion.q": (done.motion.q, commanded.q.shape),
        "motion.v": (done.motion.v, commanded.v.shape),
        "motion.a": (done.motion.a, commanded.a.shape),
        "tau": (done.tau, (N, len(case.plant.robot.torque_dofs))),
    }
    return first_error(shape_error(name, x, shape) for name, (x, shape) in shapes.items())


def _designs_at_a_multiple_of_the_rate(
    simulation: Any, case: _SimulationCase, result: Any
) -> str | None:
    # The recording takes every n-th sample of the simulated motion.
    ratio = simulation.design_rate(RATE) / RATE
    if ratio >= 1 and abs(ratio - round(ratio)) <= 1e-9:
        return None
    return f"design_rate is {ratio:.3g} times the recording rate; whole multiples are possible"


def _moves_alike_twice(simulation: Any, case: _SimulationCase, result: Any) -> str | None:
    first, second = result[0], _run(simulation, case)[0]
    # Bit for bit: the rows of a run that is repeated have to be the same.
    for name in ("q", "v", "a"):
        if not np.array_equal(getattr(first.motion, name), getattr(second.motion, name)):
            return f"{name} differs from one call to the next"
    return None if np.array_equal(first.tau, second.tau) else "tau differs from call to call"


def _obeys_the_equations_of_motion(
    simulation: Any, case: _SimulationCase, result: Any
) -> str | None:
    """tau equals M a + bias + joint terms + effects along the simulated motion."""
    done = result[0]
    expected = Inverse().run(case.plant, done.motion, np.zeros_like(done.tau))[0].tau
    # A joint that carries next to nothing is compared with the largest torque of the robot.
    size = np.maximum(_rms(expected), 1e-3 * _rms(expected).max())
    error = _rms(done.tau - expected) / size
    worst = int(np.argmax(error))
    if error[worst] <= CONSISTENT:
        return None
    row = case.plant.robot.torque_rows[worst]
    return (
        f"tau of {row} differs from inverse dynamics along the simulated motion by "
        f"{100 * error[worst]:.1f} % of its RMS"
    )


SIMULATION_LAWS: Final[Laws] = {
    "designs at a multiple of the rate": _designs_at_a_multiple_of_the_rate,
    "is deterministic": _moves_alike_twice,
    "obeys the equations of motion": _obeys_the_equations_of_motion,
}


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


_SIMULATION_KIT: Final = Kit(
    runs="runs",
    run=_run,
    laws=lambda case, result: ({"has the shapes of the robot": _gives_a_pair}, SIMULATION_LAWS),
    given=_simulation_input,
    changed="it changed the plant or the commanded motion",
)
