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
    KitCase,
    Law,
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
from sysid_bench.types import Controller, Trajectory

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
class _DesignCase(KitCase):
    """A robot to design a motion for."""

    brief: DesignProblem


@cache
def design_cases() -> tuple[_DesignCase, ...]:
    """An arm with hinges, and a random tree with joints of several kinds; inertial parameters are
    unknown to the estimator."""
    cases = []
    for name in ("ur5", "random:7"):
        loaded = loaded_robot(name, "none", None, None)
        robot = loaded.robot
        brief = replace(
            design_problem(robot, FINER * RATE),
            regress=information_model(robot, loaded.base_map(robot.inertial_columns).names),
            torque=torque_model(robot),
            scene=partial(collision_model, robot),
        )
        cases.append(_DesignCase(name, brief))
    return tuple(cases)


def check_excitation(excitation: Any) -> list[Finding]:
    """Findings of all laws on `design_cases`."""
    return _ExcitationKit.check(excitation, design_cases())


class _ExcitationKit(Kit[_DesignCase]):
    runs = "returns a motion"
    changed = "it changed an array of the design problem"

    def run(self) -> Trajectory:
        motion: Trajectory = self.plugin.design(self.case.brief, np.random.default_rng(1))
        return motion

    def given(self) -> Any:
        return self.case.brief

    @Law("has the shapes of the robot", first=True)
    def shapes(self) -> str | None:
        """t (N,), q (N, nq), v and a (N, nv), all finite."""
        return shape_problem(self.result, self.case.brief.joints)

    @Law("has a steady time grid")
    def time_grid(self) -> str | None:
        return time_problem(self.result.t, self.case.brief.rate)

    @Law("keeps the limits")
    def limits(self) -> str | None:
        """Position, velocity and acceleration of each hinge and slide within its limits."""
        brief = self.case.brief
        scalar = [joint.vadr for joint in brief.joints if joint.kind in ("hinge", "slide")]
        # Balls and free joints have no limits of position in one coordinate.
        profiles = np.flatnonzero(np.isin(brief.dofs, scalar))
        uses = [largest_use(limit, self.result) for limit in joint_limits(brief, profiles)]
        worst = max(uses, key=lambda use: use.use, default=None)
        if worst is None or worst.use <= 1.0 + 1e-9:
            return None
        return (
            f"{worst.kind} of {worst.name} reaches {worst.value:.3g} {worst.unit} at "
            f"{worst.time:.3g} s; its limit is {worst.limit:.3g} {worst.unit}"
        )

    @Law("has consistent derivatives")
    def derivatives(self) -> str | None:
        """v and a are the derivatives of q and v, those of rotations in the frame of the body."""
        return next(derivative_problems(self.result, self.case.brief.joints), None)

    @Law("is reproducible")
    def repeats(self) -> str | None:
        """The same random generator state gives the same motion, bit for bit."""
        again = self.run()
        for name in ("t", "q", "v", "a"):
            if not np.array_equal(getattr(again, name), getattr(self.result, name)):
                return f"{name} differs between two calls with the same random generator state"
        return None

    @Law("is the same curve at another rate")
    def other_rate(self) -> str | None:
        """A design at a lower rate has every FINER-th sample of the motion: training and held-out
        motions, playback and closed loop differ in rate alone."""
        motion = self.result
        slower = self.plugin.design(self.case.brief.at(RATE), np.random.default_rng(1))
        count = min(len(slower), (len(motion) - 1) // FINER + 1)
        # A motion may end a few samples later, to reach the end of a move.
        if abs(len(slower) * FINER - len(motion)) > ENDING * FINER:
            return f"at {RATE:g} Hz it takes {slower.t[-1]:.4g} s instead of {motion.t[-1]:.4g} s"
        for name in ("q", "v", "a"):
            fine, coarse = getattr(motion, name)[::FINER][:count], getattr(slower, name)[:count]
            error = np.abs(fine - coarse).max()
            if error > SAME * max(1.0, np.abs(fine).max()):
                rates = f"{RATE:g} Hz differs from that at {FINER * RATE:g} Hz"
                return f"{name} at {rates} by {error:.2g}"
        return None


CONSISTENT: Final = 0.02
"""Largest RMS difference from inverse dynamics along the simulated motion, relative to the RMS
torque of the joint: an integrator's error is below 0.001, a missing term far above."""


@dataclass(frozen=True, eq=False)
class _SimulationCase(KitCase):
    """A plant and the motion that it is to make."""

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
    return _SimulationKit.check(simulation, cases)


class _SimulationKit(Kit[_SimulationCase]):
    runs = "runs"
    changed = "it changed the plant or the commanded motion"

    def run(self) -> Any:
        plant, commanded = self.case.plant, self.case.commanded
        exact_encoders = np.zeros((len(commanded), len(plant.robot.torque_dofs)))
        return self.plugin.run(plant, commanded, exact_encoders)

    def given(self) -> Any:
        plant = self.case.plant
        return self.case.commanded, plant.robot.phi, plant.terms, plant.laws, plant.phi

    @Law("has the shapes of the robot", first=True)
    def shapes(self) -> str | None:
        """(result, controller or None); motion on the commanded grid, tau (N, n), all finite."""
        if not (isinstance(self.result, tuple) and len(self.result) == 2):
            return f"run returned {type(self.result).__name__}, not a pair (result, controller)"
        done, controller = self.result
        if controller is not None and not isinstance(controller, Controller):
            return f"its controller is a {type(controller).__name__}, not a Controller or None"
        commanded, n = self.case.commanded, len(self.case.plant.robot.torque_dofs)
        motion = first_error(
            shape_error(f"motion.{x}", getattr(done.motion, x), getattr(commanded, x).shape)
            for x in ("t", "q", "v", "a")
        )
        return motion or shape_error("tau", done.tau, (len(commanded), n))

    @Law("designs at a multiple of the rate")
    def rate(self) -> str | None:
        # The recording takes every n-th sample of the simulated motion.
        ratio = self.plugin.design_rate(RATE) / RATE
        if ratio >= 1 and abs(ratio - round(ratio)) <= 1e-9:
            return None
        return f"design_rate is {ratio:.3g} times the recording rate; whole multiples are possible"

    @Law("is deterministic")
    def repeats(self) -> str | None:
        first, second = self.result[0], self.run()[0]
        # Bit for bit: the rows of a run that is repeated have to be the same.
        for name in ("q", "v", "a"):
            if not np.array_equal(getattr(first.motion, name), getattr(second.motion, name)):
                return f"{name} differs from one call to the next"
        return None if np.array_equal(first.tau, second.tau) else "tau differs from call to call"

    @Law("obeys the equations of motion")
    def dynamics(self) -> str | None:
        """tau equals M a + bias + joint terms + effects along the simulated motion."""
        done, plant = self.result[0], self.case.plant
        expected = Inverse().run(plant, done.motion, np.zeros_like(done.tau))[0].tau
        rms, error = (np.sqrt((x**2).mean(axis=0)) for x in (expected, done.tau - expected))
        # A joint that carries next to nothing is compared with the largest torque of the robot.
        error = error / np.maximum(rms, 1e-3 * rms.max())
        worst = int(np.argmax(error))
        if error[worst] <= CONSISTENT:
            return None
        return (
            f"tau of {plant.robot.torque_rows[worst]} differs from inverse dynamics along the "
            f"simulated motion by {100 * error[worst]:.1f} % of its RMS"
        )
