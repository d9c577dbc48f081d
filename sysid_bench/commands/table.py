"""Table of the verbs: group, sentence, and the request, which is imported when it is asked for.

Other packages add verbs by the entry-point group `sysid_bench.commands`: name = "module:Request".
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

GROUPS: Final[Mapping[str, str]] = {
    "models": "Models of robots",
    "identification": "Identification",
    "recordings": "Recordings and data sets",
    "suites": "Suites of experiments",
    "results": "Results of runs",
    "own": "Your own files, names, and this machine",
    "other": "Verbs of other packages",
}
"""Headings of the groups of verbs, as help shows them."""
FIRST: Final = (
    "init", "lint", "crosscheck", "diagnose", "identify", "excite", "plan", "run", "compare",
    "help",
)  # fmt: skip
"""Verbs that help names first."""
ENTRY_POINTS: Final = "sysid_bench.commands"


@dataclass(frozen=True)
class Verb:
    """A verb: `target` is "module:Request"; `sentence` the first one of its help. Without a target
    the verb is the word before those that begin with it, as "baseline" of "baseline save"."""

    group: str
    target: str
    sentence: str


VERBS: Final[Mapping[str, Verb]] = {
    "crosscheck": Verb(
        "models",
        "sysid_bench.commands.crosscheck:Crosscheck",
        "Compare a robot's regressor between MuJoCo and Pinocchio.",
    ),
    "lint": Verb(
        "models",
        "sysid_bench.commands.lint:Lint",
        "Report what is wrong with model files as models of dynamics; folders, and collections "
        "that were fetched, are searched.",
    ),
    "basis": Verb(
        "models",
        "sysid_bench.commands.basis:BasisCommand",
        "Print the base parameters: number, combinations, identifiability of each parameter.",
    ),
    "frames": Verb(
        "models",
        "sysid_bench.commands.frames:Frames",
        "Print the forward kinematics: origin and rotation of every body and of the tool in the "
        "world, and gravity there.",
    ),
    "survey": Verb(
        "models",
        "sysid_bench.apps.surveys.commands.survey:SurveyCommand",
        "Cross-check every model of a collection or folder; count refusals by cause.",
    ),
    "identify": Verb(
        "identification",
        "sysid_bench.commands.identify:IdentifyCommand",
        "Identify one robot: excite and simulate it, or read recordings; estimate; export.",
    ),
    "excite": Verb(
        "identification",
        "sysid_bench.commands.excite:ExciteCommand",
        "Design the best motion within a robot's limits, and write it for its controller.",
    ),
    "diagnose": Verb(
        "recordings",
        "sysid_bench.commands.diagnose:DiagnoseRequest",
        "Find what is wrong with recordings: signs, units, columns, gains, time, missing terms.",
    ),
    "twin": Verb(
        "recordings",
        "sysid_bench.apps.twins.commands.twin:TwinCommand",
        "Fit the effects of a robot's plant from a recording, and compare its replay.",
    ),
    "transfer": Verb(
        "recordings",
        "sysid_bench.apps.twins.commands.transfer:TransferRequest",
        "Compare methods on recorded robots and on replays: what does simulation predict?",
    ),
    "fetch": Verb(
        "recordings",
        "sysid_bench.commands.fetch:Fetch",
        "Bring a data set of recorded robots, or a collection of models, here and check its files.",
    ),
    "plan": Verb(
        "suites",
        "sysid_bench.commands.plan:Plan",
        "Validate a suite and count its cells; none of them runs.",
    ),
    "run": Verb(
        "suites",
        "sysid_bench.commands.run:Run",
        "Run a suite, or resume a run; then write its tables, figures and report.",
    ),
    "merge": Verb(
        "suites",
        "sysid_bench.commands.merge:Merge",
        "Merge runs of one plan, such as shards, into one.",
    ),
    "status": Verb(
        "suites",
        "sysid_bench.commands.status:Status",
        "Show the progress of a run, and the reasons of failures.",
    ),
    "report": Verb(
        "results",
        "sysid_bench.commands.report:Report",
        "Write a run's tables, figures and report.html again.",
    ),
    "compare": Verb(
        "results",
        "sysid_bench.commands.compare:CompareCommand",
        "Compare two runs of a suite; each is a run folder or a baseline.",
    ),
    "table": Verb("results", "sysid_bench.commands.report:Table", "Print one table of a run."),
    "figure": Verb(
        "results",
        "sysid_bench.commands.figure:Figure",
        'Write a figure of a run, or "all", as PDF and PNG; without a name, list them.',
    ),
    "cells": Verb(
        "results",
        "sysid_bench.commands.cells:CellsCommand",
        "List the cells of a run with their ids.",
    ),
    "cell": Verb(
        "results",
        "sysid_bench.commands.status:Cell",
        "Show one row, its traceback, and the command that reproduces it.",
    ),
    "claims": Verb(
        "results",
        "sysid_bench.commands.claims:ClaimsCommand",
        "Test the claims of runs on their stored rows: holds, fails, open or not testable.",
    ),
    "limits": Verb(
        "results",
        "sysid_bench.commands.limits:Limits",
        "Print the best error of each recorded robot of a run, and how much is left to win.",
    ),
    "baseline": Verb(
        "results",
        "",
        "Write the values of a run into a small file that later runs are compared with.",
    ),
    "baseline save": Verb(
        "results",
        "sysid_bench.commands.baseline:BaselineSave",
        "Save the baseline of a run: sorted, a line per cell, with versions and tolerances.",
    ),
    "baseline update": Verb(
        "results",
        "sysid_bench.commands.baseline:BaselineUpdate",
        "Take the changes of a run over into its baseline; values within their tolerance stay, and "
        "so do tolerances and metrics.",
    ),
    "gate": Verb(
        "results",
        "sysid_bench.commands.baseline:GateCommand",
        "Compare a run with a baseline; exit code 1 where anything got worse.",
    ),
    "site": Verb(
        "results",
        "sysid_bench.apps.site.commands.site:Site",
        "Write a static site of runs: suites, robots, methods, leaderboard.json.",
    ),
    "record": Verb(
        "results",
        "sysid_bench.commands.record:Record",
        "Execute a cell again and write its recording for the Rerun viewer.",
    ),
    "view": Verb("results", "sysid_bench.commands.record:View", "Open the recording of a cell."),
    "init": Verb("own", "", "Write a first file of your own, with guesses and doubts as comments."),
    "init estimator": Verb(
        "own",
        "sysid_bench.commands.init:InitEstimator",
        "Write an estimator of one's own, with the class NAME.",
    ),
    "init log": Verb(
        "own",
        "sysid_bench.commands.init_log:InitLog",
        "Write the description of a recording: its columns, units and time are guessed.",
    ),
    "init robot": Verb(
        "own",
        "sysid_bench.commands.init_robot:InitRobot",
        "Write a robot folder from a URDF or MJCF file, or from a Denavit-Hartenberg table.",
    ),
    "init suite": Verb(
        "own",
        "sysid_bench.commands.init:InitSuite",
        "Write a suite of one robot and two methods.",
    ),
    "help": Verb(
        "own",
        "sysid_bench.commands.help:Help",
        "Print the reference: a topic, or what has a name in any.",
    ),
    "list": Verb("own", "sysid_bench.commands.list:List", "List the names of a KIND."),
    "show": Verb(
        "own",
        "sysid_bench.commands.show:Show",
        "Show one robot, payload, plug-in, suite, data set or motor.",
    ),
    "check-plugin": Verb(
        "own",
        "sysid_bench.commands.check_plugin:CheckPlugin",
        "Check a plug-in against the laws of its kind.",
    ),
    "doctor": Verb("own", "sysid_bench.commands.doctor:Doctor", "Check this machine."),
    "completion": Verb(
        "own",
        "sysid_bench.commands.completion:Completion",
        "Print the script that completes verbs, options and names in a shell; default: this shell.",
    ),
}
"""Verbs of this package, those of each group in the order of their use."""


def all_verbs() -> dict[str, Verb]:
    """Return all verbs; those of other packages come last and replace none."""
    from sysid_bench.commands.stored import stored  # reading metadata takes 40 ms, of all packages

    return _of_packages(stored("commands", _entry_points)) | dict(VERBS)


def find_verb(name: str) -> Verb | None:
    """Return the verb of a name; other packages are asked for one that is not of this package."""
    return VERBS.get(name) or _of_packages(_entry_points()).get(name)


def _of_packages(points: Iterable[Sequence[str]]) -> dict[str, Verb]:
    """Verbs of other packages, by their entry points alone: none is imported."""
    return {
        name: Verb("other", target, f"Verb of the package {package}.")
        for name, target, package in points
    }


def _entry_points() -> list[list[str]]:
    """[name, target, package] of each entry point of the group."""
    from importlib.metadata import entry_points

    return [
        [point.name, point.value.partition("[")[0].strip(), point.dist.name if point.dist else "?"]
        for point in entry_points(group=ENTRY_POINTS)
    ]
