"""Batch of jobs on a machine elsewhere: its files, and the worker that computes it there."""

import atexit
import hashlib
import io
import os
import re
import shutil
import tarfile
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import filterfalse
from pathlib import Path
from typing import Any, Final

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import UsageError
from sysid_bench.harness.work.row_files import NewRows
from sysid_bench.harness.work.supervise import WorkerSet, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.version_fields import environment, package_hash, version_fields


@dataclass(frozen=True)
class BatchAnswer:
    """Rows of a batch, the files that its cells wrote below artifacts and the machine, or why it
    does not compute the batch (`refusal`)."""

    rows: tuple[Row, ...] = ()
    files: Mapping[str, bytes] | None = None
    machine: Mapping[str, Any] | None = None
    refusal: str = ""


class BatchWorker:
    """One worker process with hard limits, warm between batches, in a folder of its own.

    Its thread lives as long as the seat: a worker ends with the thread that started it.
    """

    def __init__(self, limits: WorkerSettings) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="sysid_bench_seat_"))
        settings = replace(limits, folder=self._folder)
        self._supervisor = WorkerSet(settings, 1, False, no_progress)
        self._arriving = NewRows(self._folder)
        # Linux sends a parent's death signal when the thread that forked ends; those of Dask do.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="seat")
        atexit.register(self.close)

    def answer(self, jobs: Sequence[Job]) -> BatchAnswer:
        """Compute the jobs; every cell has a row."""
        artifacts = self._folder / "artifacts"
        here = list(jobs)
        for number, job in enumerate(jobs):
            if isinstance(job.argument, Mapping) and "artifacts" in job.argument:
                argument = {**job.argument, "artifacts": str(artifacts)}
                here[number] = replace(job, argument=argument)
        if self._thread.submit(self._supervisor.work, here).result() == "interrupted":
            raise KeyboardInterrupt
        self._arriving.update()
        rows = [self._arriving.rows.pop(cell["id"]) for job in jobs for cell in job.cells]
        found = filter(Path.is_file, sorted(artifacts.rglob("*")))
        files = {str(file.relative_to(artifacts)): file.read_bytes() for file in found}
        shutil.rmtree(artifacts, ignore_errors=True)
        return BatchAnswer(tuple(rows), files)

    def interrupt(self) -> None:
        """Let a call of `answer` raise KeyboardInterrupt soon; signals call this at any time."""
        self._supervisor.interrupt()

    def close(self) -> None:
        """End the worker, and remove the folder."""
        atexit.unregister(self.close)
        self._supervisor.interrupt()
        self._thread.shutdown()
        self._supervisor.close()
        shutil.rmtree(self._folder, ignore_errors=True)


MOST_BYTES: Final = 1e9


@dataclass(frozen=True)
class RunFiles:
    """Archive of folders, and their paths on the machine that made it."""

    data: bytes
    folders: tuple[str, ...]

    def open_folder(self) -> Path:
        """Return the folder of the files on this machine, where they are unpacked once."""
        place = _private_folder() / hashlib.sha256(self.data).hexdigest()[:24]
        if not place.is_dir():
            # Unpacked beside and renamed: threads and workers of one machine share the folder.
            beside = Path(tempfile.mkdtemp(prefix=".", dir=place.parent))
            try:
                with tarfile.open(fileobj=io.BytesIO(self.data)) as archive:
                    # The filter refuses paths that lead out of the folder.
                    archive.extractall(beside, filter="data")
                beside.rename(place)
            except OSError:
                shutil.rmtree(beside, ignore_errors=True)
                if not place.is_dir():  # another thread was not first: it is a fault of the disk
                    raise
        return place

    def folder_map(self, unpacked: Path) -> Mapping[str, str]:
        """Return {folder on the machine that made the bundle: folder here}."""
        return {folder: str(unpacked / str(i)) for i, folder in enumerate(self.folders)}


def run_files(folders: Sequence[Path]) -> RunFiles:
    """Return the bundle of all files below these folders, hidden ones and runs left out.

    Raises UsageError where they are more than 1 GB.
    """
    roots = tuple(dict.fromkeys(str(folder.resolve()) for folder in folders))
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w", dereference=True) as archive:
        for i, root in enumerate(roots):
            folder = tarfile.TarInfo(str(i))
            folder.type, folder.mode = tarfile.DIRTYPE, 0o755
            archive.addfile(folder)
            for file in _files(Path(root)):
                entry = archive.gettarinfo(file, arcname=f"{i}/{file.relative_to(root)}")
                # The same content is the same bundle, from any sender.
                entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname = 0, 0, 0, "", ""
                with file.open("rb") as data:
                    archive.addfile(entry, data)
                if archive.offset > MOST_BYTES:
                    raise UsageError(
                        f"The folder {root!r} holds more than {MOST_BYTES / 1e9:g} GB, which are "
                        "not sent to workers. Move the suite into a folder of its own with its "
                        "files, or add '?shared' to the address where workers see the same file "
                        "system."
                    )
    return RunFiles(written.getvalue(), roots)


def _files(root: Path) -> Iterator[Path]:
    def is_hidden(name: str) -> bool:
        return name.startswith(".") or name == "__pycache__"

    for folder, names, files in os.walk(root):
        if "plan.jsonl" in files:  # a run, which is not needed elsewhere
            names.clear()
            continue
        names[:] = sorted(filterfalse(is_hidden, names))
        paths = (Path(folder, name) for name in sorted(filterfalse(is_hidden, files)))
        yield from filter(Path.is_file, paths)


def _private_folder() -> Path:
    """Return a folder of this user alone: what lies in it is executed."""
    if not hasattr(os, "getuid"):
        return Path(tempfile.gettempdir())
    folder = Path(tempfile.gettempdir()) / f"sysid_bench-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    # In /tmp anybody may have made a folder of this name before.
    if found.st_uid != os.getuid() or found.st_mode & 0o077 or folder.is_symlink():
        raise UsageError(f"{str(folder)!r} is open to other users; remove it, or set TMPDIR.")
    return folder


def with_folders(value: Any, places: Mapping[str, str]) -> Any:
    """Return a JSON value with paths of one machine as those of another, wherever they occur.

    Each is replaced once, the longest first, and where it is a whole path or the beginning of one.
    """
    if not places:
        return value
    old = "|".join(re.escape(path) for path in sorted(places, key=len, reverse=True))
    # A path within a longer name, as /data in /data2, is another one.
    pattern = re.compile(rf"(?<![\w./-])(?:{old})(?![\w.-])")

    def replaced(value: Any) -> Any:
        if isinstance(value, str):
            return pattern.sub(lambda found: places[found[0]], value)
        if isinstance(value, Mapping):
            return {replaced(key): replaced(inner) for key, inner in value.items()}
        return list(map(replaced, value)) if isinstance(value, list | tuple) else value

    return replaced(value)


@dataclass(frozen=True)
class Batch:
    """Jobs, the limits of their cells, which are of no folder yet, and the hash of the code that
    planned them ("" for any)."""

    jobs: tuple[Job, ...]
    limits: WorkerSettings
    code: str


def run_batch(batch: Batch, bundle: RunFiles | None) -> BatchAnswer:
    """Return the rows of all cells of the batch, with paths as on the machine that planned it."""
    if batch.code and package_hash() != batch.code:
        found = ", ".join(f"{name} {number}" for name, number in version_fields().items())
        return BatchAnswer(refusal=f"code or libraries of the worker are others ({found})")
    places = {} if bundle is None else bundle.folder_map(bundle.open_folder())
    jobs = [replace(job, argument=with_folders(job.argument, places)) for job in batch.jobs]
    with _seat(batch.limits, jobs) as seat:
        answer = seat.answer(jobs)
    back = {here: there for there, here in places.items()}
    machine = environment_fields()
    rows = tuple({**with_folders(row, back), "machine": machine["id"]} for row in answer.rows)
    return replace(answer, rows=rows, machine=machine)


@cache
def environment_fields() -> Mapping[str, Any]:
    """Return processor, instructions, BLAS and versions of this machine, and their hash `id`."""
    found = environment()
    names = ("python", "platform", "cpu", "instructions", "blas", "versions")
    parts = {key: found[key] for key in names}
    return {"id": canonical_hash(parts)[:8], **parts}


_idle: dict[WorkerSettings, dict[BatchWorker, str]] = {}  # seat -> group of its last job
_lock = threading.Lock()


@contextmanager
def _seat(limits: WorkerSettings, jobs: Sequence[Job]) -> Iterator[BatchWorker]:
    """Yield an idle seat with these limits for some jobs: one that had their group last if there is
    any, or a new one; seats of other limits end."""
    with _lock:
        # Other limits mean another run: its workers only hold memory now.
        others = [seat for other in list(_idle) if other != limits for seat in _idle.pop(other)]
        idle = _idle.setdefault(limits, {})
        same = (seat for seat, group in idle.items() if group == jobs[0].group)
        seat = next(same, next(iter(idle), None))
        if seat is not None:
            del idle[seat]
    for other in others:
        other.close()
    seat = seat or BatchWorker(limits)
    try:
        yield seat
    except BaseException:
        seat.close()
        raise
    with _lock:
        # Another batch with other limits may have ended this group of seats meanwhile.
        is_kept = _idle.get(limits) is idle
        if is_kept:
            idle[seat] = jobs[-1].group
    if not is_kept:
        seat.close()
