"""Batch of jobs on a machine elsewhere: what the engine calls there."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.harness.executors.batch_worker import BatchWorker, Limits
from sysid_bench.harness.executors.run_files import RunFiles, with_folders
from sysid_bench.harness.work.worker_process import Job
from sysid_bench.types import Row
from sysid_bench.version_fields import environment, package_hash, version_fields

_MACHINE: Final = ("python", "platform", "cpu", "instructions", "blas", "versions")


@dataclass(frozen=True)
class Batch:
    """Jobs, their limits, and the hash of the code that planned them ("" for any)."""

    jobs: tuple[Job, ...]
    limits: Limits
    code: str


@dataclass(frozen=True)
class BatchAnswer:
    """Rows and files of a batch, or why the machine does not compute it (`refusal`)."""

    rows: tuple[Row, ...] = ()
    files: Mapping[str, bytes] | None = None
    machine: Mapping[str, Any] | None = None
    refusal: str = ""


def run_batch(batch: Batch, bundle: RunFiles | None) -> BatchAnswer:
    """Return the rows of all cells of the batch, with paths as on the machine that planned it."""
    if batch.code and package_hash() != batch.code:
        return BatchAnswer(refusal=_other_code())
    places = {} if bundle is None else bundle.folder_map(bundle.open_folder())
    jobs = [replace(job, argument=with_folders(job.argument, places)) for job in batch.jobs]
    with _seat(batch.limits, jobs) as seat:
        answer = seat.answer(jobs)
    back = {here: there for there, here in places.items()}
    machine = environment_fields()
    rows = tuple({**with_folders(row, back), "machine": machine["id"]} for row in answer.rows)
    return BatchAnswer(rows, answer.files, machine)


@cache
def environment_fields() -> Mapping[str, Any]:
    """Return processor, instructions, BLAS and versions of this machine, and their hash `id`."""
    found = environment()
    parts = {key: found[key] for key in _MACHINE}
    return {"id": canonical_hash(parts)[:8], **parts}


def _other_code() -> str:
    found = ", ".join(f"{name} {number}" for name, number in version_fields().items())
    return f"code or libraries of the worker are others ({found})"


_idle: dict[Limits, dict[BatchWorker, str]] = {}  # seat -> group of its last job
_lock = threading.Lock()


@contextmanager
def _seat(limits: Limits, jobs: Sequence[Job]) -> Iterator[BatchWorker]:
    """Yield an idle seat with these limits for some jobs: one that had their group last if there is
    any, or a new one; seats of other limits end."""
    with _lock:
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
        is_kept = _idle.get(limits) is idle
        if is_kept:
            idle[seat] = jobs[-1].group
    if not is_kept:
        seat.close()
