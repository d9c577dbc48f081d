"""Runs on Dask workers: rows as those of one process, whatever part of the cluster is lost."""

import shutil
from pathlib import Path

import pytest

from tests.cluster.cluster_world import (
    ROOT,
    Cluster,
    bench,
    done,
    kill,
    rows,
    seats,
    wait_for_rows,
    write_suite,
)
from tests.other_package import python_with

CELLS = 48


def test_two_workers_give_the_rows_of_one_process(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    cluster.join()
    cluster.join()
    words = ("run", str(suite), "-o", str(tmp_path / "run"), "--executor", cluster.address)
    code, text = done(bench(*words))
    assert code == 0, text
    assert rows(tmp_path / "run") == rows(local)
    assert len(rows(local)) == CELLS
    assert '"machines"' in (tmp_path / "run" / "env.json").read_text()
    again, text = done(bench(*words))  # nothing is left to run
    assert again == 0, text
    assert (tmp_path / "run" / "report.html").is_file()


def test_the_kit_of_executors_accepts_it(cluster: Cluster) -> None:
    cluster.join()
    code, text = done(bench("check-plugin", "--kind", "executor", cluster.address))
    assert code == 0, text
    assert "keeps its laws (5 checks)" in text


def test_a_worker_that_is_killed_costs_no_row(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    first = cluster.join()
    cluster.join()
    run = bench("run", str(suite), "-o", str(tmp_path / "run"), "--executor", cluster.address)
    wait_for_rows(tmp_path / "run", 10)
    kill(first)
    code, text = done(run)
    assert code == 0, text
    assert rows(tmp_path / "run") == rows(local)


def test_a_client_that_is_killed_is_resumed(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    cluster.join()
    words = ("run", str(suite), "-o", str(tmp_path / "run"), "--executor", cluster.address)
    run = bench(*words)
    wait_for_rows(tmp_path / "run", 10)
    kill(run)
    kept = {file.name: file.read_bytes() for file in (tmp_path / "run" / "cells").glob("*.jsonl")}
    code, text = done(bench(*words))
    assert code == 0, text
    assert rows(tmp_path / "run") == rows(local)
    for name, data in kept.items():
        assert (tmp_path / "run" / "cells" / name).read_bytes() == data


def test_without_a_scheduler_the_run_ends_resumable(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    worker = cluster.join(pause=0.5)  # the end is far when the scheduler goes
    out = tmp_path / "run"
    run = bench("run", str(suite), "-o", str(out), "--executor", cluster.address)
    wait_for_rows(out, 10)
    kill(cluster.scheduler)
    code, text = done(run)
    assert code == 5, text
    assert "scheduler is gone" in text
    kept = len(rows(out))
    assert 10 <= kept < CELLS
    kill(worker)
    code, text = done(bench("run", str(out)))  # here, without any cluster
    assert code == 0, text
    assert rows(out) == rows(local)
    assert seats() == []


def test_workers_may_join_late(cluster: Cluster, suite: Path, local: Path, tmp_path: Path) -> None:
    run = bench("run", str(suite), "-o", str(tmp_path / "run"), "--executor", cluster.address)
    with pytest.raises(AssertionError, match="less than"):
        wait_for_rows(tmp_path / "run", 1, seconds=4.0)
    cluster.join()
    code, text = done(run)
    assert code == 0, text
    assert rows(tmp_path / "run") == rows(local)


def test_without_any_worker_the_run_ends(cluster: Cluster, suite: Path, tmp_path: Path) -> None:
    address = cluster.address.replace("20s", "3s")
    code, text = done(bench("run", str(suite), "-o", str(tmp_path / "run"), "--executor", address))
    assert code == 5, text
    assert "No worker for 3 s" in text


def test_a_worker_with_other_code_is_refused_or_declared(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(
        ROOT / "sysid_bench", other / "sysid_bench", ignore=shutil.ignore_patterns("__pycache__")
    )
    (other / "robots").symlink_to(ROOT / "robots")
    with (other / "sysid_bench" / "units.py").open("a") as source:
        source.write("# another version\n")
    cluster.join(other, str(python_with(other, tmp_path / "python")))
    out = tmp_path / "run"
    words = ("run", str(suite), "-o", str(out), "--executor")
    code, text = done(bench(*words, cluster.address))
    assert code == 2, text
    assert "other-code" in text
    code, text = done(bench(*words, cluster.address + "&other-code"))
    assert code == 0, text
    assert rows(out).keys() == rows(local).keys()


def test_limits_hold_at_workers(cluster: Cluster, tmp_path: Path) -> None:
    more = "".join(
        f'[[estimator]]\nuse = "file:unruly.py:{name}"\n' for name in ("Hangs", "Crashes")
    )
    short = {"repeats = 8": "repeats = 1", "20 s": "3 s"}
    suite = write_suite(tmp_path / "suite", more, **short)
    cluster.join()
    words = ("run", str(suite), "-o", str(tmp_path / "run"), "--executor", cluster.address)
    code, text = done(bench(*words))
    assert code == 3, text
    found = {(row["estimator"], row["status"]) for row in rows(tmp_path / "run").values()}
    assert found == {
        ("ols", "ok"), ("wls", "ok"), ("Mine", "ok"), ("Hangs", "timeout"), ("Crashes", "crash")
    }  # fmt: skip


def test_no_scheduler_is_a_sentence(suite: Path, tmp_path: Path) -> None:
    words = ("run", str(suite), "-o", str(tmp_path / "run"), "--executor", "dask://127.0.0.1:9")
    code, text = done(bench(*words))
    assert code == 2, text
    assert "No Dask scheduler answers" in text
