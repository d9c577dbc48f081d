"""Runs: plan, execute, look at, reproduce."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.verbs.folders import find_cell, open_run

if TYPE_CHECKING:
    from sysid_bench.harness.plan import Plan
    from sysid_bench.harness.run import Rerun, RunResult
    from sysid_bench.harness.work.supervisor import OnEvent


def plan(
    suite: str | Path,
    select: str | None = None,
    overrides: Mapping[str, str] | None = None,
    robots_dir: Path | None = None,
) -> "Plan":
    """The cells of a suite, every name resolved; nothing runs. UsageError with all its errors."""
    from dataclasses import replace

    from sysid_bench import places
    from sysid_bench.harness.plan import expand
    from sysid_bench.harness.suite.load_suite import load_suite
    from sysid_bench.harness.suite.names import installed_names

    names = installed_names(robots_dir)
    whole = expand(load_suite(places.suite(str(suite)), names, overrides), names)
    cells = whole.select(select)
    why = whole.missing_values(select) if select and not cells else ()
    return replace(whole, cells=cells, notes=(*whole.notes, *why))


def run(
    suite: str | Path,
    out: str | Path | None = None,
    jobs: int | None = None,
    select: str | None = None,
    limit: int | None = None,
    timeout: float | str | None = None,
    rerun: "Rerun | None" = None,
    fail_fast: bool = False,
    record: str | None = None,
    overrides: Mapping[str, str] | None = None,
    robots_dir: Path | None = None,
    on_event: "OnEvent | None" = None,
) -> "RunResult":
    """Runs a suite (or goes on with a run folder), then writes its tables, figures, recordings and
    report. `record`: an expression of cells to record instead of the suite's own choice."""
    from sysid_bench.harness.run import run as execute
    from sysid_bench.verbs.recordings import record_chosen
    from sysid_bench.verbs.reports import report

    result = execute(
        Path(suite) if Path(suite).is_dir() else str(suite),
        None if out is None else Path(out),
        jobs=jobs, select=select, limit=limit, timeout=timeout, rerun=rerun, fail_fast=fail_fast,
        on_event=on_event, robots_dir=robots_dir, overrides=overrides,
    )  # fmt: skip
    if result.counts and result.exit_code != 130:
        record_chosen(result.folder, record, robots_dir)
        report(result.folder.path)
    return result


def status(folder: str | Path) -> dict[str, Any]:
    """How far a run is: planned cells, rows by status, and reasons with their counts."""
    from collections import Counter

    run_folder = open_run(folder)
    stored = run_folder.rows().rows
    planned = [cell.id for cell in run_folder.plan.cells]
    rows = [stored[cell] for cell in planned if cell in stored]
    reasons = Counter(
        (row["status"], row.get("reason") or "") for row in rows if row["status"] != "ok"
    )
    return {
        "folder": str(run_folder.path),
        "cells": len(planned),
        "open": len(planned) - len(rows),
        "statuses": dict(Counter(row["status"] for row in rows)),
        "reasons": [
            {"status": kind, "reason": reason, "cells": n}
            for (kind, reason), n in reasons.most_common()
        ],
    }


def cell(folder: str | Path, identifier: str) -> dict[str, Any]:
    """One row, with the exact command that reproduces it. A unique beginning of an id will do."""
    run_folder = open_run(folder)
    full = find_cell(run_folder, identifier)
    row = run_folder.rows().rows.get(
        full, {"id": full, "status": "open", "reason": "has not run yet"}
    )
    place = shlex.quote(str(run_folder.path))
    command = f"sysid-bench run {place} --select 'id == \"{full}\"' --rerun all"
    return {**row, "command": command}
