"""Kinds of the files of a run folder, read by every verb that takes a run."""

import os
import re
import shlex
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

from matplotlib.figure import Figure

from sysid_bench import merge, open_run, report
from sysid_bench.commands.report import table
from sysid_bench.commands.status import cell, status
from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite
from tests.faults import fuzz_seeds as seeds
from tests.faults.fuzz_kind import Kind, every
from tests.faults.fuzz_options import command, word

_REPORTED: Final = 8
_DRAWN: Final = 32
"""Of as many inputs one is reported, and drawn: these take the most of the time."""


def _make_run(folder: Path) -> None:
    path = folder / "run"
    run(parse_suite(seeds.RUN, folder=folder), path, jobs=1)
    report(path)
    note = path / "artifacts" / open_run(path).plan.cells[0].id / "no_recording.txt"
    note.parent.mkdir(parents=True)
    note.write_text("The cell cannot be recorded.")
    (folder / "text").write_text(seeds.RUN_COMMANDS)


def _run_folder(folder: Path) -> None:
    path, number = folder / "run", zlib.crc32(folder.name.encode())
    every((
        lambda: status(path).summary(),
        lambda: table(path, "main", ("md", "csv", "latex")[number % 3]),
        lambda: cell(path, open_run(path).planned[0]).summary() if open_run(path).planned else None,
        lambda: open_run(path).environment,
        *[lambda: _with_few_drawings(folder, lambda: report(path))] * (number % _REPORTED == 0),
    ))  # fmt: skip


def _with_few_drawings(folder: Path, read: Callable[[], object]) -> None:
    """Read where figures of one input in some are drawn."""
    with ExitStack() as stack:
        if zlib.crc32(folder.name.encode()) % _DRAWN:
            stack.enter_context(patch.object(Figure, "savefig", _undrawn))
        read()


def _undrawn(figure: Figure, out: Any, **settings: object) -> None:
    out.write(b"<svg></svg>")


def _merged(folder: Path) -> None:
    _with_few_drawings(folder, lambda: merge([folder / "run"], folder / "merged"))
    status(folder / "merged").summary()


def _commands(folder: Path) -> None:
    """One of the commands, that which the damage chose, as a shell splits its words."""
    os.chdir(folder)
    text = word(folder)
    lines = re.sub("\0", "", text).split("\n")
    line = lines[zlib.crc32(text.encode(errors="surrogateescape")) % len(lines)]
    _with_few_drawings(folder, lambda: command(_words(line)))


def _words(line: str) -> list[str]:
    try:
        return shlex.split(line)
    except ValueError:  # an open quote, which a shell waits to be closed
        return line.split()


def _run_kind(name: str, *damaged: str) -> Kind:
    return Kind(name, _make_run, damaged, _run_folder)


RUN_KINDS: Final = (
    _run_kind("plan.jsonl", "run/plan.jsonl"),
    _run_kind("run.toml", "run/run.toml"),
    _run_kind("env.json", "run/env.json"),
    _run_kind("rows", "run/cells/*.jsonl"),
    _run_kind("run-parquet", "run/*.parquet"),
    _run_kind("consolidated.json", "run/consolidated.json"),
    _run_kind("run-notes", "run/artifacts/*/*.txt", "run/logs/*", "run/tables/*"),
    Kind("merge", _make_run, ("run/*.json*", "run/run.toml", "run/cells/*"), _merged),
    Kind("options-of-runs", _make_run, ("text",), _commands, places=False),
    Kind("resume", _make_run, ("run/.lock", "run/*.json", "run/*.parquet", "run/logs/*"),
         lambda folder: run(folder / "run")),
)  # fmt: skip
