"""Pages of reports/reference from their commands: `python -m reports.make.reference_reports
[--stored] [PAGE...]`, as `make reference REPORTS="PAGE ..."`.

A part of a page between `<!-- made by: COMMAND -->` and `<!-- end -->` is what the command prints,
with its origin; all else is text. A run stays in its folder below reports/ and is resumed there,
and one of its rows is kept beside the pages (`reports/reference/rows`), which
tests/test_reference_reports.py computes again, see reports/make/kept_rows.py. `--stored`: pages
from the rows that are there; `--spread`: nothing but the designs and the spread of kept rows.
"""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final

import click

import sysid_bench
from reports.make.kept_rows import designs, differing, spread_of
from reports.make.page_numbers import PART
from reports.make.reference_check import keep, later_changes, load, made_part, with_declaration
from sysid_bench import package_folders
from sysid_bench.canonical_json import canonical_hash
from sysid_bench.commands.run_folder import open_run
from sysid_bench.experiments.third_party import third_party_parts
from sysid_bench.harness.run import job_of
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.types import Row
from sysid_bench.version_fields import environment
from sysid_bench.words import MACHINE_FIELDS
from tests.experiments.experiment_world import rows_of

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = ROOT / "reports" / "reference"
ROWS: Final = PAGES / "rows"
NOT_SCORES: Final = MACHINE_FIELDS | {
    *("fingerprint", "versions", "sources", "traceback", "stats", "reason", "losses"),
    *("joints", "parameters_table", "rank_gap", "native_reason", "repairs"),
}
"""Fields of a row that say nothing of a result, or are tables of their own."""
_RUN: Final = "sysid-bench run "
_MADE: Final = (0, 1, 3)
"""Exit codes of runs whose rows are all there: ok, a gate or cross-check, some cells failed."""
_ROUNDING: Final = 1e-9
_PLACE: Final = "SUITE_FOLDER"


@dataclass(frozen=True)
class RunCommand:
    """The suite, selection, changed keys and run folder of a command."""

    suite: str
    select: str | None
    overrides: Mapping[str, str]
    folder: Path

    @classmethod
    def parse(cls, command: str) -> "RunCommand":
        """Read "sysid-bench run SUITE [-o RUN] [--select E] [--set KEY=VALUE]..."."""
        words = shlex.split(command)[2:]
        options = list(zip(words[1::2], words[2::2], strict=True))
        select = dict(options).get("--select")
        changes = dict(value.split("=", 1) for name, value in options if name == "--set")
        folder = dict(options).get("-o", f"reports/{words[0].replace('/', '-')}")
        return cls(words[0], select, changes, ROOT / folder)

    @property
    def witness(self) -> Path:
        """File of the row that is kept."""
        return ROWS / f"{self.folder.name}.json"

    def planned(self) -> str:
        """Hash of the ids of the cells that the suite plans now."""
        plan = sysid_bench.plan(self.suite, self.select, self.overrides, no_code=True)
        return id_hash(cell.id for cell in plan.cells)


def id_hash(ids: Iterable[str]) -> str:
    """12 hex digits of the ids of cells."""
    return canonical_hash(sorted(ids))[:12]


def scores(row: Row) -> Row:
    """The fields of a row that another computation has to give again."""
    return {k: v for k, v in row.items() if k not in NOT_SCORES and v is not None}


@click.command()
@click.argument("names", nargs=-1, metavar="[PAGE]...")
@click.option("--stored", is_flag=True, help="Run nothing; draw from the rows that are there.")
@click.option("--spread", is_flag=True, help="Designs and spread of the kept rows alone.")
def main(names: tuple[str, ...], stored: bool, spread: bool) -> None:
    """Make pages of reports/reference again, by default those that are older than their code."""
    for page in [PAGES / f"{name}.md" for name in names] or sorted(PAGES.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if not (names or spread or later_changes(load().get(page.stem, []))):
            continue
        if spread:
            measure_rows(page.name)
        elif PART.search(text):
            print(page.relative_to(ROOT), flush=True)
            for part in PART.finditer(text):  # each at once: the next may take hours, or fail
                made = part_text(part, page.name, stored=stored)
                text = page.read_text(encoding="utf-8").replace(part[0], made)
                later = later_changes(load().get(page.stem, []))
                page.write_text(with_declaration(page.stem, text, later), encoding="utf-8")


def part_text(part: re.Match[str], page: str, *, stored: bool) -> str:
    """A part of a page, made again."""
    command = part[1]
    if stored and not has_rows(command):
        return part[0]
    env = environment()
    if command.startswith(_RUN):
        text = run_text(command, page, stored=stored)
        env = open_run(RunCommand.parse(command).folder).environment
    else:
        text = output(command, (0,))
        if command.startswith("python "):
            text = f"```\n{command}\n```\n\n{machine_text(env)} {date.today()}.\n\n{text}"
    if env["git"] is None or env["git"]["dirty"]:
        raise SystemExit(f"{command}: of a checkout with changes; commit them and run it again.")
    keep(Path(page).stem, made_part(command, text, env["git"]["commit"]))
    return f"<!-- made by: {command} -->\n{text.strip()}\n\n<!-- end -->"


def has_rows(command: str) -> bool:
    """True for a command on a run folder that is there."""
    if command.startswith(_RUN):
        return RunCommand.parse(command).folder.is_dir()
    return any(w.startswith("reports/") and (ROOT / w).is_dir() for w in shlex.split(command))


def output(command: str, codes: tuple[int, ...]) -> str:
    """Return the output of a command; SystemExit for an exit code that is not one of these."""
    first, *rest = shlex.split(command)
    folder = Path(sys.executable).parent
    words = [sys.executable if first == "python" else str(folder / first), *rest]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "COLUMNS": "100"}
    )
    if done.returncode not in codes:
        raise SystemExit(f"{command}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    return done.stdout


def run_text(command: str, page: str, *, stored: bool) -> str:
    """The origin of the rows of a run, whose witness is kept."""
    asked = RunCommand.parse(command)
    if not stored:
        output(command, _MADE)
    run = open_run(asked.folder)
    rows = run.rows().rows
    ROWS.mkdir(exist_ok=True)
    kept = witness(run, rows) | {"page": page, "command": command, "planned": asked.planned()}
    write_row(asked.witness, kept)
    return f"```\n{command}\n```\n\n{origin_text(run, rows)}\n"


def origin_text(run: RunFolder, rows: Mapping[str, Row]) -> str:
    """Number and hash of the rows, their date, commit, versions and processor."""
    kept = [rows[cell] for cell in run.planned if cell in rows]
    count = f"{len(kept)} of {len(run.planned)} cells" if len(kept) < len(run.planned) else ""
    last = max(file.stat().st_mtime for file in (run.path / "cells").glob("*.jsonl"))
    return (
        f"{count or f'{len(kept)} cells'}, hash of their scores {rows_hash(kept)}. "
        f"{machine_text(run.environment)} {date.fromtimestamp(last)}."
    )


def rows_hash(rows: Iterable[Row]) -> str:
    """12 hex digits of the scores of all rows with their ids."""
    return canonical_hash(sorted((scores(row) for row in rows), key=lambda row: row["id"]))[:12]


def machine_text(env: Mapping[str, Any]) -> str:
    """Commit, versions and processor, of env.json or of here."""
    versions = ", ".join(f"{name} {version}" for name, version in env["versions"].items())
    git = env["git"] or {"commit": "unknown", "dirty": False}
    commit = git["commit"][:8] + (" with changes" if git["dirty"] else "")
    return (
        f"Commit {commit}, Python {env['python']}, {versions}; {env['cpu']} "
        f"({env['instructions'][-1]}), {env['blas']};"
    )


def witness(run: RunFolder, rows: Mapping[str, Row]) -> Row:
    """The cheapest row of a run with an answer, of those printed in a table where there are any:
    its specification, its scores, and the table's number."""
    answered = {cell: row for cell, row in rows.items() if row["status"] == "ok"}
    sound = {cell: row for cell, row in answered.items() if is_typical(row)} or answered
    printed = dict(printed_entries(run, sound))
    cell = min(printed or sound, key=lambda one: cpu_seconds(rows[one]))
    (planned,) = (one for one in run.plan.cells if one.id == cell)
    job = job_of([planned], run.suite, None) | {"papers": {}}
    text = json.dumps(job).replace(str(run.suite.folder), _PLACE)
    return {
        "commit": (run.environment["git"] or {}).get("commit"),
        "rows_hash": rows_hash(rows.values()),
        "job": json.loads(text),
        "row": scores(rows[cell]),
        "printed": printed.get(cell),
    }


def is_typical(row: Row) -> bool:
    """True for a row of a method whose data are not exact."""
    error = row.get("torque_error", row.get("rollout_error"))
    is_method = str(row["estimator"]).split()[0] != "prior"
    return is_method and (error is None or error > _ROUNDING)


def cpu_seconds(row: Row) -> float:
    """CPU time (s) of a row and of the data of its experiment."""
    return float(row.get("seconds_cpu") or 0.0) + float(row.get("seconds_experiment_cpu") or 0.0)


def printed_entries(run: RunFolder, rows: Mapping[str, Row]) -> Iterator[tuple[str, Row]]:
    """Yield cells whose score stands in a table of the run, as the median or an extreme, with the
    table's name and the metric."""
    for entry in run.suite.table:
        values = dict[tuple[str, float], str]()
        for cell, row in rows.items():
            for name, value in scores(row).items():
                if isinstance(value, float):
                    values[name, value] = cell
        for one in json.loads(sysid_bench.table(run.path, entry.name, "json"))["entries"]:
            cell = values.get((one["metric"], one["value"]), "")
            if cell and one["value"] not in (0.0, 1.0):
                yield cell, {"table": entry.name, "metric": one["metric"]}


def job_of_witness(kept: Row) -> Row:
    """The argument of `execute` for a kept row, with the folder of its suite here."""
    folder = package_folders.suite(RunCommand.parse(kept["command"]).suite).parent
    job = json.loads(json.dumps(kept["job"]).replace(_PLACE, str(folder)))
    return dict(job | {"third_party": third_party_parts(job)})


def measure_rows(page: str) -> None:
    """Measure the spread of the kept rows of a page again."""
    for file in sorted(ROWS.glob("*.json")):
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["page"] == page:
            print(file.relative_to(ROOT), flush=True)
            write_row(file, kept)


def write_row(file: Path, kept: Row) -> None:
    """Write a kept row with its designed motions and its spread; SystemExit for a row that does not
    come out again here."""
    job = job_of_witness(kept)
    with designs(kept.get("designs")) as found:
        (again,) = rows_of(job)
        if apart := differing(kept["row"], scores(again), kept.get("spread")):
            raise SystemExit(f"{file.name} does not come out again: {'; '.join(apart)}")
        kept = kept | {"spread": spread_of(kept["row"], job)}
        kept["designs"] = [C.tolist() for C in found.values()]
    file.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
