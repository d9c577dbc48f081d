"""Verb `plan`: a suite validated and its cells counted; none of them runs."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sysid_bench.commands.request import (
    USAGE,
    Request,
    argument,
    option,
    python_function,
    robots_option,
)
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_condition, parse_entries
from sysid_bench.errors import SysidBenchError, count_text

if TYPE_CHECKING:
    from sysid_bench.experiments.spec import ExperimentSpec
    from sysid_bench.harness.cell import Cell


def overrides_option() -> Any:
    """--set, keys of the suite with other values."""
    return option(
        "Change a key of the suite.",
        default=None, flags="--set", metavar="KEY=VALUE", several=True,
        parse=lambda words: dict(parse_entries(words)),
    )  # fmt: skip


def large_option() -> Any:
    """--large, for suites beyond the usual size."""
    return option("Admit more than a million cells.", default=False)


class Plan(Request["PlanResult"]):
    """Validate a suite and count its cells; none of them runs.

    Third-party plug-ins are imported and made in a process of their own, unless --no-code.
    """

    suite: str | Path = argument("SUITE", complete="suites files")
    select: str | None = option(
        "Only cells that meet this expression.", default=None, complete="fields"
    )
    overrides: Mapping[str, str] | None = overrides_option()
    robots_dir: Path | None = robots_option()
    no_code: bool = option("Import no third-party plug-in.", default=False)
    large: bool = large_option()

    def run(self) -> "PlanResult":
        """Return the cells of a suite with every name resolved; no cell runs.

        `select`: an expression of cells; `overrides`: {key: value} of the suite; `large` admits
        more than a million cells. Third-party plug-ins are imported and built in a process of their
        own, or under `no_code` not at all: only that their file defines them is checked then, and a
        note names them. Raises UsageError with all errors of the suite.
        """
        from sysid_bench import package_folders
        from sysid_bench.harness.plan import cells_of_suite
        from sysid_bench.harness.run_time import run_time, stored_times
        from sysid_bench.harness.stored_run import run_names
        from sysid_bench.harness.suite.load_suite import code_note, load_suite, third_party_names
        from sysid_bench.harness.suite.names import static_names
        from sysid_bench.harness.worker_names import worker_names

        select = parse_condition(self.select)
        own = nullcontext(static_names(self.robots_dir))
        with own if self.no_code else worker_names(self.robots_dir) as names:
            loaded = load_suite(package_folders.suite(str(self.suite)), names, self.overrides)
        whole = cells_of_suite(loaded, names, large=self.large)
        selected = replace(whole, cells=whole.select(select))
        expected = run_time(selected.cells, stored_times(map(Path, run_names())))
        notes = [*whole.notes]
        if select and not selected.cells:
            notes += whole.unknown_values(select)
        plugins = third_party_names(loaded)
        if self.no_code and plugins:
            unseen = ", ".join(f"{kind} {name}" for kind, name in plugins)
            notes.append(f"Not imported, so that their settings are not checked: {unseen}.")
        return PlanResult(
            cells=selected.cells,
            experiments=selected.spec_list,
            excluded=whole.excluded,
            seconds=expected.seconds,
            seconds_from=expected.source,
            notes=tuple(notes),
            code="" if self.no_code else code_note(plugins),
        )

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json, print_result

        try:
            result = self.run()
        except SysidBenchError as error:
            if not as_json:
                raise
            counts = {"cells": 0, "experiments": 0, "excluded": {}, "seconds": 0}
            # Programs that asked for JSON get the mistakes as JSON, with the same exit code.
            print_json({**counts, "seconds_from": "", "errors": str(error).splitlines()})
            return USAGE
        if result.code:
            click.echo(result.code, err=True)
        print_result(result, as_json)
        return self.exit_code(result)


plan = python_function(Plan, "plan")


@dataclass(frozen=True, eq=False, repr=False)
class PlanResult(Result):
    """Cells of a suite. The attributes `cells` (in the order of the suite) and `experiments` (in
    the order of their first cell) hold the specifications; as a mapping and in JSON they are
    counts. `excluded`: cells by reason; `seconds`: expected CPU time of the whole run on one
    worker, and where that comes from, `seconds_from`; `notes` on the selection. The attribute
    `code` names the third-party code that the suite runs ("")."""

    cells: tuple["Cell", ...]
    experiments: tuple["ExperimentSpec", ...]
    excluded: Mapping[str, int]
    seconds: float
    seconds_from: str
    notes: tuple[str, ...]
    code: str = ""

    def summary(self) -> str:
        """Counts, exclusions and notes."""
        lines = [
            f"{count_text(len(self.cells), 'cell')} in "
            f"{count_text(len(self.experiments), 'experiment')}, "
            f"about {self.seconds:.0f} s of one core ({self.seconds_from})",
            *(
                f"{count_text(count, 'cell')} excluded: {reason}"
                for reason, count in self.excluded.items()
            ),
            *self.notes,
        ]
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        return {
            "cells": len(self.cells),
            "experiments": len(self.experiments),
            "excluded": dict(self.excluded),
            "seconds": self.seconds,
            "seconds_from": self.seconds_from,
            "errors": [],
            "notes": list(self.notes),
        }
