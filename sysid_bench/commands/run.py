"""Verb `run`: the cells of a suite executed, then tables, figures, recordings and report."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from sysid_bench.commands.plan import large_option, overrides_option
from sysid_bench.commands.request import (
    INTERRUPTED,
    Request,
    argument,
    option,
    python_function,
    robots_option,
)
from sysid_bench.commands.result import OMIT_NONE, Result
from sysid_bench.commands.values import parse_condition
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.commands.claims import ClaimsResult
    from sysid_bench.commands.gate import GateResult
    from sysid_bench.harness.stored_run import RunFolder


class Run(Request["RunResult"]):
    """Run a suite, or resume a run; then write its tables, figures and report.

    Exit codes: 0 ok, 1 a cross-check or a gate failed or a baseline is not kept, 2 wrong usage or
    suite, or rows cannot be stored, 3 some cells failed, timed out, crashed, are over their memory
    or lost, 4 nothing selected or measured, 5 the scheduler or all workers elsewhere are gone (the
    run is resumable), 130 interrupted and resumable.
    """

    has_json = False

    suite: str | Path = argument("SUITE|RUN", complete="suites runs files")
    out: str | Path | None = option(
        "Run folder; default reports/<suite>.",
        default=None, flags="-o --out", path="new", complete="files",
    )  # fmt: skip
    jobs: int | None = option(
        "Workers; default one per core.", default=None, flags="-j --jobs", least=1
    )
    select: str | None = option(
        "Only cells that meet this expression.",
        default=None, parse=parse_condition, complete="fields",
    )  # fmt: skip
    limit: int | None = option("Only the first N cells.", default=None, least=1)
    timeout: float | str | None = option(
        "Hard limit per cell.", default=None, metavar="60s", parse=str
    )
    rerun: Literal["failed", "stale", "all"] | None = option(
        "Run these cells again.", default=None, choices=("failed", "stale", "all")
    )
    fail_fast: bool = option("Stop at the first failure.", default=False)
    record: str | None = option(
        "Record cells that meet this expression.",
        default=None, metavar="SPEC", parse=parse_condition, complete="fields",
    )  # fmt: skip
    overrides: Mapping[str, str] | None = overrides_option()
    robots_dir: Path | None = robots_option()
    on_event: Callable[[str, Mapping[str, Any]], None] | None = field(default=None, kw_only=True)
    shard: str | None = option(
        "Only part I of N, of equal expected costs.", default=None, metavar="I/N"
    )
    large: bool = large_option()
    baseline: str | Path | None = option(
        "Compare with this baseline; exit code 1 where anything got worse.",
        default=None, path="new", complete="files",
    )  # fmt: skip
    times: bool = option("Compare times, too, as ratios within a run.", default=False)
    gate: bool = option("Exit code 1 unless claims with gate = true hold.", default=False)
    executor: str = option(
        "Where cells are computed; dask+tls:// for other hosts.",
        default="local", metavar="local|dask://HOST:PORT|slurm:FILE", complete="executors",
    )  # fmt: skip

    def run(self) -> "RunResult":
        """Run a suite (or resume a run folder), then write its tables, figures, recordings and
        report.

        `jobs`: workers (default: one per core); `limit`: the first selected cells; `timeout` per
        cell; `rerun`: "failed", "stale" or "all"; `fail_fast` ends at the first failure; `record`:
        an expression of cells to record instead of the suite's own choice; `shard`: "2/8", a part
        of the plan for one of several machines, whose runs `merge` joins; `large` admits more than
        a million cells; `baseline`: a file that the run is compared with (the selected cells
        alone), `times` included; `gate`: the exit code is 1 unless all claims with `gate = true`
        hold; `executor`: where cells are computed ("dask://HOST:PORT", "slurm:FILE" or a plug-in).
        Raises UsageError before anything runs.
        """
        from sysid_bench.commands.baseline import known_baseline
        from sysid_bench.commands.gate import gate_run
        from sysid_bench.harness.plan import Shard
        from sysid_bench.harness.run import run as execute
        from sysid_bench.input_files import is_folder

        if self.times and self.baseline is None:
            raise UsageError("--times compares with a baseline; name it with --baseline FILE.")
        known = None
        if self.baseline is not None:
            known = known_baseline(self.baseline, times=self.times)
        suite = Path(self.suite)
        outcome = execute(
            # A text may be the name of a suite of the package, which is not a path.
            suite if is_folder(suite) else str(self.suite),
            None if self.out is None else Path(self.out),
            shard=None if self.shard is None else Shard.parse(self.shard),
            jobs=self.jobs, select=self.select, limit=self.limit, timeout=self.timeout,
            rerun=self.rerun, fail_fast=self.fail_fast, on_event=self.on_event,
            robots_dir=self.robots_dir, overrides=self.overrides, large=self.large,
            executor=self.executor,
        )  # fmt: skip
        result = RunResult(**vars(outcome))
        if not result.is_complete:
            return result
        # Before the gate, which may raise: the report is there in any case.
        result = self._reported(result)
        if known is None:
            return result
        # Cells that were not asked for are not missing.
        part = bool(self.select or self.limit or self.shard)
        file, times = str(self.baseline), self.times
        compared = gate_run(result.folder, known, file, partial=part, times=times)
        code = result.exit_code or int(not compared.ok)
        return replace(result, gate=compared, exit_code=code)

    def _reported(self, result: "RunResult") -> "RunResult":
        """The result with its claims, when recordings and report are written."""
        from sysid_bench.commands.claims import claims_of
        from sysid_bench.commands.record import record_selection, recording_notes
        from sysid_bench.commands.report import report

        record_selection(result.folder, self.record, self.robots_dir)
        report(result.folder.path)
        tested = claims_of(result.folder)
        fails = self.gate and tested is not None and not tested.ok
        return replace(
            result,
            exit_code=result.exit_code or int(fails),
            notes=(*result.notes, *recording_notes(result.folder)),
            claims=tested,
        )

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.progress import run_progress
        from sysid_bench.commands.terminal import terminal_output

        with run_progress() as on_event:
            result = replace(self, on_event=on_event).run()
        summary = result.summary()
        is_empty = not result.is_complete
        click.echo(summary if is_empty else terminal_output(summary), err=is_empty)
        return result.exit_code


run = python_function(Run, "run")


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(Result):
    """Outcome of the selected cells: `counts` by status, `open` without a row, `asked` to run."""

    folder: "RunFolder"
    counts: Mapping[str, int]
    open: int
    asked: int
    exit_code: int
    notes: tuple[str, ...]
    gate: "GateResult | None" = field(default=None, metadata=OMIT_NONE)
    claims: "ClaimsResult | None" = field(default=None, metadata=OMIT_NONE)

    @property
    def is_complete(self) -> bool:
        """True for a run that has rows and was not interrupted."""
        return bool(self.counts) and self.exit_code != INTERRUPTED

    def summary(self) -> str:
        """Tables of the run, counts, notes and the path of its report."""
        from sysid_bench.commands.run_report import summary_tables
        from sysid_bench.commands.status import reason_lines, status_counts

        folder = self.folder.path
        if self.exit_code == INTERRUPTED:
            return f"Interrupted; the same command resumes the run. Rows are in {folder}."
        if not self.counts:
            notes = " ".join(self.notes)
            if self.exit_code == 0:  # a shard without cells
                return notes
            return f"No cell was selected; see 'sysid-bench plan'. {notes}".rstrip()
        lines = [
            *summary_tables(folder),
            *([] if self.claims is None else [self.claims.summary() + "\n"]),
            status_counts(self.counts) + (f", {self.open} open" if self.open else ""),
            *reason_lines(self.folder, {*self.counts} - {"ok"}),
            *self.notes,
            f"report: {folder / 'report.html'}",
            *([] if self.gate is None else [self.gate.summary()]),
        ]
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        more = {"gate": self.gate, "claims": self.claims}
        own = {key: part.to_dict() for key, part in more.items() if part is not None}
        return super()._fields() | {"folder": str(self.folder.path)} | own
