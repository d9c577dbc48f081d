"""Laws of calls in a worker: a value, or one error that says what happened; the next call works."""

import os

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError, worker_call

HERE = "tests.faults.worker_functions"
ENDS = {
    "hang": ("timeout", "longer than the limit of 6 s"),
    "abort": ("crash", "SIGABRT"),
    "leave": ("crash", "exit code 0"),
    "end_by_kill": ("lost", "SIGKILL"),
    "refuse": ("failed", "not this one"),
    "interrupt": ("failed", "KeyboardInterrupt"),
    "allocate": ("memory", "MemoryError"),
}


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_call_that_ends_badly_costs_itself_alone(place: int) -> None:
    """Of three calls the bad one is the first, the middle or the last."""
    functions = ["double", "double"]
    functions.insert(place, "abort")
    with CallWorker(timeout=60.0) as worker:
        for number, function in enumerate(functions):
            if function == "double":
                assert worker.call(f"{HERE}:double", number, "a number") == 2 * number
            else:
                with pytest.raises(WorkerError, match=r"^a crash: its process was killed"):
                    worker.call(f"{HERE}:{function}", None, "a crash")


@pytest.mark.parametrize("function", ENDS)
def test_an_end_without_a_value(function: str) -> None:
    status, text = ENDS[function]
    timeout = 6.0 if function == "hang" else 60.0
    with pytest.raises(WorkerError, match=text) as caught:
        worker_call(f"{HERE}:{function}", None, "the thing", timeout, 2e9)
    assert caught.value.status == status
    assert str(caught.value).startswith("the thing: ")


def test_calls_share_a_process_that_is_not_this_one() -> None:
    with CallWorker(timeout=60.0) as worker:
        first, second = (worker.call(f"{HERE}:process", None, "a process") for _ in range(2))
        assert first == second != os.getpid()
        assert worker.call(f"{HERE}:fork", None, "a fork") == 1
        assert worker.call(f"{HERE}:double", 4, "a number") == 8
    assert worker.output == "doubled\n"
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)


def test_an_argument_that_is_not_json_is_refused_here() -> None:
    with CallWorker(timeout=60.0) as worker, pytest.raises(UsageError, match="not JSON"):
        worker.call(f"{HERE}:double", object(), "the thing")


def test_a_value_that_is_not_json() -> None:
    with pytest.raises(WorkerError, match=r"the thing: .*JSON"):
        worker_call(f"{HERE}:answer_object", None, "the thing", 60.0)
