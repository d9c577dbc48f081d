"""Trivial tasks for workers: each does what argument["do"] says, then emits its rows."""

import ctypes
import mmap
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from sysid_bench.experiments.job_channel import JobChannel, JobEnd


def act(argument: dict[str, Any], channel: JobChannel) -> None:
    """argument: {do, cells}; the act precedes the first cell, or is in cell N for "in N ..."."""
    do, inside = argument["do"], None
    if do.startswith("in "):
        _, number, do = do.split(maxsplit=2)
        inside = argument["cells"][int(number)]
    else:
        perform(do)
    for cell in argument["cells"]:
        if cell in channel.cells:
            channel.start_cell(cell)
            if cell == inside:
                perform(do)
            channel.write({"id": cell, "status": "ok", "pid": os.getpid()})


def act_apart(argument: dict[str, Any], channel: JobChannel) -> None:
    """Does the same in a process of its own."""
    heads = {cell: {"id": cell} for cell in channel.cells}
    death = channel.run_process(partial(act, argument), heads)
    if death is not None:
        raise JobEnd(death)


def perform(do: str) -> None:  # noqa: C901 - a table of acts
    match do.split():
        case ["raise"]:
            raise ValueError("no\nnumbers")
        case ["exit"]:
            sys.exit(3)
        case ["leave"]:
            os._exit(7)
        case ["die"]:
            os.kill(os.getpid(), signal.SIGSEGV)
        case ["segfault"]:
            ctypes.string_at(0)
        case ["killed"]:
            os.kill(os.getpid(), signal.SIGKILL)
        case ["allocate"]:
            kept = []
            while True:  # mapped files do not count as data: the supervisor sees their pages
                kept.append(mmap.mmap(-1, 50_000_000))
                kept[-1].write(b"x" * 50_000_000)
        case ["flood"]:
            print("the first line")
            for _ in range(40):
                print("x" * 100_000)
            print("the last line", flush=True)
        case ["hang"]:
            time.sleep(1000)
        case ["grandchild", born]:
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
            Path(born).write_text(str(child.pid))
            time.sleep(1000)
        case ["daemonize", word]:
            for _ in range(2):
                if os.fork():
                    time.sleep(1000)
                os.setsid()
            subprocess.Popen(["sh", "-c", "sleep 1000; true", word], env={}, start_new_session=True)
            time.sleep(1000)
        case ["remove", folder]:
            shutil.rmtree(folder)
        case ["truncate", folder]:
            for file in Path(folder).glob("*.jsonl"):
                os.truncate(file, 0)
        case ["garble", folder]:
            for file in Path(folder).glob("*.jsonl"):
                with file.open("a") as lines:
                    lines.write("[" * 100_000 + '\n{"id": 5}\nnull\n{"id"')
        case ["print"]:
            print("a plug-in talks")
            os.write(1, b"behind our back\n")
        case ["ask"]:
            input()
        case ["sleep", seconds]:
            time.sleep(float(seconds))


def sleep_in_each(argument: dict[str, Any], channel: JobChannel) -> None:
    for cell in sorted(channel.cells):
        channel.start_cell(cell)
        time.sleep(argument["seconds"])
        channel.write({"id": cell, "status": "ok"})


def silent(argument: Any, channel: JobChannel) -> None:
    """Owes rows and gives none."""


def foreign_error(argument: Any, channel: JobChannel) -> None:
    """Emits a row that nobody asked for."""
    channel.write({"id": "nobody", "status": "ok"})


def execute(argument: dict[str, Any], channel: JobChannel) -> None:
    """Stands for the experiment: a row per estimator; settings of the estimator say what happens.

    The file named in SYSID_TEST_LOG gets a line per executed cell.
    """
    for estimator in argument["estimators"]:
        if estimator["cell"] not in channel.cells:
            continue
        channel.start_cell(estimator["cell"])
        time.sleep(estimator.get("seconds", 0.0))
        perform(estimator.get("do", ""))
        if "SYSID_TEST_LOG" in os.environ:
            with Path(os.environ["SYSID_TEST_LOG"]).open("a") as log:
                log.write(estimator["cell"] + "\n")
        channel.write(
            {
                **argument["labels"],
                "id": estimator["cell"],
                "estimator": estimator["label"],
                "status": estimator.get("status", "ok"),
                "reason": "",
                "crosscheck": estimator.get("crosscheck", "ok"),
                "fingerprint": argument["fingerprints"][estimator["cell"]],
                "torque_error": 0.5,
                "joints": [{"name": "j1", "rmse_test": 0.1}],
                "parameters_table": [{"body": "b", "name": "m", "true": 1.0, "estimate": 1.1}],
            }
        )
