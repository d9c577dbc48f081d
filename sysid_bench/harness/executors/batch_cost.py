"""Batches of jobs, by their expected cost."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from sysid_bench.harness.work.worker_process import Job

SECONDS: Final = 0.5
"""Expected cost of a batch: long beside its transport, short beside the loss of a machine."""
MOST_CELLS: Final = 2000


def by_cost(
    jobs: Sequence[Job], seconds: Mapping[str, float], limit: float = SECONDS
) -> Iterator[tuple[Job, ...]]:
    """Yield whole jobs in their order, as many as cost `limit` seconds or have 2000 cells."""
    now: list[Job] = []
    cost, cells = 0.0, 0
    for job in jobs:
        now.append(job)
        cost += sum(seconds.get(cell["id"], 0.0) for cell in job.cells)
        cells += len(job.cells)
        if cost >= limit or cells >= MOST_CELLS:
            yield tuple(now)
            now, cost, cells = [], 0.0, 0
    if now:
        yield tuple(now)
