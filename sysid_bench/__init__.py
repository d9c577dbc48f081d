"""sysid_bench: a Pinocchio-cross-validated benchmark of robot dynamic identification.

Everything that the command line does is a function of this package, listed by `dir(sysid_bench)`;
each returns a frozen result that also reads as a mapping:

    verdict, = sysid_bench.crosscheck("ur5")
    sysid_bench.identify("ur5", "link", "box-2kg").bodies
    sysid_bench.identify("ur5", log="run.toml", test="other.toml").torque_error
    print(sysid_bench.diagnose("run.toml", "ur5").summary())
    sysid_bench.excite(sysid_bench.ExciteRequest("ur5", objective="D", out="motion.csv"))

Public import paths are `sysid_bench`, `sysid_bench.types` (arrays, problems, estimates), and the
groups of plug-ins, entry points such as `sysid_bench.estimators`; all else may move. Functions are
imported when they are first used, so that `import sysid_bench` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sysid_bench.apps.actuators.commands.excite_actuators import CommandsRequest, CommandsResult
    from sysid_bench.apps.site.commands.site import SiteResult, site
    from sysid_bench.apps.surveys.commands.survey import SurveyRequest, SurveyResult, survey
    from sysid_bench.apps.twins.commands.limits import LimitsResult, limits
    from sysid_bench.apps.twins.commands.transfer import TransferResult, transfer
    from sysid_bench.apps.twins.commands.twin import TwinResult, twin
    from sysid_bench.apps.twins.commands.twin_table import TwinTableResult, twin_table
    from sysid_bench.commands.baseline import BaselineResult, baseline_save, baseline_update
    from sysid_bench.commands.basis import BasisResult, basis, paper_table
    from sysid_bench.commands.cells import CellsResult, cells
    from sysid_bench.commands.check_plugin import CheckPluginResult, check_plugin
    from sysid_bench.commands.claims import ClaimsResult, claims
    from sysid_bench.commands.compare import CompareResult, compare
    from sysid_bench.commands.crosscheck import CrosscheckResult, crosscheck
    from sysid_bench.commands.diagnose import DiagnoseRequest, DiagnoseResult, diagnose
    from sysid_bench.commands.doctor import DoctorResult, doctor
    from sysid_bench.commands.excite import ExciteRequest, excite
    from sysid_bench.commands.excite_design import ExciteResult
    from sysid_bench.commands.fetch import FetchResult, fetch
    from sysid_bench.commands.figure import FigureResult, figure
    from sysid_bench.commands.frames import FramesResult, frames
    from sysid_bench.commands.gate import GateResult, gate
    from sysid_bench.commands.help import HelpResult, help_
    from sysid_bench.commands.identify import RecordedRequest, SimulatedRequest, identify
    from sysid_bench.commands.identify_recorded import RecordedResult
    from sysid_bench.commands.identify_result import IdentifyResult
    from sysid_bench.commands.identify_simulated import SimulatedResult
    from sysid_bench.commands.init import InitFileResult, init_estimator, init_suite
    from sysid_bench.commands.init_log import InitLogResult, init_log
    from sysid_bench.commands.init_robot import InitRobotResult, init_model, init_robot
    from sysid_bench.commands.lint import LintResult, lint
    from sysid_bench.commands.list import ShowResult, list_, show
    from sysid_bench.commands.merge import MergeResult, merge
    from sysid_bench.commands.online import OnlineResult, online
    from sysid_bench.commands.plan import PlanResult, plan
    from sysid_bench.commands.record import record, view
    from sysid_bench.commands.report import report, table
    from sysid_bench.commands.result import Result
    from sysid_bench.commands.run import RunResult, run
    from sysid_bench.commands.run_folder import open_run
    from sysid_bench.commands.status import CellResult, StatusResult, cell, status
    from sysid_bench.models.load import load_robot
    from sysid_bench.signals.log_data import log_of

_PUBLIC: Final = {
    "apps.actuators.commands.excite_actuators": "CommandsRequest CommandsResult",
    "apps.site.commands.site": "SiteResult site",
    "apps.surveys.commands.survey": "SurveyRequest SurveyResult survey",
    "apps.twins.commands.limits": "LimitsResult limits",
    "apps.twins.commands.transfer": "TransferResult transfer",
    "apps.twins.commands.twin": "TwinResult twin",
    "apps.twins.commands.twin_table": "TwinTableResult twin_table",
    "commands.baseline": "BaselineResult baseline_save baseline_update",
    "commands.gate": "GateResult gate",
    "commands.basis": "BasisResult basis paper_table",
    "commands.cells": "CellsResult cells",
    "commands.check_plugin": "CheckPluginResult check_plugin",
    "commands.claims": "ClaimsResult claims",
    "commands.compare": "CompareResult compare",
    "commands.crosscheck": "CrosscheckResult crosscheck",
    "commands.diagnose": "DiagnoseRequest DiagnoseResult diagnose",
    "commands.doctor": "DoctorResult doctor",
    "commands.excite": "ExciteRequest excite",
    "commands.excite_design": "ExciteResult",
    "commands.fetch": "FetchResult fetch",
    "commands.figure": "FigureResult figure",
    "commands.frames": "FramesResult frames",
    "commands.help": "HelpResult help_",
    "commands.identify": "RecordedRequest SimulatedRequest identify",
    "commands.identify_recorded": "RecordedResult",
    "commands.identify_result": "IdentifyResult",
    "commands.identify_simulated": "SimulatedResult",
    "commands.init": "InitFileResult init_estimator init_suite",
    "commands.init_log": "InitLogResult init_log",
    "commands.init_robot": "InitRobotResult init_model init_robot",
    "commands.lint": "LintResult lint",
    "commands.list": "ShowResult list_ show",
    "commands.merge": "MergeResult merge",
    "commands.online": "OnlineResult online",
    "commands.plan": "PlanResult plan",
    "commands.record": "record view",
    "commands.report": "report table",
    "commands.result": "Result",
    "commands.run": "RunResult run",
    "commands.run_folder": "open_run",
    "commands.status": "CellResult StatusResult cell status",
    "models.load": "load_robot",
    "signals.log_data": "log_of",
}
"""Public names of each module."""

_MODULE: Final = {name: module for module, names in _PUBLIC.items() for name in names.split()}

__all__ = [
    "BaselineResult", "BasisResult", "CellResult", "CellsResult", "CheckPluginResult",
    "ClaimsResult", "CommandsRequest", "CommandsResult", "CompareResult", "CrosscheckResult",
    "DiagnoseRequest", "DiagnoseResult", "DoctorResult", "ExciteRequest", "ExciteResult",
    "FetchResult", "FigureResult", "FramesResult", "GateResult", "HelpResult", "IdentifyResult",
    "InitFileResult", "InitLogResult", "InitRobotResult", "LimitsResult", "LintResult",
    "MergeResult", "OnlineResult", "PlanResult", "RecordedRequest", "RecordedResult", "Result",
    "RunResult", "ShowResult", "SimulatedRequest", "SimulatedResult", "SiteResult", "StatusResult",
    "SurveyRequest", "SurveyResult", "TransferResult", "TwinResult", "TwinTableResult",
    "baseline_save", "baseline_update", "basis", "cell", "cells", "check_plugin", "claims",
    "compare", "crosscheck", "diagnose", "doctor", "excite", "fetch", "figure", "frames", "gate",
    "help_", "identify", "init_estimator", "init_log", "init_model", "init_robot", "init_suite",
    "limits", "lint", "list_", "load_robot", "log_of", "merge", "online", "open_run",
    "paper_table", "plan", "record", "report", "run", "show", "site", "status", "survey", "table",
    "transfer", "twin", "twin_table", "view",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("sysid-bench")
    if name in _MODULE:
        return getattr(import_module(f"sysid_bench.{_MODULE[name]}"), name)
    raise AttributeError(f"module 'sysid_bench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
