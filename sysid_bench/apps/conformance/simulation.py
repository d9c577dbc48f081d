"""Conformance kit of simulations: `run(plant, commanded, encoder)` gives (result, controller).

`result.motion` is the exact motion (a Trajectory) and `result.tau` (N, n) the noise-free torque of
the actuated degrees of freedom; the controller is None where nothing tracks the motion.
`design_rate(recording)` is the rate (Hz) at which the commanded motion is sampled.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.simulation.effects.presliding import Stribeck
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.types import Array, Controller, Trajectory

RATE: Final = 100.0
"""Hz, of the recording."""

CONSISTENT: Final = 0.02
"""Largest RMS difference from inverse dynamics along the simulated motion, relative to the RMS
torque of the joint: an integrator's error is below 0.001, a missing term far above."""


@dataclass(frozen=True, eq=False)
class _SimulationCase:
    """A plant to move."""

    name: str
    plant: Plant


Law = Callable[[Any, _SimulationCase, Trajectory, Any], str | None]
"""(simulation, case, commanded motion, what `run` returned) -> violation, or None."""


@cache
def simulation_cases() -> tuple[_SimulationCase, ...]:
    """A tree without Coulomb friction (sticking joints have no unique torque), plain and with an
    effect that its identified model lacks."""
    robot = loaded_robot("random:94", "none", None, None).robot
    return (
        _SimulationCase("random:94", plant_of(robot)),
        _SimulationCase("random:94 with Stribeck friction", plant_of(robot, (Stribeck(),))),
    )


def check_simulation(
    simulation: Any, cases: Sequence[_SimulationCase] | None = None
) -> list[Finding]:
    """Findings of all laws on all cases (None: `simulation_cases`)."""
    findings = []
    for case in simulation_cases() if cases is None else cases:
        try:
            commanded = _commanded(simulation, case)
            before = _state(case, commanded)
            result = _run(simulation, case, commanded)
        except Exception as error:
            findings.append(finding_of_error(error, "runs", case.name))
            continue
        shape = findings_of({"has the shapes of the robot": _has_shapes}, case.name,
                            case, commanded, result)  # fmt: skip
        findings += shape
        if shape[0].passed:  # the other laws compute with these arrays
            findings += findings_of(LAWS, case.name, simulation, case, commanded, result)
        if _state(case, commanded) != before:
            message = "it changed the plant or the commanded motion"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    return findings


def _commanded(simulation: Any, case: _SimulationCase) -> Trajectory:
    brief = design_problem(case.plant.robot, simulation.design_rate(RATE))
    return Fourier(period=2.0, cycles=1).design(brief, np.random.default_rng(1))


def _run(simulation: Any, case: _SimulationCase, commanded: Trajectory) -> Any:
    exact_encoders = np.zeros((len(commanded), len(case.plant.robot.torque_dofs)))
    return simulation.run(case.plant, commanded, exact_encoders)


def _state(case: _SimulationCase, commanded: Trajectory) -> str:
    plant = case.plant
    return data_hash((commanded, plant.robot.phi, plant.terms, plant.laws, plant.phi))


def _has_shapes(case: _SimulationCase, commanded: Trajectory, result: Any) -> str | None:
    """(result, controller or None); motion on the commanded grid, tau (N, n), all finite."""
    if not (isinstance(result, tuple) and len(result) == 2):
        return f"run returned {type(result).__name__}, not a pair (result, controller)"
    done, controller = result
    if controller is not None and not isinstance(controller, Controller):
        return f"its controller is a {type(controller).__name__}, not a Controller or None"
    N = len(commanded)
    shapes = {
        "motion.t": (done.motion.t, (N,)),
        "motion.q": (done.motion.q, commanded.q.shape),
        "motion.v": (done.motion.v, commanded.v.shape),
        "motion.a": (done.motion.a, commanded.a.shape),
        "tau": (done.tau, (N, len(case.plant.robot.torque_dofs))),
    }
    return first_error(shape_error(name, x, shape) for name, (x, shape) in shapes.items())


def _designs_at_a_multiple_of_the_rate(
    simulation: Any, case: _SimulationCase, commanded: Trajectory, result: Any
) -> str | None:
    # The recording takes every n-th sample of the simulated motion.
    ratio = simulation.design_rate(RATE) / RATE
    if ratio >= 1 and abs(ratio - round(ratio)) <= 1e-9:
        return None
    return f"design_rate is {ratio:.3g} times the recording rate; whole multiples are possible"


def _is_deterministic(
    simulation: Any, case: _SimulationCase, commanded: Trajectory, result: Any
) -> str | None:
    first, second = result[0], _run(simulation, case, commanded)[0]
    # Bit for bit: the rows of a run that is repeated have to be the same.
    for name in ("q", "v", "a"):
        if not np.array_equal(getattr(first.motion, name), getattr(second.motion, name)):
            return f"{name} differs from one call to the next"
    return None if np.array_equal(first.tau, second.tau) else "tau differs from call to call"


def _obeys_the_equations_of_motion(
    simulation: Any, case: _SimulationCase, commanded: Trajectory, result: Any
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


LAWS: Final[dict[str, Law]] = {
    "designs at a multiple of the rate": _designs_at_a_multiple_of_the_rate,
    "is deterministic": _is_deterministic,
    "obeys the equations of motion": _obeys_the_equations_of_motion,
}


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))
