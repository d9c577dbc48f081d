"""Waiting jobs as batches, by their expected cost, for each worker that has room for one."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Final

from sysid_bench.harness.work.job_queue import JobQueue
from sysid_bench.harness.work.worker_process import Job

SECONDS: Final = 0.5
"""Expected cost of a batch: long beside its transport, short beside the loss of a machine."""
MOST_CELLS: Final = 2000


class BatchQueue:
    """Jobs of a run, in order within their groups; a worker stays with its group as in JobQueue."""

    def __init__(self, jobs: Sequence[Job], seconds: Mapping[str, float]) -> None:
        self._jobs = JobQueue()
        self._jobs.add(jobs)
        self._seconds = seconds
        self._cost = sum(map(self._cost_of, jobs))
        self._cells = sum(len(job.cells) for job in jobs)

    def __bool__(self) -> bool:
        return bool(self._jobs)

    def select_batch(self, worker: Hashable, parts: int) -> tuple[Job, ...]:
        """Remove and return the next jobs of a worker: as many as cost 0.5 s or have 2000 cells,
        but one of `parts` of what waits, so that batches get smaller towards the end."""
        most_cost = min(SECONDS, self._cost / parts)
        most_cells = min(MOST_CELLS, self._cells / parts)
        batch: list[Job] = []
        cost, cells = 0.0, 0
        while self._jobs and (
            not batch or (cells < most_cells and (cost < most_cost or cost == 0.0))
        ):
            job = self._jobs.select_job(worker)
            batch.append(job)
            cost += self._cost_of(job)
            cells += len(job.cells)
        self._cost -= cost
        self._cells -= cells
        return tuple(batch)

    def _cost_of(self, job: Job) -> float:
        return sum(self._seconds.get(cell["id"], 0.0) for cell in job.cells)
