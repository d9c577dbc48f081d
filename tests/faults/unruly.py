"""Plug-ins that misbehave where a suite is planned, recorded, or where one command uses them."""

import os
import threading
import time
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from sysid_bench.experiments.tasks.definitions import RobotTask
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Estimate, Metric


class Sound:
    """Least squares."""

    def solve(self, problem: Any) -> Any:
        return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])


# Constructors


class MakeHangs(Sound):
    def __init__(self) -> None:
        time.sleep(1e6)


class MakeAborts(Sound):
    def __init__(self) -> None:
        os.abort()


class MakeExits(Sound):
    def __init__(self) -> None:
        raise SystemExit(0)


class MakeForks(Sound):
    """Comes back from its constructor twice."""

    def __init__(self) -> None:
        os.fork()


class MakeChanges(Sound):
    """Changes the folder, numpy, and leaves a thread behind."""

    def __init__(self) -> None:
        os.chdir("/")
        np.seterr(all="raise")
        threading.Thread(target=time.sleep, args=(1e6,)).start()


class AbortingTask(RobotTask):
    def __init__(self) -> None:
        os.abort()


def aborting_metric() -> Metric:
    os.abort()


own_metric = Metric("own", "Own", "N m", better="lower", compute=lambda cell: 1.0)


# Methods that misbehave when their cell is executed a second time, for its recording


class _Again(Sound):
    def solve(self, problem: Any) -> Any:
        # The environment of a test reaches the process that records, not that of a scored method.
        if "SYSID_TEST_SEEN" in os.environ:
            self.act()
        return super().solve(problem)

    def act(self) -> Any:
        raise NotImplementedError


class AgainHangs(_Again):
    def act(self) -> None:
        time.sleep(1e6)


class AgainAborts(_Again):
    def act(self) -> None:
        os.abort()


class AgainChanges(_Again):
    """Changes the folder, and leaves a thread behind."""

    def act(self) -> None:
        os.chdir("/")
        threading.Thread(target=time.sleep, args=(1e6,)).start()


# Commands


class Hangs(Sound):
    def solve(self, problem: Any) -> NoReturn:
        while True:
            time.sleep(1.0)


class Raises(Sound):
    def solve(self, problem: Any) -> NoReturn:
        raise ValueError("boom")


class Reader:
    def read(self, path: Path) -> LogTable:
        os.abort()
