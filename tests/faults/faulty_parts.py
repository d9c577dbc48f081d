"""Faulty parts of experiments: an excitation, an effect, a metric. `act` says what happens."""

import ctypes
import os
import signal
import time
from typing import Any

from sysid_bench.types import Metric


def perform(act: str) -> None:
    match act:
        case "crash":
            ctypes.string_at(0)
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "hang":
            time.sleep(3600)
        case "raise":
            raise ValueError(act)


class _Part:
    def __init__(self, act: str = "") -> None:
        self.act = act


class Excitation(_Part):
    def design(self, problem: Any, rng: Any) -> Any:
        perform(self.act)


class Effect(_Part):
    def prepare(self, robot: Any) -> Any:
        perform(self.act)


def metric(act: str = "") -> Metric:
    def compute(cell: Any) -> float:
        perform(act)
        return 1.0

    return Metric("mine", "Mine", compute=compute)
