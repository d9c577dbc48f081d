"""An estimator of one's own, run through its laws before anybody believes it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any


def check_plugin(name: str | Mapping[str, Any], robots_dir: Path | None = None) -> dict[str, Any]:
    """The laws of an estimator, built in, "module:object" or "file:path.py:object": {estimator, ok,
    checks, bias, broken: [{law, world, said}]}. Raises UsageError where nothing has that name."""
    from sysid_bench.conformance.plugin import check_estimator
    from sysid_bench.naming import build

    estimator = build("estimator", name)
    findings = check_estimator(estimator, robots_dir)
    return {
        "estimator": name if isinstance(name, str) else name["use"],
        "ok": all(finding.passed for finding in findings),
        "checks": len(findings),
        "bias": getattr(estimator, "bias", ""),
        "broken": [
            {"law": f.law, "world": f.case, "said": f.message} for f in findings if not f.passed
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
    from sysid_bench.experiments.simulated.prepare import prepare_simulated
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
    spec = ExperimentSpec(**{**base, **changes})
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare_simulated(spec, cached_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(
        name, ready.problem, ready.source.truth.theta, not spec.noise, ready.experiment
    )


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `check-plugin` tells."""
    if answer["ok"]:
        lines = [f"{answer['estimator']}: keeps its laws ({answer['checks']} checks)"]
        return lines + ([f"  biased by design: {answer['bias']}"] if answer["bias"] else [])
    lines = [f"{answer['estimator']}: {len(answer['broken'])} of {answer['checks']} checks fail"]
    return lines + [f"  {b['law']} ({b['world']}): {b['said']}" for b in answer["broken"]]
