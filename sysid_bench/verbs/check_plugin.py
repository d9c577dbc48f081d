"""Check of an estimator against the laws that every estimator keeps."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.conformance.plugin import check_estimator
from sysid_bench.naming import build
from sysid_bench.verbs.result import Result


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
    findings = check_estimator(estimator, robots_dir)
    return CheckPluginResult(
        estimator=name if isinstance(name, str) else name["use"],
        ok=all(finding.passed for finding in findings),
        checks=len(findings),
        bias=getattr(estimator, "bias", ""),
        broken=[
            {"law": f.law, "world": f.case, "said": f.message} for f in findings if not f.passed
        ],
    )
