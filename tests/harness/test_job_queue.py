"""Laws of waiting jobs: each is taken once, groups stay with a worker, no worker idles."""

import itertools
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.harness.work.supervise import JobQueue
from sysid_bench.harness.work.worker_process import Job

GROUPS = st.lists(st.sampled_from("abcde"), max_size=40)
WORKERS = st.lists(st.sampled_from(["worker1", "worker2", "worker3"]), min_size=1, max_size=20)


def _queue(groups: list[str]) -> JobQueue:
    jobs = JobQueue()
    jobs.add(Job("module:call", place, (), group) for place, group in enumerate(groups))
    return jobs


@given(groups=GROUPS, workers=WORKERS)
def test_each_job_is_taken_once_and_in_order_by_the_first_of_its_group(
    groups: list[str], workers: list[str]
) -> None:
    waiting = _queue(groups)
    taken = list[tuple[str, Job]]()
    while waiting:
        worker = workers[len(taken) % len(workers)]
        taken.append((worker, waiting.select_job(worker)))
    assert sorted(job.argument for _, job in taken) == list(range(len(groups)))
    for group in set(groups):
        found = [(worker, job.argument) for worker, job in taken if job.group == group]
        own = [place for worker, place in found if worker == found[0][0]]
        helped = [place for worker, place in found if worker != found[0][0]]
        assert own == sorted(own)
        assert helped == sorted(helped, reverse=True)


@given(groups=GROUPS)
def test_one_worker_changes_its_group_as_rarely_as_possible(groups: list[str]) -> None:
    waiting = _queue(groups)
    taken = [waiting.select_job("worker1").group for _ in groups]
    changes = sum(before != after for before, after in itertools.pairwise(taken))
    assert changes == max(0, len(set(groups)) - 1)
    assert list(dict.fromkeys(taken)) == list(dict.fromkeys(groups))


def test_a_worker_without_a_group_of_its_own_helps_where_most_is_left() -> None:
    waiting = _queue(list("aabbbb"))
    assert [waiting.select_job("worker1").group for _ in range(2)] == ["a", "a"]
    assert waiting.select_job("worker2").group == "b"
    assert waiting.select_job("worker1").group == "b"
    assert Counter(waiting.select_job("worker1").group for _ in range(2)) == {"b": 2}
    assert not waiting


def test_what_is_left_of_a_job_is_the_next_of_its_group() -> None:
    waiting = _queue(list("ab"))
    job = waiting.select_job("worker1")
    waiting.add_first(job)
    assert waiting.select_job("worker1") is job
