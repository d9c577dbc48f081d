"""Check of a plug-in against the laws of its kind."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.conformance.findings import Finding
from sysid_bench.conformance.plugin import KITS, check_estimator, check_plugin_of
from sysid_bench.naming import build
from sysid_bench.verbs.result import Result


@dataclass(frozen=True, eq=False, repr=False)
class CheckPluginResult(Result):
    """Verdict on a plug-in; `bias`: the declared bias of an estimator; `broken`: failed checks as
    {law, world, said}."""

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
    name: str | Mapping[str, Any], robots_dir: Path | None = None, kind: str = "estimator"
) -> CheckPluginResult:
    """Check a plug-in: built in, "module:object", "file:path.py:object", or {use = ...} with
    settings. `kind`: estimator, excitation, plant, simulation or metric. Raises UsageError for an
    unknown name or kind."""
    plugin = build(kind, name) if kind in KITS else None
    findings = _findings(kind, plugin, robots_dir)
    broken = [{"law": f.law, "world": f.case, "said": f.message} for f in findings if not f.passed]
    return CheckPluginResult(
        estimator=name if isinstance(name, str) else name["use"],
        ok=not broken,
        checks=len(findings),
        bias=getattr(plugin, "bias", ""),
        broken=broken,
    )


def _findings(kind: str, plugin: Any, robots_dir: Path | None) -> Sequence[Finding]:
    """Results of all checks of a kind; those of estimators run on the robots of a folder too."""
    if kind == "estimator":
        return check_estimator(plugin, robots_dir)
    return check_plugin_of(kind, plugin)
