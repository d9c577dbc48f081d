"""Laws of executors, with an engine that loses, repeats and mixes up what it gets."""

import os
import random
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.apps.clusters import batch as bundles
from sysid_bench.apps.clusters.batch import (
    Batch,
    BatchAnswer,
    BatchWorker,
    environment_fields,
    run_batch,
    run_files,
    with_folders,
)
from sysid_bench.apps.clusters.batch_run import BatchQueue, ExecutorRun, OnAnswer
from sysid_bench.apps.clusters.dask import Dask
from sysid_bench.errors import UsageError
from sysid_bench.harness.executor import Local, RunEnd, Work, executor_of
from sysid_bench.harness.work.row_files import read_rows, row_files
from sysid_bench.harness.work.supervise import no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.version_fields import package_hash

ACT = "harness_tasks:act"


def job(number: int, cells: int = 2, do: str = "") -> Job:
    names = [f"{number}.{k}" for k in range(cells)]
    return Job(ACT, {"do": do, "cells": names}, tuple({"id": name} for name in names))


def work_of(folder: Path, jobs: list[Job], **settings: Any) -> Work:
    limits = WorkerSettings(folder, timeout=30.0, threads=1)
    return Work(jobs, limits, {}, (), 1, **settings)


class Unreliable:
    """Answers at once with rows of its own: late, twice, or not at all, by a seeded choice."""

    def __init__(self, seed: int, lost_after: int | None = None) -> None:
        self.random, self.left = random.Random(seed), lost_after
        self.late: list[Callable[[], None]] = []
        self.cancelled = False

    def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
        if self.left is not None:
            self.left -= 1
            if self.left < 0:
                return
        rows = tuple({"id": cell["id"], "status": "ok"} for j in batch.jobs for cell in j.cells)
        answer = BatchAnswer(rows, {}, environment_fields())
        fate = self.random.choice(["now", "late", "twice", "error"])
        if fate == "error":
            on_answer(OSError("a machine went away"))
        elif fate == "late" and len(self.late) < 3:
            self.late.append(lambda: on_answer(answer))
        else:
            on_answer(BatchAnswer(rows * (2 if fate == "twice" else 1), {}, environment_fields()))
            while self.late:
                self.late.pop()()

    def workers(self) -> dict[str, int]:
        return {"one": 1, "other": 1}

    def is_lost(self) -> str:
        while self.late:
            self.late.pop()()
        return "The scheduler is gone." if self.left is not None and self.left < 0 else ""

    def cancel(self) -> None:
        self.cancelled = True


@pytest.mark.parametrize("seed", range(8))
def test_each_cell_has_one_row_whatever_the_engine_does(tmp_path: Path, seed: int) -> None:
    jobs = [job(n, cells=1 + n % 3) for n in range(12)]
    work = Work(jobs, WorkerSettings(tmp_path, 30.0, 1), {"3.0": 5.0, "7.1": 9.0}, (), 1)
    ended = ExecutorRun(Unreliable(seed), work, no_progress, "").run()
    assert ended == RunEnd("finished")
    written = [
        line for file in row_files(tmp_path / "cells") for line in file.read_text().splitlines()
    ]
    cells = [cell["id"] for j in jobs for cell in j.cells]
    assert len(written) == len(cells)
    stored = read_rows(tmp_path / "cells").rows
    assert sorted(stored) == sorted(cells)
    assert {row["status"] for row in stored.values()} <= {"ok", "lost"}


@pytest.mark.parametrize("after", [0, 1, 3])
def test_an_engine_that_is_gone_ends_the_run_resumable(tmp_path: Path, after: int) -> None:
    jobs = [job(n) for n in range(8)]
    seconds = {cell["id"]: 9.0 for j in jobs for cell in j.cells}
    work = Work(jobs, WorkerSettings(tmp_path, 30.0, 1), seconds, (), 1)
    engine = Unreliable(4, lost_after=after)
    ended = ExecutorRun(engine, work, no_progress, "").run()
    assert ended.ending == "lost"
    assert "gone" in ended.notes[0]
    assert engine.cancelled
    assert len(read_rows(tmp_path / "cells").rows) < 16


def test_a_refusal_is_a_sentence(tmp_path: Path) -> None:
    class Refusing(Unreliable):
        def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
            on_answer(run_batch(batch, None))

    work = work_of(tmp_path, [job(0)])
    with pytest.raises(UsageError, match=r"others .*numpy.*other-code"):
        ExecutorRun(Refusing(0), work, no_progress, "another").run()
    assert read_rows(tmp_path / "cells").rows == {}


def test_files_of_a_batch_stay_below_the_artifacts(tmp_path: Path) -> None:
    class Hostile(Unreliable):
        def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
            rows = tuple({"id": cell["id"], "status": "ok"} for j in batch.jobs for cell in j.cells)
            on_answer(
                BatchAnswer(
                    rows, {"../out.txt": b"x", "a/paper/in.csv": b"y"}, environment_fields()
                )
            )

    ExecutorRun(Hostile(0), work_of(tmp_path / "run", [job(0)]), no_progress, "").run()
    assert not (tmp_path / "run" / "out.txt").exists()
    assert (tmp_path / "run" / "artifacts" / "a" / "paper" / "in.csv").read_bytes() == b"y"


def test_a_seat_keeps_its_worker_and_settles_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a worker elsewhere does: rows of all cells, also of those that end the process."""
    limits = WorkerSettings(Path(), 30.0, 1)
    first = run_batch(Batch((job(0), job(1)), limits, package_hash()), None)
    again = run_batch(Batch((job(2),), limits, package_hash()), None)
    assert {row["pid"] for row in (*first.rows, *again.rows)} == {first.rows[0]["pid"]}
    bad = run_batch(Batch((job(3, 3, "in 1 die"), job(4)), limits, ""), None)
    assert [row["status"] for row in bad.rows] == ["ok", "crash", "ok", "ok", "ok"]
    assert {row["machine"] for row in bad.rows} == {environment_fields()["id"]}


def test_an_interrupted_seat_ends_its_job() -> None:
    """Ctrl-C while another machine is compared: the cell does not run to its limit."""
    seat = BatchWorker(WorkerSettings(Path(), 600.0, 1))
    timer = threading.Timer(1.0, seat.interrupt)
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            seat.answer([job(0, 1, "in 0 hang")])
    finally:
        timer.join()
        seat.close()


class Elsewhere(Unreliable):
    """Computes here under the name of another machine, with another number in one row."""

    def __init__(self, wrong: str) -> None:
        super().__init__(0)
        self.wrong = wrong

    def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
        answer = run_batch(batch, None)
        rows = tuple(
            {**row, "machine": "other", "torque_error": 0.5 + (row["id"] == self.wrong)}
            for row in answer.rows
        )
        on_answer(replace(answer, rows=rows, machine={**environment_fields(), "id": "other"}))


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_machine_that_computes_otherwise_is_named(
    tmp_path: Path, place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One cell of each new machine is computed here, and no other cell of its experiment."""
    log = tmp_path / "executed"
    monkeypatch.setenv("SYSID_TEST_LOG", str(log))
    estimators = [{"cell": f"0.{k}", "label": "ols"} for k in range(3)]
    fingerprints = {f"0.{k}": "" for k in range(3)}
    argument = {"estimators": estimators, "labels": {}, "fingerprints": fingerprints}
    cells = tuple({"id": f"0.{k}"} for k in range(3))
    jobs = [Job("harness_tasks:execute", argument, cells)]
    # Other limits than those of warm seats, whose workers do not know this log.
    work = Work(jobs, WorkerSettings(tmp_path, timeout=20.0 + place, threads=1), {}, (), 1)
    ended = ExecutorRun(Elsewhere(f"0.{place}"), work, no_progress, "").run()
    assert ended.ending == "finished"
    assert len(log.read_text().split()) == 3 + 1
    # The first sound row stands for its machine; a machine is not compared cell by cell.
    assert [("torque_error" in note, "other" in note) for note in ended.notes] == (
        [(True, True)] if place == 0 else []
    )


@given(
    sizes=st.lists(st.integers(1, 5), max_size=30),
    groups=st.lists(st.sampled_from("ab"), min_size=30, max_size=30),
    seconds=st.dictionaries(st.sampled_from(["0.0", "3.0", "7.0"]), st.floats(0.0, 50.0)),
    workers=st.lists(st.sampled_from(["one", "other"]), min_size=1, max_size=9),
    parts=st.integers(1, 9),
)
def test_each_job_is_in_one_batch(
    sizes: list[int], groups: list[str], seconds: dict[str, float], workers: list[str], parts: int
) -> None:
    jobs = [replace(job(n, cells), group=groups[n]) for n, cells in enumerate(sizes)]
    waiting = BatchQueue(jobs, seconds)
    batches = list[tuple[Job, ...]]()
    while waiting:
        batches.append(waiting.select_batch(workers[len(batches) % len(workers)], parts))
    assert all(batches)
    taken = [one.cells[0]["id"] for batch in batches for one in batch]
    assert sorted(taken) == sorted(one.cells[0]["id"] for one in jobs)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_stay_with_their_group_and_batches_shrink(workers: int) -> None:
    """Each group is computed by one worker, but for the last ones, which others help with."""
    jobs = [replace(job(n, 1), group=str(n // 5)) for n in range(200)]
    waiting = BatchQueue(jobs, {f"{n}.0": 0.2 for n in range(200)})
    taken = list[tuple[int, tuple[Job, ...]]]()
    while waiting:
        worker = len(taken) % workers
        taken.append((worker, waiting.select_batch(worker, 2 * workers)))
    sizes = [len(batch) for _, batch in taken]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] == 3
    assert sizes[-workers:] == [1] * workers
    computed = {(one.group, worker) for worker, batch in taken for one in batch}
    assert len(computed) <= 40 + workers * (workers - 1)


def test_cells_without_a_cost_are_sent_by_their_number() -> None:
    waiting = BatchQueue([job(n, 100) for n in range(400)], {})
    sizes = list[int]()
    while waiting:
        sizes.append(100 * len(waiting.select_batch("one", 4)))
    assert max(sizes) == sizes[0] == 2000
    assert sizes[-1] == 100


def test_a_bundle_is_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    for name in ("one", "two"):
        folder = tmp_path / name / "suite"
        (folder / ".git").mkdir(parents=True)
        (folder / "reports" / "run").mkdir(parents=True)
        (folder / "reports" / "run" / "plan.jsonl").write_text("{}")
        (folder / ".git" / "config").write_text("hidden")
        (folder / "arm.urdf").write_text("<robot/>")
    os.utime(tmp_path / "two" / "suite" / "arm.urdf", (1, 1))
    one, two = (run_files([tmp_path / name / "suite"]) for name in ("one", "two"))
    assert one.data == two.data
    place = one.open_folder()
    assert two.open_folder() == place
    assert [f.relative_to(place) for f in place.rglob("*") if f.is_file()] == [Path("0/arm.urdf")]
    assert place.parent.stat().st_mode & 0o077 == 0
    (tmp_path / "two" / "suite" / "arm.urdf").write_text("<robot name='b'/>")
    assert run_files([tmp_path / "two" / "suite"]).data != one.data
    monkeypatch.setattr(bundles, "MOST_BYTES", 100.0)
    with pytest.raises(UsageError, match=r"more than .* GB.*shared"):
        run_files([tmp_path / "one" / "suite"])


def test_paths_are_moved_there_and_back() -> None:
    places = {"/home/a/suite": "/tmp/x/0", "/home/a/suite/robots": "/tmp/x/1"}
    value = {
        "use": "file:/home/a/suite/m.py:M",
        "/home/a/suite/m.py": [1, True, None],
        "folder": "/home/a/suite",
        "robot": "/home/a/suite/robots/r.urdf",
        "other": "/home/a/suite2/m.py and /home/a/suite.bak",
    }
    there = with_folders(value, places)
    assert there["use"] == "file:/tmp/x/0/m.py:M"
    assert there["robot"] == "/tmp/x/1/r.urdf"
    assert there["other"] == value["other"]
    assert with_folders(there, {new: old for old, new in places.items()}) == value


def test_a_path_is_moved_once_and_as_a_whole() -> None:
    """Places lie below one another, and names of roots occur within other paths."""
    places = {"/tmp": "/tmp/sb/0", "/tmp/robots": "/tmp/sb/1", "/work": "/tmp/sb/2"}
    moves = {
        "/tmp/robots/a.urdf": "/tmp/sb/1/a.urdf",
        "/tmp/s.toml": "/tmp/sb/0/s.toml",
        "file:/work/m.py:M": "file:/tmp/sb/2/m.py:M",
        "/mnt/work/x.csv": "/mnt/work/x.csv",
        "a/tmp": "a/tmp",
        "reads /work, not /works": "reads /tmp/sb/2, not /works",
    }
    assert [with_folders(path, places) for path in moves] == list(moves.values())
    assert with_folders({"a": ["/work"]}, {}) == {"a": ["/work"]}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("dask://10.0.0.5:8786", "ssh -L 8786"),
        ("dask://cluster.example:8786", r"dask\+tls"),
        ("dask://127.0.0.1", "HOST:PORT"),
        ("dask+ssl://10.0.0.5:8786", "'tls'"),
        ("dask://127.0.0.1:8786?share", "shared"),
        ("dusk://127.0.0.1:8786", "Did you mean 'dask'"),
        ("dask://127.0.0.1:8786?shared=no", "flag"),
        ("dask://127.0.0.1:8786?other-code=false", "flag"),
        ("dask://127.0.0.1:8786?patience=-5s", "positive"),
        ("dask://127.0.0.1:8786?patience=5kg", "kg"),
        ("dask://127.0.0.1:99999", "HOST:PORT"),
        ("dask+://127.0.0.1:8786", "without a word"),
        ("slurm:none.toml", "profile 'none.toml'"),
        ("local:4", "address"),
    ],
)
def test_addresses_that_are_refused(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        executor_of(text)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('maximum = "ten"', "maximum is 'ten'"),
        ("maximum = 0", "1 job or more"),
        ("maximum = 2.7", "1 job or more"),
        ("maximum = true", "1 job or more"),
        ('shared = "no"', "flag"),
        ("patience = -5", "positive"),
        ("queue = [", "cannot be read"),
    ],
)
def test_profiles_that_are_refused(tmp_path: Path, keys: str, said: str) -> None:
    (tmp_path / "p.toml").write_text(keys + "\n")
    with pytest.raises(UsageError, match=said):
        executor_of(f"slurm:{tmp_path / 'p.toml'}")


def test_an_executor_of_a_stranger_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "mine.py").write_text("class Mine:\n    kind = 'mine'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for text in (f"file:{tmp_path}/far/mine.py:Mine", "far.mine:Mine"):
        assert executor_of(text).kind == "mine"  # type: ignore[attr-defined]


def test_addresses_that_are_taken() -> None:
    assert executor_of("local") == Local()
    assert executor_of("dask://localhost:1?shared&patience=5s") == Dask(
        "localhost:1?shared&patience=5s"
    )
    assert executor_of("dask+tls://10.0.0.5:1") == Dask("10.0.0.5:1", "tls")
