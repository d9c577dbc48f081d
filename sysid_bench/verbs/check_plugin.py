"""Check of a plug-in against the laws of its kind."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.apps.conformance.executor_checks import check_executor
from sysid_bench.apps.conformance.findings import Finding
from sysid_bench.apps.conformance.plugin import EXECUTOR, check_kind, check_plugin_of
from sysid_bench.errors import count_text
from sysid_bench.harness.executor import executor_of
from sysid_bench.plugin_names import build
from sysid_bench.verbs.result import Result


@dataclass(frozen=True, eq=False, repr=False)
class CheckPluginResult(Result):
    """Verdict on a plug-in; `bias`: the declared bias of an estimator; `broken`: failed checks as
    {law, case, message}. The keys `estimator` (for `plugin`), `world` (`case`) and `said`
    (`message`) are those of earlier versions."""

    plugin: str
    estimator: str
    ok: bool
    checks: int
    bias: str
    broken: list[dict[str, str]]

    def summary(self) -> str:
        """Verdict, then one line for each failed check."""
        if not self.ok:
            lines = [f"{self.plugin}: {len(self.broken)} of {self.checks} checks fail"]
            lines += [f"  {b['law']} ({b['case']}): {b['message']}" for b in self.broken]
            return "\n".join(lines)
        bias = f"\n  biased by design: {self.bias}" if self.bias else ""
        return f"{self.plugin}: keeps its laws ({count_text(self.checks, 'check')}){bias}"


def check_plugin(
    name: str | Mapping[str, Any],
    robots_dir: Path | None = None,
    kind: str = "estimator",
    file: Path | None = None,
) -> CheckPluginResult:
    """Check a plug-in: built in, "module:object", "file:path.py:object", or {use = ...} with
    settings. `kind`: estimator, excitation, plant, model-error, sensor-error, simulation, metric,
    log-reader, task, or executor, whose name is that of `run --executor`; `file`: recorded file for
    a log reader. Raises UsageError for an unknown name or kind, for a log reader of a format that
    needs a file, and for an executor that cannot compute now."""
    plugin = build_plugin(name, kind)
    findings = plugin_findings(plugin, kind, robots_dir, file)
    use = name if isinstance(name, str) else name["use"]
    return CheckPluginResult(
        plugin=use,
        estimator=use,
        ok=all(finding.passed for finding in findings),
        checks=len(findings),
        bias=getattr(plugin, "bias", ""),
        broken=[_failed_check(finding) for finding in findings if not finding.passed],
    )


def build_plugin(name: str | Mapping[str, Any], kind: str) -> Any:
    """Return a plug-in of a kind with a conformance kit; raises UsageError where there is none."""
    kind = check_kind(kind)
    if kind == EXECUTOR and isinstance(name, str):
        return executor_of(name)
    return build(kind, name)


def plugin_findings(
    plugin: Any, kind: str, robots_dir: Path | None = None, file: Path | None = None
) -> list[Finding]:
    """Return the findings of a plug-in object on the laws of its kind."""
    if check_kind(kind) == EXECUTOR:
        return check_executor(plugin)
    return check_plugin_of(kind, plugin, robots_dir, file)


def _failed_check(finding: Finding) -> dict[str, str]:
    """Entry of `broken`, by today's keys and by those of earlier versions."""
    case, message = finding.case, finding.message
    return {"law": finding.law, "case": case, "message": message, "world": case, "said": message}
