"""Test problems of the estimator kit: small simulated experiments."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.conformance.estimator import TestProblem
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.spec import ExperimentSpec

LINEAR: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7"},
    {"robot": "random:12", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5"},
    {"robot": "z1", "noise": {"tau_relative": 0.01}, "prior": "none"},
    {"robot": "panda", "task": "payload", "payload": "box-2kg"},
    {"robot": "ur10", "task": "link", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""Exact and noisy data, whole robots and single bodies, with and without a prior."""

CLOSED_LOOP: Final[Mapping[str, Any]] = {
    "robot": "random:94",
    "simulation": {"use": "closed-loop", "rate": 500.0, "substeps": 1},
    "rate": 100.0,
}
"""Experiment of methods that simulate: a declared controller, and joints without Coulomb friction,
which would stick, so that exact data would not give the true parameters."""

_DEFAULTS: Final[Mapping[str, Any]] = {
    "seed": 1,
    "payload": "none",
    "task": "robot",
    "terms": None,
    "plant": {"use": "matched"},
    "prior": {"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
    "excitation": {"use": "fourier", "period": "4 s", "cycles": 1},
    "held_out": (),
    "simulation": {"use": "inverse"},
    "rate": 30.0,
    "noise": {},
    "signals": {"filter": "none", "derivatives": "exact"},
    "repeat": 0,
}


def estimator_problems(
    simulating: bool = False, robots_dir: Path | None = None
) -> tuple[TestProblem, ...]:
    """Test problems of linear methods, or of methods that simulate; a new object each time."""
    if simulating:
        # Exact data show a bias, noisy ones that the method does not need exact data.
        noisy = {**CLOSED_LOOP, "noise": {"tau_relative": 0.01}}
        return tuple(_problem(changes, robots_dir) for changes in (CLOSED_LOOP, noisy))
    return tuple(_problem(changes, robots_dir) for changes in LINEAR)


@cache
def estimator_cases(simulating: bool) -> tuple[TestProblem, ...]:
    """`estimator_problems`, made once per process."""
    return estimator_problems(simulating)


def experiment_spec(changes: Mapping[str, Any]) -> ExperimentSpec:
    """Specification of a small experiment of one short motion, with some fields changed."""
    return ExperimentSpec(**{**_DEFAULTS, **changes})


def _problem(changes: Mapping[str, Any], robots_dir: Path | None) -> TestProblem:
    spec = experiment_spec(changes)
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(
        name, ready.problem, ready.source.truth.theta, not spec.noise, ready.experiment
    )
