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


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `check-plugin` tells."""
    if answer["ok"]:
        lines = [f"{answer['estimator']}: keeps its laws ({answer['checks']} checks)"]
        return lines + ([f"  biased by design: {answer['bias']}"] if answer["bias"] else [])
    lines = [f"{answer['estimator']}: {len(answer['broken'])} of {answer['checks']} checks fail"]
    return lines + [f"  {b['law']} ({b['world']}): {b['said']}" for b in answer["broken"]]
