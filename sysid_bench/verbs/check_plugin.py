"""An estimator of one's own, run through its laws before anybody believes it."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sysid_bench.conformance import TestProblem
    from sysid_bench.experiments.spec import ExperimentSpec

WORLDS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7"},
    {"robot": "random:12", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5"},
    {"robot": "z1", "noise": {"tau_relative": 0.01}, "prior": "none"},
    {"robot": "panda", "task": "payload", "payload": "box-2kg"},
    {"robot": "ur10", "task": "link", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""Small experiments, exact and noisy, whole robots and single bodies, with and without a prior."""

LOOP: Final = {
    "robot": "random:94",
    "simulation": {"use": "closed-loop", "rate": 500.0},
    "rate": 100.0,
}
"""What a method that simulates is given: a declared controller, and joints without Coulomb friction
(they would stick, and exact data would tell no method the truth)."""


def check_plugin(name: str | Mapping[str, Any], robots_dir: Path | None = None) -> dict[str, Any]:
    """The laws of an estimator, built in, "module:object" or "file:path.py:object": {estimator, ok,
    checks, bias, broken: [{law, world, said}]}. Raises UsageError where nothing has that name."""
    from sysid_bench.conformance import check
    from sysid_bench.naming import build

    estimator = build("estimator", name)
    findings = check(estimator, problems_of_kind(not hasattr(estimator, "solve"), robots_dir))
    return {
        "estimator": name if isinstance(name, str) else name["use"],
        "ok": all(finding.kept for finding in findings),
        "checks": len(findings),
        "bias": getattr(estimator, "bias", ""),
        "broken": [
            {"law": f.law, "world": f.world, "said": f.said} for f in findings if not f.kept
        ],
    }


def problems_of_kind(
    simulating: bool = False, robots_dir: Path | None = None
) -> list["TestProblem"]:
    """The worlds of a method; `simulating`: those with a controller alone."""
    if simulating:
        noisy = {**LOOP, "noise": {"tau_relative": 0.01}}
        return [_world(places, robots_dir) for places in (LOOP, noisy)]
    return [_world(places, robots_dir) for places in WORLDS]


def _world(changes: Mapping[str, Any], robots_dir: Path | None) -> "TestProblem":
    from sysid_bench.conformance import TestProblem
    from sysid_bench.experiments.robot_cache import cached_robot
    from sysid_bench.experiments.simulated.prepare import prepare

    spec = experiment_spec(changes)
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare(spec, cached_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(name, ready.problem, ready.truth.theta, not spec.noise, ready.experiment)


def experiment_spec(changes: Mapping[str, Any]) -> "ExperimentSpec":
    """A small experiment of one short motion, with some fields changed."""
    from sysid_bench.experiments.spec import ExperimentSpec

    base: dict[str, Any] = {
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
    return ExperimentSpec(**{**base, **changes})


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `check-plugin` tells."""
    if answer["ok"]:
        lines = [f"{answer['estimator']}: keeps its laws ({answer['checks']} checks)"]
        return lines + ([f"  biased by design: {answer['bias']}"] if answer["bias"] else [])
    lines = [f"{answer['estimator']}: {len(answer['broken'])} of {answer['checks']} checks fail"]
    return lines + [f"  {b['law']} ({b['world']}): {b['said']}" for b in answer["broken"]]
