"""The run folder: the frozen suite, the plan, the rows, and who may write into it."""

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.errors import UsageError
from sysid_bench.harness.data_frames import Frames, data_frames
from sysid_bench.harness.plan import Plan
from sysid_bench.harness.suite.load_suite import Suite, dump_suite, parse_frozen
from sysid_bench.harness.work.row_files import RowWriter, StoredRows, new_row_file, read_rows

if TYPE_CHECKING:
    import pandas as pd

try:
    import fcntl
except ImportError:  # Windows has no flock: there, two runners on one folder are not noticed
    fcntl = None  # type: ignore[assignment]

ORPHAN_SECONDS = 10.0
"""How long the workers of a killed runner may take to die; they hold its lock until then."""


@dataclass(frozen=True)
class RunFolder:
    """A folder with run.toml, plan.jsonl, env.json and cells/*.jsonl."""

    path: Path

    @classmethod
    def create(cls, path: Path, suite: Suite, plan: Plan, env: Mapping[str, Any]) -> "RunFolder":
        """A new run, or the same run again: then suite and labels are brought up to date.

        Raises UsageError where the folder holds a run of other cells.
        """
        folder = cls(path)
        if (path / "plan.jsonl").is_file():
            folder._check_same(suite, plan)
        (path / "cells").mkdir(parents=True, exist_ok=True)
        (path / "logs").mkdir(exist_ok=True)
        folder.write("run.toml", dump_suite(suite))
        if not (path / "env.json").is_file():
            folder.write_env(env)
        folder.write("plan.jsonl", plan.to_json_lines())  # last: from now on it is a run
        return folder

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """A run that exists; raises UsageError where there is none."""
        if not (path / "plan.jsonl").is_file():
            raise UsageError(
                f"{str(path)!r} is no run: it has no plan.jsonl. Start one with "
                f"'sysid-bench run SUITE -o {path}'."
            )
        return cls(path)

    @cached_property
    def suite(self) -> Suite:
        """The suite as it was frozen."""
        return parse_frozen(self._read("run.toml"), str(self.path / "run.toml"))

    @cached_property
    def plan(self) -> Plan:
        """Every cell of the run."""
        return Plan.from_json_lines(self._read("plan.jsonl"))

    @property
    def env(self) -> dict[str, Any]:
        """Versions, CPU, BLAS and git of the machine that last ran cells."""
        return dict(json.loads(self._read("env.json")))

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

    def rows(self) -> StoredRows:
        """What is stored now."""
        return read_rows(self.path / "cells")

    def frames(self) -> Frames:
        """The planned cells that have a row, with the labels of the present plan."""
        stored = self.rows().rows
        planned = (cell for cell in self.plan.cells if cell.id in stored)
        return data_frames({**stored[cell.id], **cell.head} for cell in planned)

    def write_frames(self) -> None:
        """Writes cells.parquet, parameters.parquet and joints.parquet."""
        self.frames().write(self.path)

    def new_writer(self, writer: str) -> RowWriter:
        """A writer with a fresh file; for rows that no worker can write."""
        return RowWriter(new_row_file(self.path / "cells", writer))

    def write_env(self, env: Mapping[str, Any]) -> None:
        """Replaces env.json."""
        self.write("env.json", json.dumps(env, indent=2) + "\n")

    def write(self, name: str, text: str) -> None:
        """A file of the folder, whole or not at all."""
        beside = self.path / f".{name}.{os.getpid()}"
        beside.write_text(text, encoding="utf-8")
        beside.replace(self.path / name)

    @contextmanager
    def lock(self) -> Iterator[int | None]:
        """Keeps other runners out; yields the file descriptor to be inherited by workers.

        The lock ends when the last process that holds it dies: a killed runner's workers keep it
        until they are gone, so that no row of theirs comes after the first look of the next run.
        """
        if fcntl is None:
            yield None
            return
        descriptor = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._seize(descriptor)
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, str(os.getpid()).encode(), 0)
            yield descriptor
        finally:
            os.close(descriptor)

    def _seize(self, descriptor: int) -> None:
        until = time.monotonic() + ORPHAN_SECONDS
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError as error:
                holder = os.pread(descriptor, 20, 0).decode()
                if _lives(holder) or time.monotonic() > until:
                    raise UsageError(
                        f"Another runner (process {holder or 'unknown'}) is at work in "
                        f"{str(self.path)!r}; wait for it, stop it, or choose another -o."
                    ) from error
            time.sleep(0.02)

    def _read(self, name: str) -> str:
        try:
            return (self.path / name).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(
                f"{str(self.path / name)!r} cannot be read ({error}); a run needs it. Run the "
                "suite again with another -o."
            ) from error

    def _check_same(self, suite: Suite, plan: Plan) -> None:
        mine = {cell.id for cell in self.plan.cells}
        theirs = {cell.id for cell in plan.cells}
        if mine == theirs:
            return
        keys = _different_keys(self.suite.model_dump(), suite.model_dump())
        raise UsageError(
            f"{str(self.path)!r} holds another run: {len(mine - theirs)} of its cells are not in "
            f"this plan, and {len(theirs - mine)} of this plan are not in it "
            f"(what differs: {', '.join(keys) or 'the models behind the names'}). Choose another "
            "-o, or remove the folder."
        )


def _lives(process: str) -> bool:
    if not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return not _is_zombie(process)


def _is_zombie(process: str) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (OSError, IndexError):
        return False


def _different_keys(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[str]:
    keys = []
    for key in dict.fromkeys((*old, *new)):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            keys += _different_keys(a, b, f"{prefix}{key}.")
        elif a != b and not prefix.startswith("origin."):
            keys.append(f"{prefix}{key}".rstrip("_"))
    return keys
