"""Verb `check-plugin`: a plug-in against the laws of its kind."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.request import FAILED, OK, Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import count_text
from sysid_bench.words import FRAME_DEPENDENT

if TYPE_CHECKING:
    from sysid_bench.apps.conformance.findings import Finding

KINDS: Final = (
    *("estimator", "excitation", "plant", "simulation", "metric", "log-reader", "task"),
    *("model-error", "sensor-error", "pipeline", "executor"),
)
"""Kinds with a conformance kit; spelled out, because the kits take a second to load."""


class CheckPlugin(Request["CheckPluginResult"]):
    """Check a plug-in against the laws of its kind.

    Exit code 1 where it breaks one.
    """

    name: str | Mapping[str, Any] = argument("PKG:OBJ", complete="files")
    robots_dir: Path | None = None
    kind: str = option("Kind of plug-in.", default="estimator", choices=KINDS, shown=True)
    file: Path | None = option(
        "Recorded file for a log reader of a format that the check cannot write.",
        default=None, path="file", complete="files",
    )  # fmt: skip

    def run(self) -> "CheckPluginResult":
        """Check a plug-in: built in, "module:object", "file:path.py:object", or {use = ...} with
        settings. The name of an executor is that of `run --executor`. Raises UsageError for an
        unknown name or kind, for a log reader of a format that needs a file, and for an executor
        that cannot compute now."""
        plugin = build_plugin(self.name, self.kind)
        findings = plugin_findings(plugin, self.kind, self.robots_dir, self.file)
        use = self.name if isinstance(self.name, str) else self.name["use"]
        return CheckPluginResult(
            plugin=use,
            estimator=use,
            ok=all(finding.passed for finding in findings),
            checks=len(findings),
            bias=getattr(plugin, "bias", ""),
            broken=[_failed_check(finding) for finding in findings if not finding.passed],
            unchecked=_unchecked(plugin, self.kind),
        )

    def exit_code(self, result: "CheckPluginResult") -> int:
        return OK if result.ok else FAILED

    def plugins(self) -> list[tuple[str, str | None]]:
        return [(self.kind, str(self.name))]


check_plugin = python_function(CheckPlugin, "check_plugin")


@dataclass(frozen=True, eq=False, repr=False)
class CheckPluginResult(Result):
    """Verdict on a plug-in; `bias`: the declared bias of an estimator; `broken`: failed checks as
    {law, case, message}; `unchecked`: what could not be checked of it. The keys `estimator` (for
    `plugin`), `world` (`case`) and `said` (`message`) are those of earlier versions."""

    plugin: str
    estimator: str
    ok: bool
    checks: int
    bias: str
    broken: list[dict[str, str]]
    unchecked: str

    def summary(self) -> str:
        """Verdict, then one line for each failed check."""
        if not self.ok:
            lines = [f"{self.plugin}: {len(self.broken)} of {self.checks} checks fail"]
            lines += [f"  {b['law']} ({b['case']}): {b['message']}" for b in self.broken]
        else:
            lines = [f"{self.plugin}: keeps its laws ({count_text(self.checks, 'check')})"]
            lines += [f"  biased by design: {self.bias}"] if self.bias else []
        lines += [f"  not checked: {self.unchecked}"] if self.unchecked else []
        return "\n".join(lines)


def build_plugin(name: str | Mapping[str, Any], kind: str) -> Any:
    """Return a plug-in of a kind with a conformance kit; raises UsageError where there is none."""
    from sysid_bench.apps.conformance import EXECUTOR, check_kind
    from sysid_bench.harness.executor import executor_of
    from sysid_bench.plugin_names import build

    kind = check_kind(kind)
    if kind == EXECUTOR and isinstance(name, str):
        return executor_of(name)
    return build(kind, name)


def plugin_findings(
    plugin: Any, kind: str, robots_dir: Path | None = None, file: Path | None = None
) -> "list[Finding]":
    """Return the findings of a plug-in object on the laws of its kind."""
    from sysid_bench.apps.conformance import EXECUTOR, check_kind, check_plugin_of
    from sysid_bench.apps.conformance.executor_checks import check_executor

    if check_kind(kind) == EXECUTOR:
        return check_executor(plugin)
    return check_plugin_of(kind, plugin, robots_dir, file)


def _unchecked(plugin: Any, kind: str) -> str:
    """What no check of an estimator has measured; empty where all were."""
    if kind != "estimator" or hasattr(plugin, "solve") or getattr(plugin, FRAME_DEPENDENT, False):
        return ""
    # Other frames would change the model that `simulate` runs, which `fit` cannot be given.
    return (
        "whether its answer depends on the frames of the links, which needs `solve`; one that does "
        "declares `frame_dependent`"
    )


def _failed_check(finding: "Finding") -> dict[str, str]:
    """Entry of `broken`, by today's keys and by those of earlier versions."""
    case, message = finding.case, finding.message
    return {"law": finding.law, "case": case, "message": message, "world": case, "said": message}
