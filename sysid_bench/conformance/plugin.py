"""Conformance kits by kind of plug-in."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from sysid_bench.conformance.effect import check_effect
from sysid_bench.conformance.estimator import check
from sysid_bench.conformance.estimator_problems import problems_of_kind, shared_problems
from sysid_bench.conformance.excitation import check_excitation
from sysid_bench.conformance.findings import Finding
from sysid_bench.conformance.metric import check_metric_plugin
from sysid_bench.conformance.simulation import check_simulation
from sysid_bench.errors import unknown_name

Kit = Callable[[Any], list[Finding]]


def check_estimator(estimator: Any, robots_dir: Path | None = None) -> list[Finding]:
    """Findings of an estimator on the test problems of its kind: `solve` or `fit`."""
    simulating = not hasattr(estimator, "solve")
    if robots_dir is None:
        return check(estimator, shared_problems(simulating))
    return check(estimator, problems_of_kind(simulating, robots_dir))


KITS: Final[Mapping[str, Kit]] = MappingProxyType(
    {
        "estimator": check_estimator,
        "excitation": check_excitation,
        "plant": check_effect,
        "simulation": check_simulation,
        "metric": check_metric_plugin,
    }
)


def check_plugin_of(kind: str, plugin: Any) -> list[Finding]:
    """Findings of a plug-in object of a kind of `KITS`; raises UsageError for another kind."""
    if kind not in KITS:
        raise unknown_name("conformance kit", kind, KITS)
    return KITS[kind](plugin)
