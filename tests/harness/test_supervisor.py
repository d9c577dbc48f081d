"""Laws of the supervisor: every cell of every task gets its row, whatever its neighbours do."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.harness.work.row_files import StoredRows, read_rows
from sysid_bench.harness.work.supervise import Ending, supervise
from sysid_bench.harness.work.worker_process import Job, WorkerSettings

HERE = Path(__file__).parent
CHECKOUT = HERE.parents[1]


def task(number: int, do: str = "", cells: int = 1, call: str = "harness_tasks:act") -> Job:
    ids = [f"{number}.{cell}" for cell in range(cells)]
    heads = tuple({"id": name, "robot": f"robot{number}"} for name in ids)
    return Job(call, {"do": do, "cells": ids}, heads)


def run(
    folder: Path,
    tasks: list[Job],
    jobs: int = 2,
    timeout: float = 30.0,
    fail_fast: bool = False,
    on_event: Callable[[str, Mapping[str, Any]], None] | None = None,
    start_timeout: float = 120.0,
) -> tuple[Ending, StoredRows]:
    settings = WorkerSettings(folder, timeout, 1, start_timeout=start_timeout)
    ending = supervise(tasks, settings, jobs, fail_fast, on_event)
    return ending, read_rows(folder / "cells")


def only(folder: Path, do: str, **settings: Any) -> dict[str, Any]:
    """The row of a single cell whose task does this."""
    _, stored = run(folder, [task(0, do)], **settings)
    (row,) = stored.rows.values()
    return row


@pytest.mark.long
def test_two_hundred_tasks_three_of_them_bad(tmp_path: Path) -> None:
    bad = {50: "raise", 100: "die", 150: "hang"}
    ending, stored = run(tmp_path, [task(n, bad.get(n, "")) for n in range(200)], timeout=4.0)
    assert ending == "finished"
    assert len(stored.rows) == 200
    kinds = {name: row["status"] for name, row in stored.rows.items() if row["status"] != "ok"}
    assert kinds == {"50.0": "failed", "100.0": "crash", "150.0": "timeout"}
    assert (stored.torn, stored.garbled) == (0, ())
    # The neighbours did not notice: two workers, and one more for each that died.
    assert len({row["pid"] for row in stored.rows.values() if row["status"] == "ok"}) <= 4


def test_an_exception_is_reported_in_one_line_with_its_traceback(tmp_path: Path) -> None:
    row = only(tmp_path, "raise")
    assert (row["status"], row["reason"]) == ("failed", "ValueError: no numbers")
    assert "in perform" in row["traceback"]
    assert row["robot"] == "robot0"


@pytest.mark.parametrize(
    ("do", "status", "reason"),
    [
        ("exit", "failed", "SystemExit: 3"),
        ("ask", "failed", "EOFError"),
        ("leave", "crash", "exit code 7"),
        ("die", "crash", "SIGSEGV; its last output: Fatal Python error: Segmentation fault"),
        ("segfault", "crash", "SIGSEGV"),
        ("hang", "timeout", "limit of 1 s"),
    ],
)
def test_every_kind_of_end_has_its_row(tmp_path: Path, do: str, status: str, reason: str) -> None:
    row = only(tmp_path, do, timeout=1.0 if do == "hang" else 30.0)
    assert row["status"] == status
    assert reason in row["reason"]


@pytest.mark.parametrize(
    ("call", "status", "reason"),
    [
        ("harness_tasks:silent", "failed", "ended without a row"),
        ("harness_tasks:foreign_error", "failed", "'nobody'; the cells of this job are 0.0"),
        ("harness_tasks:absent", "failed", "AttributeError"),
        ("harness_no_module:act", "failed", "ModuleNotFoundError"),
        ("harness_hangs_at_import:act", "timeout", "limit of 1 s"),
    ],
)
def test_a_call_that_is_wrong_itself(tmp_path: Path, call: str, status: str, reason: str) -> None:
    timeout = 1.0 if "hangs" in call else 30.0
    _, stored = run(tmp_path, [task(0, call=call)], timeout=timeout, start_timeout=timeout)
    assert list(stored.rows) == ["0.0"]
    assert stored.rows["0.0"]["status"] == status
    assert reason in stored.rows["0.0"]["reason"]


@pytest.mark.parametrize(
    "place", [1, *(pytest.param(place, marks=pytest.mark.long) for place in (0, 2))]
)
@pytest.mark.parametrize("call", ["act", "act_apart"])
@pytest.mark.parametrize(
    ("do", "status"),
    [
        ("die", "crash"),
        ("leave", "crash"),
        ("killed", "lost"),
        pytest.param("hang", "timeout", marks=pytest.mark.long),
    ],
)
def test_the_end_of_a_process_is_the_row_of_its_cell_alone(
    tmp_path: Path, do: str, status: str, call: str, place: int
) -> None:
    job = task(0, f"in {place} {do}", cells=3, call=f"harness_tasks:{call}")
    _, stored = run(tmp_path, [job, task(1)], jobs=1, timeout=3.0 if do == "hang" else 30.0)
    found = {name: row["status"] for name, row in stored.rows.items()}
    expected = dict.fromkeys(("0.0", "0.1", "0.2", "1.0"), "ok")
    assert found == {**expected, f"0.{place}": status}


@pytest.mark.parametrize("call", ["act", "act_apart"])
def test_an_end_before_the_first_cell_is_a_row_of_each(tmp_path: Path, call: str) -> None:
    job = task(0, "die", cells=3, call=f"harness_tasks:{call}")
    _, stored = run(tmp_path, [job, task(1)], jobs=1)
    assert {name: row["status"] for name, row in stored.rows.items()} == {
        "0.0": "crash", "0.1": "crash", "0.2": "crash", "1.0": "ok"
    }  # fmt: skip
    assert stored.rows["0.2"]["reason"].startswith("while the experiment was prepared")


@pytest.mark.long
def test_each_cell_has_the_whole_time_limit(tmp_path: Path) -> None:
    """Three cells of 1.5 s are within a limit of 3 s, of which they take half again as much."""
    jobs = [task(0, "in 0 sleep 1.5", cells=1), task(1, "in 0 sleep 1.5", cells=1)]
    job = Job("harness_tasks:sleep_in_each", {"seconds": 1.5}, tuple({"id": c} for c in "abc"))
    _, stored = run(tmp_path, [job, *jobs], jobs=1, timeout=3.0)
    assert {row["status"] for row in stored.rows.values()} == {"ok"}


def test_memory_over_the_limit_is_a_row_of_its_cell(tmp_path: Path) -> None:
    settings = WorkerSettings(tmp_path, 60.0, 1, memory=600e6)
    job = task(0, "in 1 allocate", cells=3)
    supervise([job], settings, 1)
    found = {name: row["status"] for name, row in read_rows(tmp_path / "cells").rows.items()}
    assert found == {"0.0": "ok", "0.1": "memory", "0.2": "ok"}


def test_a_lost_cell_counts_its_losses(tmp_path: Path) -> None:
    job = Job(
        "harness_tasks:act", {"do": "in 0 killed", "cells": ["a"]}, ({"id": "a", "losses": 1},)
    )
    _, stored = run(tmp_path, [job])
    assert (stored.rows["a"]["status"], stored.rows["a"]["losses"]) == ("lost", 2)


def test_output_is_bounded(tmp_path: Path) -> None:
    assert only(tmp_path, "flood")["status"] == "ok"
    log = (tmp_path / "logs" / "worker1.log").read_text()
    assert len(log) < 1.2e6
    assert log.startswith("the first line")
    assert "left out" in log
    assert log.rstrip().endswith("the last line")


def test_prints_go_to_the_log(tmp_path: Path) -> None:
    assert only(tmp_path, "print")["status"] == "ok"
    log = (tmp_path / "logs" / "worker1.log").read_text()
    assert "a plug-in talks" in log
    assert "behind our back" in log


@pytest.mark.long
def test_a_timeout_ends_what_the_task_has_started(tmp_path: Path) -> None:
    born = tmp_path / "born"
    assert only(tmp_path, f"grandchild {born}", timeout=3.0)["status"] == "timeout"
    process = int(born.read_text())
    wait_until_gone([process])


def children_of(process: int) -> list[int]:
    """Process numbers of the children of a process (Linux)."""
    return [int(n) for n in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def wait_until_gone(processes: Sequence[int]) -> None:
    """Return once none of the processes runs; fail after five minutes."""
    until = time.monotonic() + 300.0
    while any(map(lives, processes)):
        assert time.monotonic() < until, f"Some of the processes {processes} still run."
        time.sleep(0.02)


def lives(process: int) -> bool:
    """Whether a process runs; one that waits to be reaped does not."""
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2]
    except OSError:
        return False


def test_no_more_workers_than_tasks(tmp_path: Path) -> None:
    run(tmp_path, [task(0), task(1)], jobs=8)
    assert len(list((tmp_path / "logs").iterdir())) <= 2


def test_nothing_to_do_is_done(tmp_path: Path) -> None:
    assert run(tmp_path, [])[0] == "finished"
    assert not (tmp_path / "cells").exists()


def test_fail_fast_stops_at_the_first_failure(tmp_path: Path) -> None:
    tasks = [task(0), task(1, "raise"), *(task(n, "sleep 0.2") for n in range(2, 40))]
    ending, stored = run(tmp_path, tasks, jobs=1, fail_fast=True)
    assert ending == "stopped"
    assert Counter(row["status"] for row in stored.rows.values()) == {"ok": 1, "failed": 1}


def test_events_report_every_row_and_every_task(tmp_path: Path) -> None:
    events: list[tuple[str, Mapping[str, Any]]] = []
    tasks = [task(n, "raise" if n == 3 else "", cells=2) for n in range(6)]
    _, stored = run(tmp_path, tasks, on_event=lambda kind, data: events.append((kind, data)))
    kinds = Counter(kind for kind, _ in events)
    assert kinds == {"start": 6, "row": 12, "task": 6}
    reported = {data["id"]: data["status"] for kind, data in events if kind == "row"}
    assert reported == {name: row["status"] for name, row in stored.rows.items()}


@pytest.mark.long
def test_an_argument_larger_than_a_pipe_does_not_hold_the_supervisor(tmp_path: Path) -> None:
    big = Job("harness_hangs_at_import:act", "x" * 1_000_000, ({"id": "a"},))
    _, stored = run(tmp_path, [big, task(1)], timeout=6.0, start_timeout=6.0)
    assert {name: row["status"] for name, row in stored.rows.items()} == {
        "a": "timeout",
        "1.0": "ok",
    }


PARENT = """
import sys, threading
from pathlib import Path
sys.path.insert(0, {here!r})
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.harness.work.supervise import supervise
cells = [str(n) for n in range(4)]
def task(cell):
    argument = {{"do": "sleep {seconds}", "cells": [cell]}}
    return Job("harness_tasks:act", argument, ({{"id": cell}},))
tasks = [task(cell) for cell in cells]
print(supervise(tasks, WorkerSettings(Path({folder!r}), 60.0, 1), 2,
                on_event=lambda kind, data: print(kind, flush=True)), flush=True)
"""


def parent(folder: Path, seconds: float) -> "subprocess.Popen[str]":
    """A runner in a process of its own, started from a script without a __main__ guard."""
    script = folder / "script.py"
    script.write_text(
        textwrap.dedent(PARENT.format(here=str(HERE), folder=str(folder), seconds=seconds))
    )
    return subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
    )  # fmt: skip


@pytest.mark.long
def test_an_orphan_writes_no_row(tmp_path: Path) -> None:
    with parent(tmp_path, 20.0) as runner:
        assert runner.stdout is not None
        assert runner.stdout.readline() == "start\n"
        workers = children_of(runner.pid)
        runner.kill()
    # An orphan that survived would end with its task, and its row would be there.
    wait_until_gone(workers)
    assert read_rows(tmp_path / "cells").rows == {}


@pytest.mark.long
def test_a_deaf_orphan_writes_no_row_without_the_help_of_linux(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of its input is enough for a worker to end, in the middle of a task."""
    monkeypatch.setattr(sys, "path", [str(HERE), *sys.path])
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    with (tmp_path / "log").open("w") as log, subprocess.Popen(
        [sys.executable, "-m", "sysid_bench.harness.work.worker"], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=log, text=True, env=environment,
    ) as worker:  # fmt: skip
        assert worker.stdin is not None
        assert worker.stdout is not None
        rows = tmp_path / "rows.jsonl"
        settings = {
            "parent": os.getpid(), "path": [str(HERE)], "rows": str(rows), "memory": None
        }  # fmt: skip
        job = {
            "number": 1, "call": "harness_tasks:act", "cells": ["a"], "losses": {},
            "argument": {"do": "sleep 1000", "cells": ["a"]},
        }  # fmt: skip
        worker.stdin.write(json.dumps(settings) + "\n" + json.dumps(job) + "\n")
        worker.stdin.flush()
        assert "begin" in worker.stdout.readline()
        worker.stdin.close()
        assert worker.wait(timeout=300) == 1
    assert rows.read_text() == ""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.long
def test_an_interrupt_keeps_finished_rows_and_kills_the_workers(tmp_path: Path, how: int) -> None:
    with parent(tmp_path, 2.0) as runner:
        assert runner.stdout is not None
        seen = []
        while "row" not in seen:
            line = runner.stdout.readline()
            assert line, f"The runner ended with {runner.wait(timeout=10)} before a row came."
            seen.append(line.strip())
        workers = children_of(runner.pid)
        runner.send_signal(how)
        rest = runner.stdout.read().split()
        # The signal may come between a word of a print and its line end.
        assert rest[-1].endswith("interrupted")
        assert runner.wait(timeout=300) == 0
    stored = read_rows(tmp_path / "cells")
    assert 1 <= len(stored.rows) < 4
    wait_until_gone(workers)
    assert read_rows(tmp_path / "cells") == stored
