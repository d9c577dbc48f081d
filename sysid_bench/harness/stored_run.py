"""Run folder: the frozen suite, the plan, the rows and their frames, and the lock of its writer.

While a run goes on, its frames are written by a process of its own: python -m
sysid_bench.harness.stored_run FOLDER PARENT.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import SHOWN, UsageError, first_names, reason_of
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.consolidate import PlannedFields, build_frames
from sysid_bench.harness.coverage import (
    COVERAGE_FILE,
    HEAD,
    UNREADABLE,
    FrameFiles,
    RowCounts,
    read_coverage,
)
from sysid_bench.harness.frames import Frames, data_frames
from sysid_bench.harness.plan import (
    Plan,
    RowTable,
    cell_at,
    offset_by_cell,
    planned_cells,
    planned_fields,
)
from sysid_bench.harness.suite.load_suite import HASHED, parse_stored, suite_text, with_rows
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.work.folder_lock import folder_lock
from sysid_bench.harness.work.process_tree import kill_with
from sysid_bench.harness.work.row_files import (
    RowStart,
    RowWriter,
    StoredRows,
    find_row,
    hash_error,
    lines,
    new_row_file,
    read_rows,
    row_files,
    rows_with_origin,
)
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.harness.work.worker_process import worker_environment
from sysid_bench.input_files import LARGEST, check_file, is_file, is_folder, parse_json, read_text
from sysid_bench.models.model_record import ModelRecord
from sysid_bench.types import Row

if TYPE_CHECKING:
    import pandas as pd


_LOOKED_AT: Final = 500
"""Folders of one place; those of a large disk are not all looked at."""
_PLACES: Final = (Path(), Path("reports"), Path("runs"))
PLAN: Final = "plan.jsonl"
"""The file that makes a folder a run."""
MODELS: Final = "models.json"


def run_names(*places: Path) -> list[str]:
    """Runs in `places`, and in this folder, reports/ and runs/, each once, sorted."""
    found = set[str]()
    for folder in {*_PLACES, *places}:
        with suppress(OSError, ValueError):  # a name with a NUL is not one of a folder
            found |= {str(p) for p in islice(folder.iterdir(), _LOOKED_AT) if is_file(p / PLAN)}
    return sorted(found)


def missing_run(path: Path) -> UsageError:
    """Error text for a path that is not a run: what it is, the known runs, and how to make one."""
    if is_folder(path):
        why = f"it has no {PLAN}"
    else:
        why = "it is a file" if is_file(path) else "there is no such folder"
    runs = run_names(path.parent)
    there = f" Runs: {first_names(runs, SHOWN)}." if runs else ""
    start = f"sysid-bench run SUITE -o {'FOLDER' if is_file(path) else path}"
    return UsageError(f"{str(path)!r} is not a run: {why}.{there} Start one with '{start}'.")


LARGEST_PLAN: Final = 2**31
"""Bytes of a plan: 2 kB for each of a million cells."""
FEW_BYTES: Final = 20_000_000
"""Size of row files from which on frames are made in bounded memory."""


@dataclass(frozen=True)
class RunFolder:
    """A folder with run.toml, plan.jsonl, env.json and cells/*.jsonl."""

    path: Path

    @classmethod
    def new(cls, path: Path, suite: Suite, plan: Plan, env: Mapping[str, Any]) -> "RunFolder":
        """Create a run; for an existing run with the same cells, update suite and labels.

        Raises UsageError where the folder holds a run of other cells, and where another runner
        makes or runs one.
        """
        folder = cls(path)
        path.mkdir(parents=True, exist_ok=True)
        # A run is made under its lock: of two runners that start together one writes the plan.
        with folder.lock():
            hashed = True
            if is_file(path / PLAN):
                # By cells, not by the text of the suite: another table or title is the same run.
                stored = {cell.id for cell in folder.plan.cells}
                planned = {cell.id for cell in plan.cells}
                if stored != planned:
                    keys = _different_keys(folder.suite.model_dump(), suite.model_dump())
                    raise UsageError(
                        f"{str(path)!r} holds another run: {len(stored - planned)} of its cells "
                        f"are not in this plan, and {len(planned - stored)} of this plan are not "
                        f"in it (different keys: "
                        f"{', '.join(keys) or 'the models behind the names'}). Choose another -o, "
                        "or remove the folder."
                    )
                hashed = cls(path).has_hashes  # its rows may be of an earlier version
            folder._fill(with_rows(suite, hashed=hashed), plan.to_json_lines(), env, plan.models)
        vars(folder)["plan"] = Plan(plan.cells)  # as its file has it, which need not be read
        return folder

    def write_plan(self, path: Path, env: Mapping[str, Any]) -> "RunFolder":
        """Write the suite and the plan of this run to a new one, which has no rows."""
        folder = RunFolder(path)
        try:
            suite = with_rows(self.suite, hashed=True)
            lines = (line.decode() for line in self._plan_lines())
            folder._fill(suite, lines, env, self.models)
        except UnicodeDecodeError as error:
            raise self._unreadable(PLAN, error) from error
        return folder

    def _fill(
        self,
        suite: Suite,
        plan: Iterable[str],
        env: Mapping[str, Any],
        models: Mapping[str, ModelRecord],
    ) -> None:
        (self.path / "cells").mkdir(parents=True, exist_ok=True)
        (self.path / "logs").mkdir(exist_ok=True)
        self.write("run.toml", suite_text(suite))
        # That of a run that goes on is the environment of its rows until it computes again.
        if not (self.path / "env.json").is_file():
            self.write_environment(env)
        self.write(MODELS, json.dumps(models) + "\n")
        self._write_parts(PLAN, plan)  # last: from now on it is a run

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open an existing run; raises UsageError where there is none."""
        if not is_file(path / PLAN):
            raise missing_run(path)
        return cls(path)

    def check_path(self) -> None:
        """Raise UsageError where Python looks for modules in this folder, of somebody else, whose
        numpy.py or sitecustomize.py would be part of the processes that hold the truth."""
        here = self.path.resolve()
        if any(Path(entry or os.getcwd()).resolve().is_relative_to(here) for entry in sys.path):
            raise UsageError(
                f"Python looks for modules in {str(self.path)!r}, and would take them for its own: "
                "leave that folder, or take it out of PYTHONPATH. Methods in it are named "
                "'file:mine.py:Mine'."
            )

    @cached_property
    def suite(self) -> Suite:
        """The suite as it was frozen."""
        return parse_stored(self._read("run.toml"), str(self.path / "run.toml"))

    @cached_property
    def has_hashes(self) -> bool:
        """True for a run that states that each of its rows has a hash; older ones state nothing."""
        origin = self.suite.origin
        return origin is not None and origin.rows == HASHED

    @cached_property
    def plan(self) -> Plan:
        """Every cell of the run."""
        return Plan.from_json_lines(self._plan_lines())

    @cached_property
    def planned(self) -> tuple[str, ...]:
        """Ids of the cells of the plan, which is not read as a whole."""
        return planned_cells(self._plan_lines())

    def cells_at(self, places: Iterable[int]) -> dict[int, Cell]:
        """Return the cells of the plan at some offsets, see `RowKind.cell`."""
        try:
            with (self.path / PLAN).open("rb") as plan:
                return {place: cell_at(plan, place) for place in places}
        except OSError as error:
            raise self._unreadable(PLAN, error) from error

    @property
    def environment(self) -> dict[str, Any]:
        """Versions, CPU, BLAS and git of the machine that last ran cells."""
        return self._read_object("env.json")

    @property
    def machines(self) -> list[dict[str, Any]]:
        """Entries of `environment` for each machine that has computed rows."""
        others = self.environment.get("machines", [])
        listed = others.values() if isinstance(others, dict) else others
        return [self.environment, *(one for one in listed if isinstance(one, dict))]

    @property
    def models(self) -> dict[str, ModelRecord]:
        """Records of the robots when the run was planned, by label; none in runs of before."""
        return self._read_object(MODELS) if is_file(self.path / MODELS) else {}

    def _read_object(self, name: str) -> dict[str, Any]:
        text = self._read(name)
        try:
            found = parse_json(text)
        except ValueError as error:
            raise self._unreadable(name, error) from error
        if not isinstance(found, dict):
            raise self._unreadable(name, "it is not a JSON object")
        return found

    @property
    def cells(self) -> "pd.DataFrame":
        """One line per row, in the order of the plan."""
        return self.frames().cells

    @property
    def parameters(self) -> "pd.DataFrame":
        """One line per cell and parameter."""
        return self.frames().parameters

    @property
    def joints(self) -> "pd.DataFrame":
        """One line per cell and joint."""
        return self.frames().joints

    @property
    def row_bytes(self) -> int:
        """Size of the row files."""
        return sum(path.stat().st_size for path in row_files(self._cells))

    def rows(self, cells: Collection[str] | None = None) -> StoredRows:
        """Read the rows stored so far, or those of some cells."""
        return read_rows(self._cells, cells=cells, hashed=self.has_hashes)

    def rows_with_origin(self) -> Iterator[tuple[Row | bytes, RowStart]]:
        """Yield each stored row and where it is, of other lines the text; of rows with one id the
        last holds."""
        return rows_with_origin(self._cells, hashed=self.has_hashes)

    def row(self, cell: str) -> Row | None:
        """Read the row of one cell; None where it has none."""
        return find_row(self._cells, cell, hashed=self.has_hashes)

    def first_fields(self) -> StoredRows:
        """Read the fields HEAD of the rows stored so far, as far as a row has them.

        They come from cells.parquet as far as it covers the row files.
        """
        rows: dict[str, Row] = {}
        start: Mapping[str, tuple[int, int]] = {}
        garbled: tuple[str, ...] = ()
        if (coverage := read_coverage(self.path, row_files(self._cells))) is not None:
            with suppress(*UNREADABLE):
                # A damaged file costs time and no row: the row files are read as a whole then.
                rows = FrameFiles(self.path, coverage).fields_of_rows(HEAD)
                start, garbled = coverage.start, coverage.garbled
        rest = read_rows(self._cells, start=start, fields=HEAD, hashed=self.has_hashes)
        rows |= rest.rows
        return StoredRows(rows, rest.torn, (*garbled, *rest.garbled))

    @cached_property
    def damaged(self) -> tuple[str, ...]:
        """Lines that are not rows of their writer any more ("file:line (cell id)"), damaged or
        changed afterwards, whose cell has no other row; without an id while any cell is open."""
        coverage = read_coverage(self.path, row_files(self._cells))
        start, known = (coverage.start, coverage.garbled) if coverage else ({}, ())
        rest = read_rows(self._cells, start=start, fields=HEAD[:1], hashed=self.has_hashes)
        places, found = (*known, *rest.garbled), []
        left = {*self.planned}.difference(self.first_fields().rows) if places else set[str]()
        for place in places if left else ():
            name, _, number = place.rpartition(":")
            line = next(islice(lines(self._cells / name), int(number) - 1, None)) if name else None
            cell = hash_error(line.text, hashed=self.has_hashes) if line else None
            if cell is None or cell in left:
                found.append(f"{place} (cell {cell})" if cell else place)
        return tuple(found)

    def row_counts(self) -> RowCounts:
        """Count the rows of planned cells; no row is read where a consolidation counted all."""
        coverage = read_coverage(self.path, row_files(self._cells))
        # Reading all rows took 7 s and 1.2 GB for 10,000 cells.
        if coverage and coverage.counts and not self._has_rows_behind(coverage.start):
            return coverage.counts
        return RowCounts.of(self._places, self.first_fields().rows)

    def frames(self) -> Frames:
        """Return data frames of the planned cells that have a row, with the labels of the plan.

        They are read from the Parquet files where these hold all rows, else made from the rows.
        """
        coverage = read_coverage(self.path, row_files(self._cells))
        if coverage is not None and not self._has_rows_behind(coverage.start):
            with suppress(*UNREADABLE):
                files = FrameFiles(self.path, coverage)

                def read(name: str, fields: Collection[str] | None) -> "pd.DataFrame":
                    try:
                        return files.read(name, fields)
                    except UNREADABLE:  # a damaged page: the row files decide
                        return self._frames_of_rows().read(name, fields)

                return Frames(read)
        return self._frames_of_rows()

    def write_frames(self) -> None:
        """Write cells.parquet, parameters.parquet and joints.parquet.

        Raises UsageError where the file system does not take them.
        """
        if find_spec("pyarrow") is None:  # the extra `parquet`: tables are made of the rows then
            return
        try:
            build_frames(self.path, self._plan_heads)
        except OSError as error:
            raise UsageError(
                f"The tables of {str(self.path)!r} cannot be written ({reason_of(error)}); all "
                "rows are stored. Make room, or remove what stands in place of its .parquet files "
                f"and {COVERAGE_FILE}, and run again."
            ) from error

    def _frames_of_rows(self) -> Frames:
        """Frames without the Parquet files; many rows are consolidated, here where that is allowed,
        else in a temporary folder."""
        if self.row_bytes <= FEW_BYTES or find_spec("pyarrow") is None:
            stored, heads = self.rows().rows, self.planned_fields
            return data_frames(stored[cell] | heads[cell] for cell in heads if cell in stored)
        # Not allowed while another runner has the lock, nor in a folder that is not ours to write.
        with suppress(UsageError, OSError), self.lock():
            coverage = build_frames(self.path, self._plan_heads)
            return Frames(FrameFiles(self.path, coverage).read)
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            coverage = build_frames(self.path, self._plan_heads, Path(name))
            return Frames(FrameFiles(Path(name), coverage).read)

    def _has_rows_behind(self, start: Mapping[str, tuple[int, int]]) -> bool:
        """True where planned cells have rows that the Parquet files do not cover."""
        rest = read_rows(self._cells, start=start, fields=HEAD[:1], hashed=self.has_hashes)
        return bool(rest.rows) and any(cell in rest.rows for cell in self.planned)

    @property
    def _cells(self) -> Path:
        return self.path / "cells"

    @cached_property
    def planned_fields(self) -> Mapping[str, Row]:
        """First fields of every planned cell, by id."""
        return RowTable(planned_fields(self._plan_lines()))

    @cached_property
    def _places(self) -> dict[str, int]:
        """`RowKind.cell` of every planned cell, by id."""
        return offset_by_cell(self._plan_lines())

    @property
    def _plan_heads(self) -> PlannedFields:
        return PlannedFields(self.planned_fields, self._places, self.has_hashes)

    def new_writer(self, writer: str) -> RowWriter:
        """Open a writer with a new file, for rows that no worker can write."""
        return RowWriter(new_row_file(self._cells, writer))

    def write_environment(self, env: Mapping[str, Any]) -> None:
        """Replace env.json."""
        self.write("env.json", json.dumps(env, indent=2) + "\n")

    def write(self, name: str, text: str) -> None:
        """Write a file of the folder atomically."""
        self._write_parts(name, [text])

    def _write_parts(self, name: str, parts: Iterable[str]) -> None:
        # Beside its target: a rename replaces a file in one step within one file system alone.
        temporary = self.path / f".{name}.{os.getpid()}"
        try:
            with temporary.open("w", encoding="utf-8") as file:
                file.writelines(parts)
            temporary.replace(self.path / name)
        finally:
            temporary.unlink(missing_ok=True)

    def lock(self) -> AbstractContextManager[int | None]:
        """Lock the folder against other runners; see `folder_lock`."""
        return folder_lock(self.path)

    def _read(self, name: str) -> str:
        try:
            return read_text(self.path / name)
        except (OSError, UnicodeDecodeError) as error:
            raise self._unreadable(name, error) from error

    def _plan_lines(self) -> Iterator[bytes]:
        """Yield the lines of the plan, one in memory at a time."""
        try:
            check_file(self.path / PLAN, LARGEST_PLAN)
            with (self.path / PLAN).open("rb") as plan:
                # A size is asked for: a damaged plan may be one line of gigabytes.
                while line := plan.readline(LARGEST):
                    if len(line) == LARGEST:
                        raise OSError(f"a line has more than {LARGEST / 1e6:.0f} MB")
                    yield line
        except OSError as error:
            raise self._unreadable(PLAN, error) from error

    def _unreadable(self, name: str, reason: object) -> UsageError:
        return UsageError(
            f"{str(self.path / name)!r} cannot be read ({reason}); a run needs it. Run the suite "
            "again with another -o."
        )


def _different_keys(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[str]:
    keys = []
    for key in dict.fromkeys((*old, *new)):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            keys += _different_keys(a, b, f"{prefix}{key}.")
        elif a != b and not prefix.startswith("origin."):
            keys.append(f"{prefix}{key}".rstrip("_"))
    return keys


_LOOK_SECONDS: Final = 1.0
_GROWTH: Final = 1.5
"""Growth of the row files between two consolidations: each takes what the earlier one holds, but
writes all of it again."""


@contextmanager
def frames_of_run(
    folder: RunFolder, keep_open: tuple[int, ...], on_event: OnEvent
) -> Iterator[OnEvent]:
    """Yield `on_event` for a run that is consolidated as it grows; wait for the last time at its
    end.

    The process inherits the descriptors `keep_open`, and ends with this one.
    """
    process: subprocess.Popen[bytes] | None = None
    due, next_look = folder.row_bytes + FEW_BYTES, 0.0

    def act(kind: str, data: Mapping[str, Any]) -> None:
        nonlocal process, due, next_look
        on_event(kind, data)
        if kind != "task" or time.monotonic() < next_look:
            return
        next_look = time.monotonic() + _LOOK_SECONDS
        is_busy = process is not None and process.poll() is None
        if not is_busy and (size := folder.row_bytes) > due:
            # Growth by a factor keeps the work of all consolidations in proportion to the rows.
            due = int(_GROWTH * size) + FEW_BYTES
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__, str(folder.path), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=worker_environment(1),
                pass_fds=keep_open,
                start_new_session=True,  # Ctrl-C reaches the supervisor alone
            )

    try:
        yield act
        if process is not None:
            process.wait()
    finally:
        if process is not None:
            process.kill()
            process.wait()


def main(folder: str, parent: str) -> None:
    """Consolidate the rows stored so far; what fails here is reported at the end of the run."""
    kill_with(int(parent))
    if hasattr(os, "nice"):
        # Tables can wait; the workers of the run go first.
        os.nice(10)
    RunFolder(Path(folder)).write_frames()


if __name__ == "__main__":
    main(*sys.argv[1:])
