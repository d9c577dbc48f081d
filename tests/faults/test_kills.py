"""Law of kills: whatever ends at whatever moment, the same command completes the run exactly."""

import os
import random
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest
from harness_world import FULL

from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.process_tree import tree_of
from tests.faults.runners import left_behind, start, stored_lines, wait_for

KILLS = 10
"""Kills for each number of workers."""
SIGNALS = {
    "kill": (signal.SIGKILL,),
    "interrupt": (signal.SIGINT,),
    "twice": (signal.SIGINT, signal.SIGINT),
    "terminate": (signal.SIGTERM,),
    "hang up": (signal.SIGHUP,),
}
WORKER = "worker"


def kill(runner: "subprocess.Popen[str]", how: str, draw: random.Random) -> None:
    """End a runner in its way; a worker's end is followed by an interrupt of the runner."""
    if how == WORKER:
        for process in draw.choices(tree_of(runner.pid) or [runner.pid]):
            os.kill(process, signal.SIGKILL)
        time.sleep(draw.uniform(0.0, 0.3))
    for number in SIGNALS.get(how, (signal.SIGINT,)):
        runner.send_signal(number)
        time.sleep(draw.uniform(0.0, 0.01))


@pytest.mark.parametrize("whom", ["runner", "worker"])
def test_a_daemon_of_a_cell_ends_with_its_worker(tmp_path: Path, token: str, whom: str) -> None:
    """It has a session, a clean environment and no parent of its own, and nobody is left to ask."""
    suite, out = tmp_path / "suite.toml", tmp_path / "run"
    suite.write_text(FULL.replace('use = "ols"', f'use = "ols"\ndo = "daemonize {token}"'))
    with start(suite, out, 1) as runner:
        assert wait_for(lambda: any(text.startswith("sh") for text in left_behind(token)))
        guard, worker = tree_of(runner.pid)[:2]
        assert guard != worker
        os.kill(runner.pid if whom == "runner" else worker, signal.SIGKILL)
        if whom == "worker":
            assert wait_for(lambda: RunFolder(out).rows().rows)
            runner.send_signal(signal.SIGINT)
    assert wait_for(lambda: not left_behind(token)), left_behind(token)
    assert [row["status"] for row in RunFolder(out).rows().rows.values()] == (
        [] if whom == "runner" else ["lost"]
    )


@pytest.mark.parametrize("jobs", [1, 2, 4])
def test_any_end_then_the_same_command(tmp_path: Path, token: str, jobs: int) -> None:
    draw = random.Random(jobs)
    suite, out = tmp_path / "suite.toml", tmp_path / "run"
    suite.write_text(FULL.replace('use = "ols"', 'use = "ols"\nseconds = 0.05'))
    ways = [*SIGNALS, WORKER]
    for number in range(KILLS):
        how = ways[number] if number < len(ways) else draw.choice(ways)
        with start(suite, out, jobs) as runner:
            assert runner.stdout is not None
            for _ in range(draw.randint(1, 4)):  # "plan", then "start" and "row"
                runner.stdout.readline()
            time.sleep(draw.uniform(0.0, 0.1))
            kill(runner, how, draw)
            errors = runner.communicate()[1]
        assert runner.returncode == (-signal.SIGKILL if how == "kill" else 130), (how, errors)
        assert "Traceback" not in errors, errors
        assert wait_for(lambda: not left_behind(token)), left_behind(token)
        with RunFolder.open(out).lock():
            pass
    with start(suite, out, jobs) as runner:
        assert runner.stdout is not None
        runner.stdout.read()
    assert runner.returncode == 0
    folder = RunFolder.open(out)
    stored = folder.rows()
    assert {row["status"] for row in stored.rows.values()} == {"ok"}
    assert set(stored.rows) == {cell.id for cell in folder.plan.cells}
    assert stored.garbled == ()
    sound = [row["id"] for row in stored_lines(out / "cells") if row["status"] != "lost"]
    assert Counter(sound) == dict.fromkeys(stored.rows, 1)
