"""The check of a user's own metric: small experiments, then the laws of metrics on them."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sysid_bench.types import MetricInput

EXPERIMENTS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5", "task": "payload", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""A whole robot and a payload, noisy, each with a held-out motion."""


def check_metric(name: str | Mapping[str, Any], robots_dir: Path | None = None) -> dict[str, Any]:
    """{metric, ok, checks, broken: [sentence]} of a metric named as in [[metric]].

    Raises UsageError where nothing has that name.
    """
    from sysid_bench.evaluation import metric_checks
    from sysid_bench.naming import build

    metric = build("metric", name)
    cells = [_cell(changes, robots_dir) for changes in EXPERIMENTS]
    broken = metric_checks.check_metric(metric, cells)
    used = name if isinstance(name, str) else name["use"]
    return {"metric": used, "ok": not broken, "checks": len(cells), "broken": broken}


def summary(verdict: Mapping[str, Any]) -> str:
    """The verdict in lines for the terminal."""
    if verdict["ok"]:
        return f"{verdict['metric']}: keeps its laws on {verdict['checks']} experiments"
    return "\n".join([f"{verdict['metric']}: broken laws", *map("  {}".format, verdict["broken"])])


def _cell(changes: Mapping[str, Any], robots_dir: Path | None) -> "MetricInput":
    """One experiment, identified by weighted least squares and scored."""
    from sysid_bench.evaluation.score import score
    from sysid_bench.experiments.robot_cache import cached_robot
    from sysid_bench.experiments.simulated.prepare import prepare
    from sysid_bench.identification.estimators.wls import WLS
    from sysid_bench.identification.identify import identify
    from sysid_bench.types import MetricInput
    from sysid_bench.verbs.check_plugin import experiment_spec

    spec = experiment_spec({"held_out": ({"use": "ptp"},), **changes})
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare(spec, cached_robot(spec.robot, spec.payload, robots, None))
    estimate = identify(WLS(), ready.problem, ready.experiment)
    figures = score(estimate, ready.problem, ready.held_out, ready.truth)
    return MetricInput(estimate, ready.problem, ready.held_out, figures)
