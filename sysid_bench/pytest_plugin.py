"""Checks for tests of one's own: plug-ins and model files.

from sysid_bench.pytest_plugin import assert_conforms, assert_engines_agree
assert_conforms("my_lab.methods:Geodesic"), assert_conforms(Sway(), "excitation")
assert_engines_agree("my_arm.urdf")
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sysid_bench.apps.conformance import failed_checks
from sysid_bench.commands.check_plugin import build_plugin, plugin_findings
from sysid_bench.commands.crosscheck import crosscheck


def assert_conforms(plugin: Any, kind: str = "estimator", file: Path | str | None = None) -> None:
    """Check a plug-in (an object, a name or the {use = ...} of a suite) against the laws of its
    kind: "estimator", "excitation", "plant", "simulation", "pipeline", "metric", "log-reader",
    "task" or "executor".

    `file`: recorded file for a log reader, None: files that the check writes.

    Raises AssertionError with all violated laws, UsageError for an unknown name or kind.
    """
    if isinstance(plugin, (str, Mapping)):
        plugin = build_plugin(plugin, kind)
    file = None if file is None else Path(file)
    lines = failed_checks(plugin_findings(plugin, kind, file=file))
    if lines:
        raise AssertionError(f"{plugin!r} violates {len(lines)} laws:\n" + "\n".join(lines))


def assert_engines_agree(*robots: str, samples: int = 50) -> None:
    """Check that MuJoCo and Pinocchio have the same regressor of each robot, a name or a model
    file, at `samples` random states.

    Raises AssertionError with the gap, or the reason why a model could not be compared.
    """
    verdicts = crosscheck(*robots, samples=samples)
    wrong = [f"{verdict.robot}: {verdict.summary()}" for verdict in verdicts if not verdict.ok]
    if wrong:
        raise AssertionError("The engines do not agree.\n" + "\n".join(wrong))
