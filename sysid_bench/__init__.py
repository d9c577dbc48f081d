"""sysid_bench: a Pinocchio-cross-validated benchmark of robot dynamic identification.

The verbs of the command line as functions; each imports what it needs when it is called.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid_bench.models.load import load_robot
    from sysid_bench.verbs.basis import basis
    from sysid_bench.verbs.catalogue import list_, show
    from sysid_bench.verbs.check_plugin import check_plugin
    from sysid_bench.verbs.crosscheck import crosscheck
    from sysid_bench.verbs.doctor import doctor
    from sysid_bench.verbs.folders import open_run
    from sysid_bench.verbs.identify import identify
    from sysid_bench.verbs.recordings import record, view
    from sysid_bench.verbs.reports import report, table
    from sysid_bench.verbs.runs import cell, plan, run, status

_PLACES = {
    "load_robot": "sysid_bench.models.load",
    "crosscheck": "sysid_bench.verbs.crosscheck",
    "basis": "sysid_bench.verbs.basis",
    "check_plugin": "sysid_bench.verbs.check_plugin",
    "identify": "sysid_bench.verbs.identify",
    "list_": "sysid_bench.verbs.catalogue",
    "show": "sysid_bench.verbs.catalogue",
    "plan": "sysid_bench.verbs.runs",
    "run": "sysid_bench.verbs.runs",
    "open_run": "sysid_bench.verbs.folders",
    "status": "sysid_bench.verbs.runs",
    "cell": "sysid_bench.verbs.runs",
    "table": "sysid_bench.verbs.reports",
    "report": "sysid_bench.verbs.reports",
    "record": "sysid_bench.verbs.recordings",
    "view": "sysid_bench.verbs.recordings",
    "doctor": "sysid_bench.verbs.doctor",
}

__all__ = [
    "basis", "cell", "check_plugin", "crosscheck", "doctor", "identify", "list_", "load_robot",
    "open_run", "plan", "record", "report", "run", "show", "status", "table", "view",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("sysid-bench")
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module 'sysid_bench' has no attribute {name!r}")
