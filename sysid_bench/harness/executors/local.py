"""Executor: worker processes of this machine."""

from dataclasses import dataclass

from sysid_bench.harness.executors.executor import RunEnd, Work
from sysid_bench.harness.work.supervise import OnEvent, supervise


@dataclass(frozen=True)
class Local:
    """Computes on at most `work.workers` processes of this machine."""

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        """Supervise worker processes until all jobs have their rows."""
        ending = supervise(work.jobs, work.settings, work.workers, work.fail_fast, on_event)
        return RunEnd(ending)
