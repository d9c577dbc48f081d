"""Batches of jobs, by their expected cost."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from sysid_bench.harness.work.worker_process import Job

SECONDS: Final = 0.5
"""Expected cost of a batch: long beside its transport, short beside the loss of a machine."""
MOST_CELLS: Final = 2000
_LONGEST: Final = 5.0
"""Largest expected cost of a batch whose jobs share what a worker keeps in memory."""
_SHARES: Final = 16
"""Batches of a run at least, where a group of jobs would make fewer: several machines compute."""


def by_cost(
    jobs: Sequence[Job], seconds: Mapping[str, float], limit: float = SECONDS
) -> Iterator[tuple[Job, ...]]:
    """Yield whole jobs in their order, as many as cost `limit` seconds or have 2000 cells.

    The jobs of a group stay together up to a sixteenth of all costs, at most 5 s.
    """
    costs = [sum(seconds.get(cell["id"], 0.0) for cell in job.cells) for job in jobs]
    longest = max(limit, min(_LONGEST, sum(costs) / _SHARES))
    now: list[Job] = []
    cost, cells = 0.0, 0
    for place, job in enumerate(jobs):
        now.append(job)
        cost += costs[place]
        cells += len(job.cells)
        goes_on = place + 1 < len(jobs) and job.group and jobs[place + 1].group == job.group
        if cost >= (longest if goes_on else limit) or cells >= MOST_CELLS:
            yield tuple(now)
            now, cost, cells = [], 0.0, 0
    if now:
        yield tuple(now)
