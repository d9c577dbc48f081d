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
    run_on,
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
    done(run_on(cluster.address, suite, tmp_path / "run"))
    assert rows(tmp_path / "run") == rows(local)
    assert len(rows(local)) == CELLS
    assert '"machines"' in (tmp_path / "run" / "env.json").read_text()
    done(run_on(cluster.address, suite, tmp_path / "run"))  # nothing is left to run
    assert (tmp_path / "run" / "report.html").is_file()


def test_the_kit_of_executors_accepts_it(cluster: Cluster) -> None:
    cluster.join()
    text = done(bench("check-plugin", "--kind", "executor", cluster.address))
    assert "keeps its laws (5 checks)" in text


def test_a_worker_that_is_killed_costs_no_row(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    first = cluster.join()
    cluster.join()
    run = run_on(cluster.address, suite, tmp_path / "run")
    wait_for_rows(tmp_path / "run", 10)
    kill(first)
    done(run)
    assert rows(tmp_path / "run") == rows(local)


def test_a_client_that_is_killed_is_resumed(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    cluster.join()
    run = run_on(cluster.address, suite, tmp_path / "run")
    wait_for_rows(tmp_path / "run", 10)
    kill(run)
    kept = {file.name: file.read_bytes() for file in (tmp_path / "run" / "cells").glob("*.jsonl")}
    done(run_on(cluster.address, suite, tmp_path / "run"))
    assert rows(tmp_path / "run") == rows(local)
    for name, data in kept.items():
        assert (tmp_path / "run" / "cells" / name).read_bytes() == data


def test_without_a_scheduler_the_run_ends_resumable(
    cluster: Cluster, suite: Path, local: Path, tmp_path: Path
) -> None:
    worker = cluster.join(pause=0.5)  # the end is far when the scheduler goes
    out = tmp_path / "run"
    run = run_on(cluster.address, suite, out)
    wait_for_rows(out, 10)
    kill(cluster.scheduler)
    text = done(run, 5)
    assert "scheduler is gone" in text
    kept = len(rows(out))
    assert 10 <= kept < CELLS
    kill(worker)
    done(bench("run", str(out)))  # here, without any cluster
    assert rows(out) == rows(local)
    assert seats() == []


def test_workers_may_join_late(cluster: Cluster, suite: Path, local: Path, tmp_path: Path) -> None:
    run = run_on(cluster.address, suite, tmp_path / "run")
    with pytest.raises(AssertionError, match="less than"):
        wait_for_rows(tmp_path / "run", 1, seconds=4.0)
    cluster.join()
    done(run)
    assert rows(tmp_path / "run") == rows(local)


def test_without_any_worker_the_run_ends(cluster: Cluster, suite: Path, tmp_path: Path) -> None:
    address = cluster.address.replace("20s", "3s")
    text = done(run_on(address, suite, tmp_path / "run"), 5)
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
    text = done(run_on(cluster.address, suite, out), 2)
    assert "other-code" in text
    done(run_on(cluster.address + "&other-code", suite, out))
    assert rows(out).keys() == rows(local).keys()


def test_limits_hold_at_workers(cluster: Cluster, tmp_path: Path) -> None:
    more = "".join(
        f'[[estimator]]\nuse = "file:unruly.py:{name}"\n' for name in ("Hangs", "Crashes")
    )
    short = {"repeats = 8": "repeats = 1", "20 s": "10 s"}  # 3 s were too few on a busy machine
    suite = write_suite(tmp_path / "suite", more, **short)
    cluster.join()
    done(run_on(cluster.address, suite, tmp_path / "run"), 3)
    found = {(row["estimator"], row["status"]) for row in rows(tmp_path / "run").values()}
    assert found == {
        ("ols", "ok"), ("wls", "ok"), ("Mine", "ok"), ("Hangs", "timeout"), ("Crashes", "crash")
    }  # fmt: skip


def test_no_scheduler_is_a_sentence(suite: Path, tmp_path: Path) -> None:
    text = done(run_on("dask://127.0.0.1:9", suite, tmp_path / "run"), 2)
    assert "No Dask scheduler answers" in text
