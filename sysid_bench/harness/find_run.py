"""Run folders that a user may mean."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Final

from sysid_bench.errors import SHOWN, UsageError, first_names
from sysid_bench.input_files import is_file, is_folder

_LOOKED_AT: Final = 500
"""Folders of one place; those of a large disk are not all looked at."""
_PLACES: Final = (Path(), Path("reports"), Path("runs"))
PLAN: Final = "plan.jsonl"
"""The file that makes a folder a run."""


def run_names(*places: Path) -> list[str]:
    """Runs in `places`, and in this folder, reports/ and runs/, each once, sorted."""
    return sorted({str(run) for folder in {*_PLACES, *places} for run in _runs_in(folder)})


def missing_run(path: Path) -> UsageError:
    """What a path is in place of a run, the runs that there are, and how to make one."""
    if is_folder(path):
        why = f"it has no {PLAN}"
    else:
        why = "it is a file" if is_file(path) else "there is no such folder"
    runs = run_names(path.parent)
    there = f" Runs: {first_names(runs, SHOWN)}." if runs else ""
    start = f"sysid-bench run SUITE -o {'FOLDER' if is_file(path) else path}"
    return UsageError(f"{str(path)!r} is not a run: {why}.{there} Start one with '{start}'.")


def _runs_in(folder: Path) -> Iterator[Path]:
    try:
        for path in islice(folder.iterdir(), _LOOKED_AT):
            if is_file(path / PLAN):
                yield path
    except (OSError, ValueError):  # a name with a NUL is none of a folder
        return
