"""Waiting jobs, by group: the jobs of a group share what a worker keeps in memory (the model of a
robot, its regressor, its base parameters), so that a worker stays with its group."""

from collections import deque
from collections.abc import Hashable, Iterable

from sysid_bench.harness.work.worker_process import Job


class JobQueue:
    """Jobs in order within their groups; each group goes to one worker while there are others.

    A worker that helps another takes the last job of its group: jobs that follow each other share
    most.
    """

    def __init__(self) -> None:
        self._groups: dict[str, deque[Job]] = {}
        self._owners: dict[str, Hashable] = {}  # group -> the first worker that had a job of it
        self._given: dict[Hashable, str] = {}  # worker -> group of its last job

    def __bool__(self) -> bool:
        return bool(self._groups)

    def add(self, jobs: Iterable[Job]) -> None:
        """Append jobs."""
        for job in jobs:
            self._groups.setdefault(job.group, deque()).append(job)

    def add_first(self, job: Job) -> None:
        """Let what is left of a started job be the next of its group."""
        self._groups.setdefault(job.group, deque()).appendleft(job)

    def select_job(self, worker: Hashable) -> Job:
        """Remove and return the next job of a worker: of its group; else of the first group that
        no worker has had; else the last one of the group with most jobs."""
        group = self._group_of(worker)
        self._given[worker] = group
        jobs = self._groups[group]
        job = jobs.popleft() if self._owners.setdefault(group, worker) == worker else jobs.pop()
        if not jobs:
            del self._groups[group]
        return job

    def _group_of(self, worker: Hashable) -> str:
        last = self._given.get(worker)
        if last is not None and last in self._groups:
            return last
        free = next((group for group in self._groups if group not in self._owners), None)
        if free is not None:
            return free
        return max(self._groups, key=lambda group: len(self._groups[group]))
