"""Check of an estimator against the laws that every estimator keeps."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.conformance import TestProblem, check
from sysid_bench.experiments.robot_cache import cached_robot
from sysid_bench.experiments.simulated.prepare import prepare
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.naming import build
from sysid_bench.verbs.result import Result

PROBLEMS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7"},
    {"robot": "random:12", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5"},
    {"robot": "z1", "noise": {"tau_relative": 0.01}, "prior": "none"},
    {"robot": "panda", "task": "payload", "payload": "box-2kg"},
    {"robot": "ur10", "task": "link", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""Small experiments, exact and noisy, whole robots and single bodies, with and without a prior."""

CLOSED_LOOP: Final = {
    "robot": "random:94",
    "simulation": {"use": "closed-loop", "rate": 500.0},
    "rate": 100.0,
}
"""Experiment for a method that simulates: known controller, joints without Coulomb friction (they
would stick, and exact data would not determine the parameters)."""


@dataclass(frozen=True, eq=False, repr=False)
class CheckPluginResult(Result):
    """Verdict on an estimator; `bias`: what it is biased towards by design; `broken`: failed checks
    as {law, world, said}."""

    estimator: str
    ok: bool
    checks: int
    bias: str
    broken: list[dict[str, str]]

    def summary(self) -> str:
        """Verdict, then one line for each failed check."""
        if not self.ok:
            lines = [f"{self.estimator}: {len(self.broken)} of {self.checks} checks fail"]
            lines += [f"  {b['law']} ({b['world']}): {b['said']}" for b in self.broken]
            return "\n".join(lines)
        bias = f"\n  biased by design: {self.bias}" if self.bias else ""
        return f"{self.estimator}: keeps its laws ({self.checks} checks){bias}"


def check_plugin(
    name: str | Mapping[str, Any], robots_dir: Path | None = None
) -> CheckPluginResult:
    """Check an estimator: built in, "module:object", "file:path.py:object", or {use = ...} with
    settings. Raises UsageError for an unknown name."""
    estimator = build("estimator", name)
    findings = check(estimator, problems_of_kind(not hasattr(estimator, "solve"), robots_dir))
    return CheckPluginResult(
        estimator=name if isinstance(name, str) else name["use"],
        ok=all(finding.kept for finding in findings),
        checks=len(findings),
        bias=getattr(estimator, "bias", ""),
        broken=[{"law": f.law, "world": f.world, "said": f.said} for f in findings if not f.kept],
    )


def problems_of_kind(simulating: bool = False, robots_dir: Path | None = None) -> list[TestProblem]:
    """Return the test problems of an estimator; `simulating`: those with a known controller."""
    if simulating:
        noisy = {**CLOSED_LOOP, "noise": {"tau_relative": 0.01}}
        return [_test_problem(changes, robots_dir) for changes in (CLOSED_LOOP, noisy)]
    return [_test_problem(changes, robots_dir) for changes in PROBLEMS]


def _test_problem(changes: Mapping[str, Any], robots_dir: Path | None) -> TestProblem:
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
    ready = prepare(spec, cached_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(name, ready.problem, ready.truth.theta, not spec.noise, ready.experiment)
