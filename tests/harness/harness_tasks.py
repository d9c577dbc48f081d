"""Trivial tasks for workers: each does what argument["do"] says, then emits its rows."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

Emit = Callable[[dict[str, Any]], None]


def act(argument: dict[str, Any], emit: Emit) -> None:
    """argument: {do, cells}; rows are emitted after the act, or before it for "late-..."."""
    do = argument["do"]
    if do.startswith("late-"):
        emit({"id": argument["cells"][0], "status": "ok"})
        do = do.removeprefix("late-")
    perform(do)
    for cell in argument["cells"]:
        emit({"id": cell, "status": "ok", "pid": os.getpid()})


def perform(do: str) -> None:
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
        case ["hang"]:
            time.sleep(1000)
        case ["grandchild", born]:
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
            Path(born).write_text(str(child.pid))
            time.sleep(1000)
        case ["print"]:
            print("a plug-in talks")
            os.write(1, b"behind our back\n")
        case ["ask"]:
            input()
        case ["sleep", seconds]:
            time.sleep(float(seconds))


def silent(argument: Any, emit: Emit) -> None:
    """Owes rows and gives none."""


def foreign_error(argument: Any, emit: Emit) -> None:
    """Emits a row that nobody asked for."""
    emit({"id": "nobody", "status": "ok"})


def execute(argument: dict[str, Any], emit: Emit) -> None:
    """Stands for the experiment: a row per estimator; settings of the estimator say what happens.

    A file named in SYSID_TEST_LOG gets a line per executed cell.
    """
    for estimator in argument["estimators"]:
        time.sleep(estimator.get("seconds", 0.0))
        perform(estimator.get("do", ""))
        if "SYSID_TEST_LOG" in os.environ:
            with Path(os.environ["SYSID_TEST_LOG"]).open("a") as log:
                log.write(estimator["cell"] + "\n")
        emit(
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
