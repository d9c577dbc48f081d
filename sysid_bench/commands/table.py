"""Table of the verbs: group and request, which is imported when it is asked for.

Other packages add verbs by the entry-point group `sysid_bench.commands`: name = "module:Request".
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
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
_PACKAGE: Final = Path(__file__).parents[1]
_DOCSTRING: Final = re.compile(
    r'^class (\w+)\([^\n]*\n    """(.+?)(?:"""|\n\n)', re.MULTILINE | re.DOTALL
)
"""Name of a class, and the first paragraph of its docstring."""


@dataclass(frozen=True)
class Verb:
    """A verb: `target` is "module:Request". Without a target the verb is the word before those that
    begin with it, as "baseline" of "baseline save", and has its own `words`."""

    group: str
    target: str
    words: str = ""

    @property
    def sentence(self) -> str:
        """The first sentence of its help."""
        module, _, name = self.target.partition(":")
        return self.words or _first_paragraphs(module)[name]


@cache
def _first_paragraphs(module: str) -> dict[str, str]:
    """First paragraph of the docstring of each request of a module of this package, which is read
    and not imported: help of all verbs would take a second. A request of the shell has that of the
    request whose name it has before "Command"."""
    text = (_PACKAGE.parent / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
    found = {name: " ".join(words.split()) for name, words in _DOCSTRING.findall(text)}
    return {f"{name}Command": words for name, words in found.items()} | found


_TARGETS: Final[Mapping[str, Mapping[str, str]]] = {
    "models": {
        "crosscheck": "commands.crosscheck:Crosscheck",
        "lint": "commands.lint:Lint",
        "basis": "commands.basis:BasisCommand",
        "frames": "commands.frames:Frames",
        "survey": "apps.surveys.commands.survey:SurveyCommand",
    },
    "identification": {
        "identify": "commands.identify:IdentifyCommand",
        "excite": "commands.excite:ExciteCommand",
        "online": "commands.online:Online",
    },
    "recordings": {
        "diagnose": "commands.diagnose:DiagnoseRequest",
        "twin": "apps.twins.commands.twin:TwinCommand",
        "transfer": "apps.twins.commands.transfer:TransferRequest",
        "fetch": "commands.fetch:Fetch",
    },
    "suites": {
        "plan": "commands.plan:Plan",
        "run": "commands.run:Run",
        "merge": "commands.merge:Merge",
        "status": "commands.status:Status",
    },
    "results": {
        "report": "commands.report:Report",
        "compare": "commands.compare:CompareCommand",
        "table": "commands.report:Table",
        "figure": "commands.figure:Figure",
        "cells": "commands.cells:CellsCommand",
        "cell": "commands.status:Cell",
        "claims": "commands.claims:ClaimsCommand",
        "limits": "apps.twins.commands.limits:Limits",
        "baseline": "",
        "baseline save": "commands.baseline:BaselineSave",
        "baseline update": "commands.baseline:BaselineUpdate",
        "gate": "commands.gate:GateCommand",
        "site": "apps.site.commands.site:Site",
        "record": "commands.record:Record",
        "view": "commands.record:View",
    },
    "own": {
        "init": "",
        "init estimator": "commands.init:InitEstimator",
        "init log": "commands.init_log:InitLog",
        "init robot": "commands.init_robot:InitRobot",
        "init suite": "commands.init:InitSuite",
        "help": "commands.help:Help",
        "list": "commands.list:List",
        "show": "commands.list:Show",
        "check-plugin": "commands.check_plugin:CheckPlugin",
        "doctor": "commands.doctor:Doctor",
        "completion": "commands.completion:Completion",
    },
}
"""Requests of the verbs by group, in the order of their use."""
_WORDS: Final[Mapping[str, str]] = {
    "baseline": "Write the values of a run into a small file that later runs are compared with.",
    "init": "Write a first file of your own, with guesses and doubts as comments.",
}
VERBS: Final[Mapping[str, Verb]] = {
    name: Verb(group, target and f"sysid_bench.{target}", _WORDS.get(name, ""))
    for group, verbs in _TARGETS.items()
    for name, target in verbs.items()
}
"""Verbs of this package."""


def all_verbs() -> dict[str, Verb]:
    """Return all verbs; those of other packages come last and replace none."""
    from sysid_bench.commands.stored import stored  # reading metadata takes 40 ms, of all packages

    # Ours last: a package cannot replace a verb of this one.
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
