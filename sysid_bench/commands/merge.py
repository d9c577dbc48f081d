"""Verb `merge`: runs of one plan, as shards on several machines leave them, joined into one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sysid_bench.commands.request import Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import first_names


class Merge(Request["MergeResult"]):
    """Merge runs of one plan, such as shards, into one.

    Exit code 1 where they contradict each other: nothing is written then.
    """

    runs: Sequence[str | Path] = argument("RUN...", several=True, complete="runs folders")
    out: str | Path = option(
        "Folder of the merged run.", flags="-o --out", path="new", complete="files"
    )
    mixed: bool = option("Merge rows of different code, too.", default=False)

    def run(self) -> "MergeResult":
        """Merge runs of one plan into the folder `out`, and write its tables and report.

        Of several rows of a cell an ok row is kept before any other; contradicting ok rows, and
        rows that were changed, are an answer (exit code 1), and nothing is written. Raises
        UsageError for runs of different plans, for an `out` that is a run, and for rows of
        different code unless `mixed`.
        """
        from sysid_bench.commands.report import report
        from sysid_bench.harness.merge import merge as merge_runs

        merged = merge_runs([Path(run) for run in self.runs], Path(self.out), mixed=self.mixed)
        # Shards without a row have no table to write.
        if merged.folder is not None and merged.rows:
            report(merged.folder.path)
        folder = None if merged.folder is None else str(merged.folder.path)
        values = vars(merged) | {"folder": folder, "exit_code": merged.exit_code}
        return MergeResult(**values)

    def exit_code(self, result: "MergeResult") -> int:
        return result.exit_code


merge = python_function(Merge, "merge")


@dataclass(frozen=True, eq=False, repr=False)
class MergeResult(Result):
    """Merged run in `folder` (None where nothing is written): its rows, the cells still `open`,
    cells that several runs computed with equal results (`twice`), those of them that are equal up
    to the rounding of other processors (`rounded`), the ids of `contradictions`: cells whose ok
    rows differ by more, in two runs or in one, with `places` (file:line) of these rows by cell, and
    the places (file:line) of rows that were `changed` after they
    were written."""

    folder: str | None
    rows: int
    open: int
    twice: int
    rounded: int
    contradictions: tuple[str, ...]
    changed: tuple[str, ...]
    places: Mapping[str, Sequence[str]]
    exit_code: int

    def summary(self) -> str:
        """Counts and the path of the report, or the reasons why nothing is written."""
        if self.changed:
            return (
                f"{len(self.changed)} rows were changed after they were written: "
                f"{first_names(self.changed, 10)}. Nothing is written; run their runs again, which "
                "computes these cells alone."
            )
        if self.contradictions:
            named = [f"{cell} ({', '.join(at)})" for cell, at in self.places.items()]
            return (
                f"{len(named)} cells have rows with different results: {first_names(named, 10)}. "
                "Nothing is written; compare them with 'sysid-bench cell RUN ID', and remove the "
                "rows that do not hold."
            )
        counts = f"{self.rows} rows, {self.open} open, {self.twice} computed twice and equal"
        if self.rounded:
            counts += f" ({self.rounded} of them up to the rounding of another processor)"
        return f"{counts}\nrun: {self.folder}"
